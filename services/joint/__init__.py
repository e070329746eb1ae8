"""The joint service: local law, failsafe and torque limiter of one 2-DOF module."""
