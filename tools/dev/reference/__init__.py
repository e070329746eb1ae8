"""Generates the pages in docs/reference from the code: `python -m tools.dev.reference`."""
