"""The harness service: six leg forces in, the operator's wrench out (design section 3 f)."""
