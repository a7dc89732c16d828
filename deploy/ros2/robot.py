"""A robot of ROS 2 without a body: follows /cmd_vel with a lag, and publishes /odom.

It stops when no command has come for 0.5 s. For the profile `ros2` of docker-compose.yml.
"""

import math

import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

PERIOD_S, TIME_OUT_S, TAU_S = 0.02, 0.5, 0.84


class Robot(Node):
    def __init__(self) -> None:
        super().__init__("robot")
        self.place, self.velocity = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        """x, y, heading [m, rad]; forwards, to the left, turn [m/s, rad/s]."""
        self.wanted, self.came_ns = [0.0, 0.0, 0.0], 0
        self.out = self.create_publisher(Odometry, "/odom", 10)
        self.create_subscription(TwistStamped, "/cmd_vel", self.hear, 10)
        self.create_timer(PERIOD_S, self.step)

    def hear(self, message: TwistStamped) -> None:
        linear, angular = message.twist.linear, message.twist.angular
        self.wanted = [linear.x, linear.y, angular.z]
        self.came_ns = self.get_clock().now().nanoseconds

    def step(self) -> None:
        now = self.get_clock().now()
        if now.nanoseconds - self.came_ns > TIME_OUT_S * 1e9:
            self.wanted = [0.0, 0.0, 0.0]
        for i in range(3):
            self.velocity[i] += (self.wanted[i] - self.velocity[i]) * PERIOD_S / TAU_S
        (forward, left, turn), heading = self.velocity, self.place[2]
        self.place[0] += PERIOD_S * (math.cos(heading) * forward - math.sin(heading) * left)
        self.place[1] += PERIOD_S * (math.sin(heading) * forward + math.cos(heading) * left)
        self.place[2] += PERIOD_S * turn
        message = Odometry()
        message.header.stamp = now.to_msg()
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        message.pose.pose.position.x, message.pose.pose.position.y = self.place[:2]
        message.pose.pose.orientation.z = math.sin(self.place[2] / 2.0)
        message.pose.pose.orientation.w = math.cos(self.place[2] / 2.0)
        twist = message.twist.twist
        twist.linear.x, twist.linear.y, twist.angular.z = self.velocity
        self.out.publish(message)


rclpy.init()
rclpy.spin(Robot())
