"""A live ROS 2 graph, through the robot's own rclpy, which is imported when a source is opened."""

from rosbridge_eth.sources.ros2.source import Ros2Source

__all__ = ["Ros2Source"]
