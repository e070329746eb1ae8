"""What verbs have in common when they print or write."""

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
"""One of Matplotlib's."""
_EXPORTED: Collection[str] = (".csv", ".mcap", ".yaml")
"""Endings of the files that an export writes."""


@contextlib.contextmanager
def progress_along(what: str, length_s: float) -> Iterator[Callable[[float], None]]:
    """Show on a terminal how much of a run is done; the callable takes its time in s."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as shown:
        bar = shown.add_task(what, total=length_s)
        yield lambda done_s: shown.update(bar, completed=done_s)


def make_folder(out: Path | None, verb: str) -> Path:
    """Make the folder of a verb's pictures; without a name, `out/VERB-<time>`."""
    out = out if out is not None else Path("out") / time.strftime(f"{verb}-%Y%m%d-%H%M%S")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{out}: cannot be made: {error.strerror}; choose another --out") from None
    return out


def refuse_taken(out: Path, record: Path, *, force: bool) -> None:
    """Refuse an output that is the record itself or, without `--force`, that exists.

    Raises:
        RunError: saying which.
    """
    if out.exists() and record.exists() and out.samefile(record):
        raise RunError(f"{out}: is the record itself, which stays as it is; give another name")
    if out.exists() and not force:
        raise RunError(f"{out}: exists already; remove it, give another name, or --force")


@contextlib.contextmanager
def whole_folder(out: Path, record: Path, *, force: bool) -> Iterator[Path]:
    """Yield a path for what is to be in a folder; it is moved there whole at the end.

    An earlier export is replaced with `force` only, anything else never (RunError).
    """
    out, source = out.resolve(), record.resolve()
    if source.is_relative_to(out):
        raise RunError(f"{out}: the record itself is in it; give another name")
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
        raise RunError(f"{out}: cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _check_replaceable(out: Path, *, force: bool) -> None:
    if not force:
        raise RunError(f"{out}: exists already; remove it, give another name, or --force")
    if not out.is_dir() or out.is_symlink():
        raise RunError(f"{out}: is no folder; give another name")
    runs = {"run.mcap", "summary.json", "robot.toml"}
    for path in out.iterdir():
        if path.name in runs or path.is_dir() or path.suffix not in _EXPORTED:
            raise RunError(
                f"{out}: {path.name} in it is not of an export; remove it yourself, or give "
                "another name"
            )


def write_atomically(out: Path, content: bytes, *, private: bool = False) -> None:
    """Write a file whole or not at all."""
    if out.exists() and not out.is_file():
        raise RunError(f"{out}: is no ordinary file; give another -o")
    try:
        replace_file(out, content, private=private)
    except OSError as error:
        raise RunError(f"{out}: cannot be written: {error.strerror}; give another -o") from None


def new_figure(width: float, height: float, dpi: int = 110) -> Picture:
    """Return an empty picture of Matplotlib, laid out by itself."""
    require("plot")
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second, and needs the extra

    return Figure(figsize=(width, height), dpi=dpi, layout="constrained")


def save_figure(figure: Picture, path: Path) -> None:
    """Write a picture of Matplotlib whole or not at all; the suffix names its format."""
    with atomic_file(path) as file:
        figure.savefig(file, format=path.suffix.removeprefix("."))
