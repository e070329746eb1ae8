"""Code that every process shares: names, messages, the bus, the clock and the configuration.

`shared` imports no service (checked by `tests/test_architecture.py`). Import it before NumPy and
SciPy: it limits them to one thread. With more threads, which only wait for each other on matrices
of 12 x 12, a run in virtual time took three times as long. One thread also gives the same bits
every time.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
