"""Logs: MCAP files written, read though cut off or damaged, recovered, and extended."""
