"""What `xrl drive tune` does: offsets a reference by known amounts; how the robot answers."""
