"""The command line `xrl`: one file for each verb."""

import shared  # noqa: F401 - before NumPy: it settles the number of threads
