"""The crash matrix: what dies in a case, what is expected of the robot, what came of it."""
