"""Tests of runs: scenarios, verdicts, virtual time."""
