"""The bridge to ROS 2: topics of a robot in, velocities out, without ROS where it runs."""
