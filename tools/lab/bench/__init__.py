"""Benchmarks of the fleet and its parts, also against another git revision."""
