"""Analysis of logs: survey, reports, playback, re-execution."""
