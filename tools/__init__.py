"""The command line `xrl`, and the code that its verbs share."""

import shared  # noqa: F401 - before NumPy: it settles the number of threads
