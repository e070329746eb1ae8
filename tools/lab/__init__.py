"""The laboratory, for researchers: gain design, studies, benches, learning. No robot needs it."""
