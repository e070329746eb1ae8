"""Where a run comes from: packages and machine; `shared.revision` has the code. Written first.

Two runs can only be expected to agree bit by bit if these do: OpenBLAS picks its
kernels by CPU and thread count (docs/logs.md).
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Final

import msgspec

from shared.revision import UNKNOWN

THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "OPENBLAS_CORETYPE",
    "MKL_NUM_THREADS",
    "ZENOH_RUNTIME",
)
"""Environment variables that change the behaviour of numeric libraries and the bus."""


def machine() -> dict[str, str]:
    """Return Python, platform, CPU model, CPU count and the thread environment (JSON)."""
    threads = {name: os.environ[name] for name in THREAD_VARIABLES if name in os.environ}
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu_model": cpu_model(Path("/proc/cpuinfo")),
        "cpu_count": str(os.cpu_count() or 0),
        "thread_env": msgspec.json.encode(threads).decode(),
    }


def packages() -> dict[str, str]:
    """Return the version of every installed package, by name."""
    found = {
        distribution.metadata["Name"]: distribution.version
        for distribution in importlib.metadata.distributions()
    }
    return dict(sorted(found.items()))


def cpu_model(cpuinfo: Path) -> str:
    """Return the CPU's name as Linux gives it, or the platform module's."""
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or UNKNOWN
