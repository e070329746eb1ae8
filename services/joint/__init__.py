"""The joint service: local law, failsafe and gate of one 2-DOF module."""
