"""Runs the bench in this tree and in another revision's, in turn.

The other revision is unpacked into a temporary folder. This tree's `tools/lab/bench` is laid over
it, so both are measured by the same code.
"""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TypeAlias

import msgspec

from shared.exceptions import RunError
from shared.places import CHECKOUT, need_checkout
from tools.lab.bench.table import AgainstFlags
from tools.lab.bench.worker import Answer, Request

_BENCH: Final = "tools/lab/bench"
PATIENCE_S: Final = 10.0
"""Time for a worker to end."""


@contextmanager
def unpacked(revision: str) -> Iterator[Path]:
    """Yield a folder with the tree of a git revision and this tree's bench.

    Raises:
        RunError: this is no checkout, git is missing, or it knows no such revision.
    """
    need_checkout("--against")
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
            safe = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # from 3.11.4 on
            archive.extractall(tree, **safe)  # type: ignore[arg-type]  # noqa: S202 - git's own
        shutil.rmtree(tree / _BENCH, ignore_errors=True)
        shutil.copytree(
            CHECKOUT / _BENCH, tree / _BENCH, ignore=shutil.ignore_patterns("__pycache__")
        )
        if (tree / "tools/graph_libraries.py").is_file():
            command = [sys.executable, "-m", "tools.graph_libraries"]
            subprocess.run(command, cwd=tree, env=environment(tree), check=False)
        yield tree


def its_config(config: Path, tree: Path) -> Path:
    """Return the robot file for another tree: its own version of one that lies in this checkout."""
    return tree / config.relative_to(CHECKOUT) if config.is_relative_to(CHECKOUT) else config


@contextmanager
def trees(flags: AgainstFlags) -> Iterator[list[tuple[Path, Path]]]:
    """Yield this tree and the other, each with its own version of the robot file."""
    here = (CHECKOUT, flags.config.resolve())
    if flags.against is None:
        yield [here]
        return
    with unpacked(flags.against) as other:
        yield [here, (other, its_config(here[1], other))]


def environment(tree: Path) -> dict[str, str]:
    """Return the environment in which processes import from a source tree."""
    return os.environ | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}


Ask: TypeAlias = Callable[[Request], Answer]


@contextmanager
def worker(tree: Path, config: Path) -> Iterator[Ask]:
    """Start a tree's bench in a process of its own; yield what has it measure.

    The others wait meanwhile. What is asked raises `RunError` if the process ended.
    """
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            [sys.executable, "-m", "tools.lab.bench.worker", str(config)],
            cwd=tree, env=environment(tree), text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
        ) as process,
    ):  # fmt: skip

        def ask(request: Request) -> Answer:
            assert process.stdin is not None  # noqa: S101 - both are pipes
            assert process.stdout is not None  # noqa: S101
            try:
                process.stdin.write(msgspec.json.encode(request).decode() + "\n")
                process.stdin.flush()
                line = process.stdout.readline()
            except BrokenPipeError:
                line = ""
            if not line:
                code = process.wait()
                errors.seek(0)
                last = (errors.read().strip().splitlines() or ["it said nothing"])[-1]
                raise RunError(f"{tree}: the bench ended with {code}: {last}")
            return msgspec.json.decode(line, type=Answer)

        try:
            yield ask
        finally:  # it removes its files once its input ends
            try:
                process.communicate(timeout=PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
