"""ROS 2 on a Zenoh network: messages in CDR, and names of topics and nodes as in rmw_zenoh.

The package imports no part of ROS, and opens no socket: it uses rosbags only to encode and decode
messages. `skytether.shell.driving.graph` puts a `graph.Node` on a Zenoh network. `client.ros2` and
`skytether ros2` import the package. The package imports `shared.base`.
"""
