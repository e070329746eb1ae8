"""What every process shares: names, messages, the bus, the clock and the configuration.

`shared` imports no service (checked by `tests/test_architecture.py`). It is imported before NumPy
and SciPy: on matrices of 12 x 12 more threads only wait for one another (a run in virtual time took
three times as long), and figures are the same bit by bit from one thread.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
