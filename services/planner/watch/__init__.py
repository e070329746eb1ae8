"""What makes the planner hold, ask for stiffer modules or leave the lead to another. Pure."""
