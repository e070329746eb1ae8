"""What would have come of a recorded run, had something died in it."""
