"""`xrl study`: many runs, in virtual time or live; the sweeps are in `tools.lab.studies`."""
