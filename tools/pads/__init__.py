"""Gamepads: what their axes and buttons mean, and where a person leads by them."""
