"""Whole-body law: from measured joints to references, gains and torques. Pure."""
