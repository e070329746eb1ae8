"""What is read out of a log afterwards: survey, reports, playback, re-execution."""
