"""The person at the terminal, who may have neither a name nor a home, as a container's user."""

from __future__ import annotations

import getpass
import os
from pathlib import Path

from shared.exceptions import XrlError


def user_name() -> str:
    """Return the user's name, or `uid N` where the system knows none; never raises."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError, ImportError):
        name = ""
    shown = "".join(c for c in name.encode(errors="replace").decode() if c.isprintable())
    return shown or f"uid {os.getuid()}"


def in_home(path: str | Path) -> Path:
    """Return a path with its `~` replaced by a home; XrlError if there is no such home."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise XrlError(
            f"{path}: {user_name()} knows no such home directory; set HOME, or write a whole path"
        ) from None
