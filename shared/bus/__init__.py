"""Topics, messages and the Zenoh session."""
