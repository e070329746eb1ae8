"""Experiments on a live fleet of processes: start, watch and impair them."""
