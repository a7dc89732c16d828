"""ROS 2 on a Zenoh network: messages in CDR, and names of topics and nodes as in rmw_zenoh.

The package imports no part of ROS, and opens no socket: rosbags only encodes and decodes messages.
`skytether.shell.driving.graph` puts a `graph.Node` on a Zenoh network. `client.ros2` and `skytether
ros2` import the package; it imports `shared.base`.
"""
