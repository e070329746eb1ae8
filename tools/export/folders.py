"""A folder that is there whole or not at all."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from shared.exceptions import RunError


@contextlib.contextmanager
def whole_folder(out: Path, *, force: bool) -> Iterator[Path]:
    """Yield a path of the same name for what is to be in a folder; it is moved there at the end.

    Args:
        out: the folder.
        force: replace what is there; else it is refused.

    Raises:
        RunError: it exists, or it cannot be written.
    """
    if out.exists() and not force:
        raise RunError(f"{out}: exists already; remove it, give another name, or --force")
    if out.exists() and not out.is_dir():
        raise RunError(f"{out}: is no folder; give another name")
    aside = out.with_name(f".{out.name}.part")
    try:
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir(parents=True)
        yield aside / out.name
        if out.exists():
            shutil.rmtree(out)
        (aside / out.name).replace(out)
    except OSError as error:
        raise RunError(f"{out}: cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(aside, ignore_errors=True)
