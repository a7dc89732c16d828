"""A robot that speaks ROS 2: odometry in, velocities out.

    keys      section `ros2` of a scenario (`scenario.rooms.SECTIONS`)
    kind      `vehicle.kind = "ros2"`, in the table VEHICLES
    vehicle   the pilot's interface: velocities in, measurements out
    port      messages from and to the robot
    odometry  measurements from nav_msgs/Odometry: frames, and the robot's clock
    drive     the robot's command that gives its controlled point a velocity

The messages, and the names of topics and nodes, are in `skytether.ros2`. The package imports
`skytether.ros2`, `shared` and, from the client, the interface of a vehicle, its clock, positions
and filter. `keys` and `kind` load without the extra `ros2`.
"""
