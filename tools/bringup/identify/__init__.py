"""What `xrl drive identify` measures: the body from a standing record, joints from small sines."""
