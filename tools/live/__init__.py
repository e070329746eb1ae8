"""The experiment on a live fleet of processes: start it, watch it, impair it."""
