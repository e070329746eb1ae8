"""Re-execution of a run's services from its log, with the services' own objects."""
