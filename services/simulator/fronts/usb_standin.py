"""Build and load the USB bus of the emulated drives: a stand-in for libusb-1.0.

The genuine `odrive` package finds the emulated drives if the stand-in (`libusb_standin.c`) replaces
the system's libusb-1.0 and `XRL_USB` names the folder of the ports (`FOLDER` in the live
directory). `prepare` returns an environment that does both in another process; `load` loads the
stand-in into this process.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from shared.exceptions import FleetError
from shared.run_directory import live_dir

SOURCE: Final = Path(__file__).with_name("libusb_standin.c")
SONAME: Final = "libusb-1.0.so.0"
"""Name by which libodrive loads libusb."""
FOLDER: Final = "usb"
"""Folder of the ports in the live directory; a port's file name is the drive's serial number."""
VARIABLE: Final = "XRL_USB"
"""Environment variable that names the folder of the ports."""

BUILT: Final = "usb_standin"
"""Folder of the library and the cache in the run directory."""
_COMPILER = "cc"
_COMPILE_S = 60.0


def build(folder: Path) -> Path:
    """Return the path of the stand-in, compiled if it is missing or older than its source.

    Several processes may build it at once, because the finished library is renamed into place.

    Raises:
        FleetError: the C compiler is missing or fails, or the folder cannot be written.
    """
    library = folder / SONAME
    with suppress(OSError):  # missing
        if library.stat().st_mtime >= SOURCE.stat().st_mtime:
            return library
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            made = Path(scratch) / SONAME
            _compile(made)
            made.replace(library)
    except OSError as error:
        raise FleetError(
            f"emulated USB: {folder}: {error.strerror or error}; use a writable folder"
        ) from error
    return library


def load(library: Path) -> None:
    """Load the stand-in into this process, before anything imports `odrive`.

    The package's own library then finds this libusb-1.0 and loads no other. `XRL_USB` must name
    the folder of the ports before the package is first used.
    """
    ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)


def prepare(run_dir: Path) -> dict[str, str]:
    """Return environment variables with which `odrive` in another process finds the drives.

    The stand-in is built in `run_dir`, the run directory of the simulator's fleet.
    """
    library = build(run_dir / BUILT)
    paths = [str(library.parent), os.environ.get("LD_LIBRARY_PATH", "")]
    return {
        "LD_LIBRARY_PATH": os.pathsep.join(filter(None, paths)),
        VARIABLE: str(live_dir(run_dir) / FOLDER),
        # the package's cache of drive descriptors: emulated drives stay out of the home folder
        "XDG_CACHE_HOME": str(library.parent / "cache"),
    }


def clear(run_dir: Path) -> None:
    """Remove the build of `prepare`, and the ports that a killed simulator left."""
    shutil.rmtree(run_dir / BUILT, ignore_errors=True)
    folder = live_dir(run_dir) / FOLDER
    for plug in folder.glob("*"):
        if plug.is_socket():
            plug.unlink(missing_ok=True)
    with suppress(OSError):  # missing, or with other files in it
        folder.rmdir()


def _compile(library: Path) -> None:
    command = [_COMPILER, "-shared", "-fPIC", "-O2", "-Wall", f"-Wl,-soname,{SONAME}"]
    command += ["-o", str(library), str(SOURCE), "-lpthread"]
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=_COMPILE_S, check=False
        )
    except FileNotFoundError:
        wrong = "is not on PATH; install one (Debian, Ubuntu: apt install gcc libc6-dev)"
    except subprocess.TimeoutExpired:
        wrong = f"did not finish {SOURCE.name} within {_COMPILE_S:g} s"
    else:
        if not result.returncode:
            return
        wrong = f"failed on {SOURCE}; it needs C11 and the C library's headers:\n{result.stderr}"
    raise FleetError(
        'emulated USB needs a C compiler (driver = "odrive_can" does not): '
        f"`{_COMPILER}` {wrong.strip()}"
    )
