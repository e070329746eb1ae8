"""The robot file and scenarios, read and checked."""
