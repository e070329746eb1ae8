"""Log lines for people: start, stop, changes of state. Never inside a control cycle."""

from __future__ import annotations

import logging


def setup(service: str) -> logging.Logger:
    """Send this process's log lines to stderr with its name and return its logger."""
    logging.basicConfig(
        level=logging.INFO,
        format=f"%(asctime)s.%(msecs)03d {service:<12} %(levelname)-7s %(message)s",
        datefmt="%H:%M:%S",
    )
    logging.getLogger("can").setLevel(logging.WARNING)
    return logging.getLogger("xrl")


def get(name: str) -> logging.Logger:
    """Return a logger by name."""
    return logging.getLogger(name)
