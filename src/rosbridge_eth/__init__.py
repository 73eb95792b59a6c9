"""From the name of a ROS topic to a verified record read back from an Ethereum chain."""
