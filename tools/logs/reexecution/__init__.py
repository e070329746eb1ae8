"""Executes a run's services again from its log, through the very same objects."""
