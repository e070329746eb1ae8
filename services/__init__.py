"""The processes of the runtime. A service imports `shared` and itself, no other service."""

import shared  # noqa: F401 - before NumPy: it settles the number of threads
