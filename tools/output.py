"""Helpers for verbs that show progress or write files."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from rich.progress import Progress

from shared.atomic_file import atomic_file, replace_file
from shared.exceptions import RunError
from shared.extras import require
from tools.terminal import Console

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Picture: TypeAlias = "Figure"
"""A Matplotlib figure."""
_EXPORTED: Collection[str] = (".csv", ".mcap", ".yaml")
"""Suffixes of the files that an export writes."""


@contextlib.contextmanager
def progress_along(what: str, length_s: float) -> Iterator[Callable[[float], None]]:
    """Show progress on a terminal; yield a function that receives the run's time reached, s."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as shown:
        bar = shown.add_task(what, total=length_s)
        yield lambda done_s: shown.update(bar, completed=done_s)


def make_folder(out: Path | None, verb: str) -> Path:
    """Make the folder for a verb's pictures; the default is `out/VERB-<time>`."""
    out = out if out is not None else Path("out") / time.strftime(f"{verb}-%Y%m%d-%H%M%S")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{out}: cannot create it: {error.strerror}; choose another --out") from None
    return out


def refuse_taken(out: Path, record: Path, *, force: bool) -> None:
    """Refuse an output that is the record itself or, without `force`, exists already.

    Raises:
        RunError: with the reason.
    """
    if out.exists() and record.exists() and out.samefile(record):
        raise RunError(f"{out}: this is the record itself; choose another name")
    if out.exists() and not force:
        raise RunError(f"{out}: exists already; remove it, choose another name, or add --force")


@contextlib.contextmanager
def whole_folder(out: Path, record: Path, *, force: bool) -> Iterator[Path]:
    """Yield a path inside a temporary folder, and move the whole folder to `out` at the end.

    With `force`, an earlier export at `out` is replaced. Anything else there is refused.

    Raises:
        RunError: with the reason.
    """
    out, source = out.resolve(), record.resolve()
    if source.is_relative_to(out):
        raise RunError(f"{out}: this folder contains the record itself; choose another name")
    if out.exists():
        _check_replaceable(out, force=force)
    aside = out.with_name(f".{out.name}.part")
    try:
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir(parents=True)
        yield aside / out.name
        if out.exists():
            out.replace(aside / "before")
        (aside / out.name).replace(out)
    except OSError as error:
        why = error.strerror or error
        raise RunError(f"{out}: cannot write it: {why}; choose another folder") from None
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _check_replaceable(out: Path, *, force: bool) -> None:
    if not force:
        raise RunError(f"{out}: exists already; remove it, choose another name, or add --force")
    if not out.is_dir() or out.is_symlink():
        raise RunError(f"{out}: is not a folder; choose another name")
    runs = {"run.mcap", "summary.json", "robot.toml"}
    for path in out.iterdir():
        if path.name in runs or path.is_dir() or path.suffix not in _EXPORTED:
            raise RunError(
                f"{out}: contains {path.name}, which is not part of an export; remove it, or "
                "choose another name"
            )


def write_atomically(out: Path, content: bytes, *, private: bool = False) -> None:
    """Write a file whole or not at all."""
    if out.exists() and not out.is_file():
        raise RunError(f"{out}: is not a regular file; choose another -o")
    try:
        replace_file(out, content, private=private)
    except OSError as error:
        raise RunError(f"{out}: cannot write it: {error.strerror}; choose another -o") from None


def new_figure(width: float, height: float, dpi: int = 110) -> Picture:
    """Return an empty Matplotlib figure with automatic layout."""
    require("plot")
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second, and needs the extra

    return Figure(figsize=(width, height), dpi=dpi, layout="constrained")


def save_figure(figure: Picture, path: Path) -> None:
    """Write a Matplotlib figure whole or not at all; the suffix selects the format."""
    with atomic_file(path) as file:
        figure.savefig(file, format=path.suffix.removeprefix("."))
