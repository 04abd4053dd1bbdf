"""Containers of messages: ROS 1 and ROS 2 bags, MCAP."""
