"""The verbs of `xrl`: flags, calls, output. No verb imports another."""
