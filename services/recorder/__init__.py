"""The recorder: everything on the bus into one MCAP file (design section 10)."""
