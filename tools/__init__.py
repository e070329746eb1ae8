"""The command line `xrl`, and the code that its verbs share."""

import shared  # noqa: F401 - before NumPy, whose number of threads it sets
