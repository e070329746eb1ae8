"""Log lines for people: start, stop, changes of state. Never inside a control cycle."""

from __future__ import annotations

import logging
import os
import stat


def setup(service: str) -> logging.Logger:
    """Send this process's log lines to stderr with its name, and return its logger.

    A line that does not fit into a full pipe is lost, so that a hung supervisor blocks no service.
    """
    if stat.S_ISFIFO(os.fstat(2).st_mode):
        os.set_blocking(2, False)
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
