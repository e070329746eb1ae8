"""Re-execution of a run's services from its log, with the very same objects."""
