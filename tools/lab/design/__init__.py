"""Gain design for `xrl gains`: schedule, certificates and push limits."""
