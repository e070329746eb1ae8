"""Verbs of `xrl log`."""
