"""Reasons for the planner to hold, yield, stiffen modules or move the robot on its own. Pure."""
