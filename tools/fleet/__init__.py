"""The fleet as processes: process table, supervisor, start and stop, status."""
