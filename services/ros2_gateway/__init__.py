"""ROS 2 gateway: publishes robot data to ROS 2 over Zenoh, without ROS on board (docs/ros2.md)."""
