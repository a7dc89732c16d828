"""ROS 2 as it is on a Zenoh network: messages in CDR, and the names that rmw_zenoh gives them.

Nothing of ROS is imported, and no module of this package has a socket: rosbags only encodes and
decodes messages. `skytether.shell.driving.graph` puts a `graph.Node` on a Zenoh network.
`client.ros2` and `skytether ros2` import the package; it imports `shared.base`.
"""
