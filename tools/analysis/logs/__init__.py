"""What is in a log, without holding it in memory."""
