"""Physics in and around MuJoCo: bodies, soles, drivetrains and the person."""
