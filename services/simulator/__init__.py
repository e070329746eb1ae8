"""The simulated robot: world, operator and emulated drives."""
