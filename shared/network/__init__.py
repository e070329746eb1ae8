"""Impairments of a network, in lockstep and live."""
