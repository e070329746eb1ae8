"""Locations of this project's own files, the robot file in use, and the user's name and home.

In a checkout the data files are in `deploy/`. A wheel has the same files in `shared/files/`
(`deploy/build_hook.py`), without a source tree around the packages and without git. The user may
have neither a name nor a home, for example in a container.
"""

from __future__ import annotations

import getpass
import os
import sys
from pathlib import Path
from typing import Final

from shared.exceptions import ConfigError, RunError, XrlError

CHECKOUT: Final = Path(__file__).resolve().parents[1]
"""Top of this checkout, or the folder that contains the installed packages."""

_INSTALLED: Final = Path(__file__).resolve().with_name("files")
IS_CHECKOUT: Final = not _INSTALLED.is_dir()
FILES: Final = CHECKOUT / "deploy" if IS_CHECKOUT else _INSTALLED
"""Folder of the shipped files: robot file, gain schedule, process table, scenarios, settings."""
DEFAULT_CONFIG: Final = FILES / "robot.toml"
"""The robot file as shipped."""
SCENARIOS: Final = FILES / "scenarios"

ROBOT_FILE: Final = "robot.toml"
"""Name of the robot file that is used from the working directory without `--config`."""
NOT_NAMED: Final = "\0"
"""Default of `--config`: a text that no argument can contain."""
HELP: Final = f"robot file (default: {ROBOT_FILE} in the working directory, else the shipped one)"


def need_checkout(what: str) -> None:
    """Raise RunError if XRL runs from an installed wheel: `what` needs the source tree or git."""
    if not IS_CHECKOUT:
        raise RunError(
            f"{what} needs a checkout of XRL, but this is a wheel installed in {CHECKOUT}; "
            "run it in a clone of the repository, after ./deploy/install"
        )


def refuse_shipped(path: Path) -> None:
    """Refuse to write into the files of an installed wheel: the next install would replace them."""
    if not IS_CHECKOUT and path.resolve().is_relative_to(FILES):
        raise RunError(
            f"{path}: is the shipped robot, which must not change; make your own with `xrl new DIR`"
        )


def robot_file(given: Path | None = None) -> Path:
    """Return the robot file in use; report it on stderr if found in the working directory.

    It is the file given by `--config`, else `robot.toml` of the working directory (absolute), else
    the shipped one. Raises ConfigError as `robot_file_here` does.
    """
    found = given or robot_file_here()
    if found is None:
        return DEFAULT_CONFIG
    if given is None:
        sys.stderr.write(f"config: ./{ROBOT_FILE}\n")
    return found


def robot_file_here() -> Path | None:
    """Return `robot.toml` of the working directory, absolute; None if it is missing or shipped.

    A dangling link counts as a file, because the shipped robot must not replace a lost one. Raises
    ConfigError if it belongs to another user, who could choose the robot for anyone working here.
    """
    if not os.path.lexists(ROBOT_FILE):
        return None
    path = Path.cwd() / ROBOT_FILE
    if path.exists():
        if path.samefile(DEFAULT_CONFIG):
            return None
        if path.stat().st_uid not in (os.getuid(), 0):
            right = f"use it with --config {ROBOT_FILE}, or work in another directory"
            raise ConfigError(str(path), "(file)", "belongs to another user", right)
    return path


def config_argument(text: str) -> Path:
    """Return the robot file for the text of `--config`, or for `NOT_NAMED`."""
    return robot_file(None if text == NOT_NAMED else Path(text))


def user_name() -> str:
    """Return the user's name, or `uid N` if it is unknown; never raises."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError, ImportError):
        name = ""
    shown = "".join(c for c in name.encode(errors="replace").decode() if c.isprintable())
    return shown or f"uid {os.getuid()}"


def in_home(path: str | Path) -> Path:
    """Return a path with its `~` replaced by a home; raise XrlError if that is unknown."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise XrlError(
            f"{path}: home directory not found for {user_name()}; set HOME, or use an absolute path"
        ) from None
