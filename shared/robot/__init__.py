"""Geometry, gains, and the tables of faults and trips."""
