"""Studies over many lockstep runs: seeded cases, spread over processes, in one table."""
