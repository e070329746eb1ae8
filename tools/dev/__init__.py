"""Developers' tools: reference pages, checks, mutants."""
