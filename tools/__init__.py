"""The command line `xrl`, and what its verbs use."""

import shared  # noqa: F401 - before NumPy: it settles the number of threads
