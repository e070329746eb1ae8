"""Geometry, models, compiled graphs, and the tables of faults and trips."""
