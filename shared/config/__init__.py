"""The robot file, its gain schedule, scenarios and impairments, read and checked."""
