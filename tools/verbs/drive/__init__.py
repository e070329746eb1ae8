"""Verbs of `xrl drive`."""
