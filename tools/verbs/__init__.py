"""The verbs of `xrl`, one file each: flags, calls, output. No verb imports another."""
