"""Where this project's own files are, which robot file is meant, and who the user is.

In a checkout its data files lie in `deploy/`. A wheel has the same files in `shared/files/`
(`deploy/build_hook.py`); then there is no source tree around the packages, and no git. The user may
have neither a name nor a home, as a container's.
"""

from __future__ import annotations

import getpass
import os
import sys
from pathlib import Path
from typing import Final

from shared.exceptions import ConfigError, RunError, XrlError

CHECKOUT: Final = Path(__file__).resolve().parents[1]
"""Top of this checkout; where the packages are installed, the folder that holds them."""

_INSTALLED: Final = Path(__file__).resolve().with_name("files")
IS_CHECKOUT: Final = not _INSTALLED.is_dir()
FILES: Final = CHECKOUT / "deploy" if IS_CHECKOUT else _INSTALLED
"""Folder of the files as shipped: robot file, gain schedule, process table, scenarios, settings."""
DEFAULT_CONFIG: Final = FILES / "robot.toml"
"""The robot file as shipped."""
SCENARIOS: Final = FILES / "scenarios"

ROBOT_FILE: Final = "robot.toml"
"""Name of a robot file that is taken from the working directory without `--config`."""
NOT_NAMED: Final = "\0"
"""Default of `--config` on a command line: text that no argument can be."""
HELP: Final = f"robot file (default: {ROBOT_FILE} of the working directory, else as shipped)"


def need_checkout(what: str) -> None:
    """Refuse what needs the source tree or git: RunError where XRL runs from an installed wheel."""
    if not IS_CHECKOUT:
        raise RunError(
            f"{what} needs a checkout of XRL, and this is a wheel installed in {CHECKOUT}; "
            "run it in a clone of the repository, after ./deploy/install"
        )


def refuse_shipped(path: Path) -> None:
    """Refuse to write into the files of an installed wheel: the next install would replace them."""
    if not IS_CHECKOUT and path.resolve().is_relative_to(FILES):
        raise RunError(
            f"{path}: is the robot as shipped, and stays so; `xrl new DIR` makes one to be changed"
        )


def robot_file(given: Path | None = None) -> Path:
    """Return which robot file is meant; says on stderr which one it found.

    What `--config` gave as it is, else `robot.toml` of the working directory (absolute), else the
    shipped one. Raises ConfigError as `robot_file_here`.
    """
    found = given or robot_file_here()
    if found is None:
        return DEFAULT_CONFIG
    if given is None:
        sys.stderr.write(f"config: ./{ROBOT_FILE}\n")
    return found


def robot_file_here() -> Path | None:
    """Return `robot.toml` of the working directory, absolute; None if it is not there or shipped.

    A link that leads nowhere counts: the shipped robot must not stand in for a file that is lost.
    Raises ConfigError if it belongs to another user, who could choose the robot for whoever works
    here.
    """
    if not os.path.lexists(ROBOT_FILE):
        return None
    path = Path.cwd() / ROBOT_FILE
    if path.exists():
        if path.samefile(DEFAULT_CONFIG):
            return None
        if path.stat().st_uid not in (os.getuid(), 0):
            right = f"--config {ROBOT_FILE} takes it, or work in another directory"
            raise ConfigError(str(path), "(file)", "belongs to another user", right)
    return path


def config_argument(text: str) -> Path:
    """Return the robot file for the text of `--config`, or for `NOT_NAMED`."""
    return robot_file(None if text == NOT_NAMED else Path(text))


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
