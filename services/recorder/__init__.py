"""The recorder: everything on the bus into MCAP files (docs/logs.md)."""
