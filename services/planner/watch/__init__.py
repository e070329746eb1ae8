"""Reasons for the planner to hold, stiffen modules or yield to another planner. Pure."""
