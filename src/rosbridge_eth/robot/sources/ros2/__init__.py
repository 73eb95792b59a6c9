"""A live ROS 2 graph, through the robot's own rclpy, which is imported when a source is opened."""
