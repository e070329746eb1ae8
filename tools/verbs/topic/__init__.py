"""Verbs of `xrl topic`."""
