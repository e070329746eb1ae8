"""Where a run comes from: code, packages, machine. Written first into its log.

Two runs can only be expected to agree bit by bit if these do: OpenBLAS picks its
kernels by CPU and thread count (docs/logs.md).
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Final

import msgspec

THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "OPENBLAS_CORETYPE",
    "MKL_NUM_THREADS",
    "ZENOH_RUNTIME",
)
"""Environment variables that change the behaviour of numeric libraries and the bus."""

UNKNOWN: Final = "unknown"

_GIT_TIMEOUT_S: Final = 5.0


def code(root: Path) -> dict[str, str]:
    """Return `git_commit` and `git_dirty` ("true"/"false") of a checkout.

    Both are "unknown" if `root` is not the top of a git checkout with a commit, or if
    git is not there: an installed wheel inside somebody else's checkout is not that
    checkout.
    """
    unknown = {"git_commit": UNKNOWN, "git_dirty": UNKNOWN}
    top = _git(root, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != root.resolve():
        return unknown
    commit = _git(root, "rev-parse", "--verify", "HEAD")
    changes = _git(root, "status", "--porcelain")
    if commit is None or changes is None:
        return unknown
    return {"git_commit": commit, "git_dirty": "true" if changes else "false"}


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


def _git(root: Path, *arguments: str) -> str | None:
    """Return what git says, or None if it fails for any reason."""
    try:
        done = subprocess.run(
            ("git", "-C", str(root), *arguments),
            capture_output=True,
            text=True,
            timeout=_GIT_TIMEOUT_S,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
