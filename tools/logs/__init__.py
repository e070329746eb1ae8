"""Records of runs: find, read and re-execute them."""
