"""A robot that speaks ROS 2: odometry in, velocities out.

    port      messages from and to the robot
    odometry  measurements from nav_msgs/Odometry: frames, and the robot's clock
    drive     the command of a robot for a velocity of the point that is flown
    vehicle   the pilot's interface: velocities in, measurements out

Messages and names are in `skytether.ros2`.
"""
