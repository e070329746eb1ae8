"""The experiment on a fleet of processes: started, watched, impaired."""
