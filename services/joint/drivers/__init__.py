"""Drivers of the motor drives, behind one interface."""
