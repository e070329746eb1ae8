"""Optional packages: the extras of pyproject.toml, and the error if a package is missing.

`pip install xrl` installs the packages that a robot needs in operation. A verb that needs others
first calls `require`. A module imports such a package with `late`, so that the module can be
imported without the package.
"""

from __future__ import annotations

import importlib
import importlib.util
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from shared.exceptions import MissingPackageError
from shared.places import CHECKOUT

_PLOT: Final = ("matplotlib", "PIL")

EXTRAS: Final = {
    "sim": ("joblib", "mujoco", "scipy", *_PLOT),
    "plot": _PLOT,
    "design": ("cvxpy", "scipy"),
    "view": ("aiohttp",),
    "ros2": ("rosbags",),
    "usb": ("odrive",),
    "pad": ("sdl2", "sdl2dll"),
    "cluster": ("distributed",),
    "bench": ("cyclonedds", "iceoryx2", "zmq"),
}
"""Packages of each extra, by import name."""

UNLOCKED: Final = frozenset({"bench"})
"""Extras that `requirements.lock` does not contain."""

ON_ROBOTS: Final = frozenset({"ros2", "usb"})
"""Extras for some robots: `./deploy/install --runtime NAME` installs one from its own lock."""


def require(extra: str, otherwise: str = "") -> None:
    """Import the packages of an extra; after an upgrade, the import of an installed one may fail.

    Raises MissingPackageError if a package is not installed or cannot be imported. Its text also
    offers the alternative `otherwise`, if given.
    """
    missing = [name for name in EXTRAS[extra] if not _is_there(name)]
    if missing:
        raise _missing_package(extra, missing, otherwise)
    for name in EXTRAS[extra]:
        _imported(name, otherwise)


def is_installed(extra: str) -> bool:
    """Return True if all packages of an extra are installed."""
    return all(map(_is_there, EXTRAS[extra]))


def _is_there(package: str) -> bool:
    """Return True if a package is installed; a folder of deploy/ that is on the path is not one."""
    found = importlib.util.find_spec(package)
    if found is None or found.origin is not None:
        return found is not None
    folders = found.submodule_search_locations or ()
    return any(Path(folder).resolve().parent != CHECKOUT / "deploy" for folder in folders)


def _missing_package(extra: str, missing: list[str], otherwise: str = "") -> MissingPackageError:
    """Return the error that names packages, their extra and the command that installs it."""
    *others, last = missing
    are, them = ("are", "them") if others else ("is", "it")
    names = f"{', '.join(others)} and {last}" if others else last
    return _error(f"{names} {are} not installed", extra, them, otherwise)


def _error(trouble: str, extra: str, them: str, otherwise: str) -> MissingPackageError:
    if extra not in UNLOCKED and (CHECKOUT / "requirements.lock").is_file():
        command = f"{CHECKOUT}/deploy/install{f' --runtime {extra}' * (extra in ON_ROBOTS)}"
    elif _is_there("pip"):
        command = f"{sys.executable} -m pip install 'xrl[{extra}]'"
    else:  # in an environment of uvx or pipx
        command = f"install 'xrl[{extra}]' in place of 'xrl'"
    return MissingPackageError(
        f"{trouble}; the extra `{extra}` includes {them}: "
        f"{command}{'; or ' if otherwise else ''}{otherwise}"
    )


def _imported(module: str, otherwise: str = "") -> ModuleType:
    """Import a module such as `matplotlib.patches`.

    Raises MissingPackageError if its package is not installed, or with the original message if the
    import fails for another reason, such as mixed versions or a missing system library.
    """
    package = module.partition(".")[0]
    extra = next((extra for extra, names in EXTRAS.items() if package in names), None)
    try:
        return importlib.import_module(module)
    except Exception as error:
        if extra is None:
            raise
        if isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}."):
            raise _missing_package(extra, [package], otherwise) from None
        said = " ".join(str(error).split()) or type(error).__name__
        trouble = f"{package} is installed but cannot be imported: {said}"
        raise _error(trouble, extra, "it", otherwise) from error


def late(module: str) -> Any:
    """Return a stand-in for a module such as `matplotlib.patches`, which its first use imports.

    That use raises MissingPackageError if the package is not installed or cannot be imported.
    """
    return _LateModule(module)


class _LateModule:
    """Stand-in for a module; looks up each name once."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        found = getattr(_imported(self._module), name)
        setattr(self, name, found)
        return found


def libusb_fix() -> str:
    """Return the command or program that installs libusb-1.0.so.0, which `odrive` loads."""
    if shutil.which("apt-get"):
        return "`sudo apt-get install libusb-1.0-0`"
    if shutil.which("dnf"):
        return "`sudo dnf install libusb1`"
    return "your package manager (Debian: libusb-1.0-0, Fedora: libusb1)"
