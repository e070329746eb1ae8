"""Tests of the logs: written, damaged, recovered, extended, read by other tools."""
