"""Origin of a run: packages and machine; `shared.revision` has the commit.

Two runs can be expected to agree bit by bit only if these agree: OpenBLAS picks its kernels by CPU
and thread count (docs/logs.md).
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
    """Return Python's version, the platform, processor, C library and `THREAD_VARIABLES` (JSON)."""
    threads = {name: os.environ[name] for name in THREAD_VARIABLES if name in os.environ}
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "architecture": platform.machine() or UNKNOWN,
        "libc": " ".join(platform.libc_ver()).strip() or UNKNOWN,
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
    """Return the CPU's name as Linux reports it, or else as the `platform` module does.

    On Arm, Linux reports only numbers: the maker and the part of each core. Each pair is returned
    once.
    """
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    rows = [(name.strip(), value.strip()) for name, _, value in (x.partition(":") for x in lines)]
    names = (value for name, value in rows if name == "model name")
    makers = (value for name, value in rows if name == "CPU implementer")
    parts = (value for name, value in rows if name == "CPU part")
    cores = sorted({f"{maker} part {part}" for maker, part in zip(makers, parts, strict=False)})
    return next(names, "") or ", ".join(cores) or platform.processor() or UNKNOWN
