"""The fleet as processes: what is started, by which supervisor, and how it ends."""
