"""Harness service: computes the operator's wrench from six leg forces (docs/law.md#harness)."""
