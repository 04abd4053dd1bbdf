"""Event camera recordings in ROS 1 and ROS 2 bags."""
