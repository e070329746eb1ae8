"""Interfaces of the simulated drives and sensors: CAN frames, USB endpoints."""
