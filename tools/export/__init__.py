"""A run's record in other formats: tables, and ROS 2 bags."""
