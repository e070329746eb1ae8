"""A run's record in the formats of others: tables, and bags of ROS 2."""
