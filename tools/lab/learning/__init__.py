"""Learning a controller: a policy's numbers, and a Gymnasium environment in virtual time."""
