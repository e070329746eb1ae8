"""Studies over many lockstep runs: cases drawn from a seed, run over processes, in one table."""
