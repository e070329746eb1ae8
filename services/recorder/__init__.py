"""Recorder: writes everything on the bus to MCAP files (docs/logs.md)."""
