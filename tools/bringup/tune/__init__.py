"""What `xrl drive tune` does: offsets a reference by known amounts, and tells how the robot answers."""
