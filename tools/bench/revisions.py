"""Runs rounds of the bench in this tree and in another revision's, in turn.

The other revision is unpacked into a temporary folder. This tree's `tools/bench` is laid over it,
so both are measured by the same code.
"""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import msgspec

from shared.exceptions import RunError
from shared.process import CHECKOUT
from tools.bench.worker import Round

_BENCH: Final = "tools/bench"


@contextmanager
def unpacked(revision: str) -> Iterator[Path]:
    """Yield a folder with the tree of a git revision and this tree's bench.

    Raises:
        RunError: git is missing, or knows no such revision.
    """
    try:
        done = subprocess.run(
            ["git", "archive", "--format=tar", revision],
            check=False,
            cwd=CHECKOUT,
            capture_output=True,
        )
    except FileNotFoundError:
        raise RunError("git is missing; --against needs it to read a revision") from None
    if done.returncode:
        reason = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise RunError(f"{revision}: no git revision here ({' '.join(reason)}); such as HEAD~1")
    with tempfile.TemporaryDirectory(prefix="xrl-bench-") as name:
        tree = Path(name)
        with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
            archive.extractall(tree, filter="data")
        shutil.rmtree(tree / _BENCH, ignore_errors=True)
        shutil.copytree(
            CHECKOUT / _BENCH, tree / _BENCH, ignore=shutil.ignore_patterns("__pycache__")
        )
        yield tree


def run_round(tree: Path, config: Path) -> Round:
    """Measure one round in a tree, in a process of its own.

    Args:
        tree: source tree to import from.
        config: robot file.

    Raises:
        RunError: the process failed.
    """
    environment = os.environ | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "tools.bench.worker", str(config)],
        check=False,
        cwd=tree,
        env=environment,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines()[-1:] or ["it said nothing"]
        raise RunError(f"{tree}: the bench ended with {done.returncode}: {lines[0]}")
    return msgspec.json.decode(done.stdout, type=Round)
