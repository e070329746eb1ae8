"""What every process shares: names, messages, the bus, the clock and the configuration.

`shared` imports no service (checked by `tests/test_architecture.py`).
"""
