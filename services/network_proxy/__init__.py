"""The network proxy: a bad network on purpose, on the wire between real processes."""
