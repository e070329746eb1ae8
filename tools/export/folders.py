"""A folder that is there whole or not at all, and takes nothing of anybody's away."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path

from shared.exceptions import RunError

OWN: Collection[str] = (".csv", ".parquet", ".mcap", ".yaml")
"""Endings of the files that an export writes."""


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
        if path.name in runs or path.is_dir() or path.suffix not in OWN:
            raise RunError(
                f"{out}: {path.name} in it is not of an export; remove it yourself, or give "
                "another name"
            )
