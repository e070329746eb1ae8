"""For those who work on this code: reference pages, mutants."""
