"""The verbs of `xrl`, one file each: flags, calls, what is printed. Nobody imports a verb."""
