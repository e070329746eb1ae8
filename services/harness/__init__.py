"""Harness service: six leg forces in, the operator's wrench out (docs/law.md#harness)."""
