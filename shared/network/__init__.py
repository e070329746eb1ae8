"""Impairments of a network, in lockstep and on the wire."""
