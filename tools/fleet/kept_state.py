"""State of the joint services that survives a power cut: emergency stops and temperatures.

The services write it only to memory in the live directory, because a store to a mapped file on a
failing disk can end the process (SIGBUS). The supervisor copies it to the run directory every 5 s,
and the next start reads it there. If the disk rejects writes, only the copy is missing.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from shared.run_directory import live_dir, open_private

STOPS: Final = "*.rearm"
HEAT: Final = "*.heat"


def save(run_dir: Path) -> bool:
    """Copy changes from the live directory to the run directory; False if that fails."""
    return _copy(live_dir(run_dir), run_dir, replace=True)


def restore(run_dir: Path) -> None:
    """Copy files from the run directory that the live directory lacks, as after a power cut."""
    _copy(run_dir, live_dir(run_dir), replace=False)


def _copy(source: Path, target: Path, *, replace: bool) -> bool:
    whole = True
    for file in (file for pattern in (STOPS, HEAT) for file in source.glob(pattern)):
        copy = target / file.name
        try:
            data = file.read_bytes()
            if copy.exists() and (not replace or copy.read_bytes() == data):
                continue
            with open_private(copy) as opened:
                os.pwrite(opened.fileno(), data, 0)  # in place, so that it is never empty
        except OSError:
            whole = False
    return whole


def forget_stops(run_dir: Path) -> None:
    """Remove the emergency stops from the run directory; OSError if the disk rejects it."""
    for file in run_dir.glob(STOPS):
        file.unlink(missing_ok=True)
