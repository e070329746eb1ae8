"""Verbs of `xrl ros2`."""
