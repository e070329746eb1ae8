"""Crash matrix: the parts that fail, the expected outcomes, and the verdicts."""
