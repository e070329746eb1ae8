"""Bodies, soles, drivetrains and the person: MuJoCo and what surrounds it."""
