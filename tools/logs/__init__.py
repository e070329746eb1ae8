"""Records of runs: found, read, executed again."""
