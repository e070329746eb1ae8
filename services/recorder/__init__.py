"""The recorder: everything on the bus into MCAP files (design section 10)."""
