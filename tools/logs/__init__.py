"""Records of runs: found, read, joined, played, executed again."""
