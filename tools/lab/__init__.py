"""Laboratory for researchers: gain design, studies, benches, learning. A robot does not need it."""
