"""Fetches the records of a robot's hosts."""

from __future__ import annotations

import re
import tarfile
import tempfile
from pathlib import Path
from typing import Final

from shared.bus.topics import RECORDER
from shared.exceptions import FleetError, RunError
from tools.hosts.layout import RECORDS
from tools.hosts.remote import Remote
from tools.logs.run_index import RunIndex, runs_in

_DATED: Final = re.compile(r"([0-9]{1,12}(?:\.[0-9]{1,12})?) (/.*)")
"""A time, s since 1970, and a folder."""
_PACK: Final = 'tar --warning=no-file-changed -cf - -C "$1" -- "$2"; [ $? -le 1 ]'
"""Ends well also if a file has grown meanwhile: it is then read as far as it is whole."""


def newest(remote: Remote) -> str:
    """Return the name of a host's newest record."""
    listed = remote.must("find", RECORDS, "-name", "*.mcap", "-printf", "%T@ %h\\n", as_user=True)
    rows = [found for line in listed.splitlines() if (found := _DATED.fullmatch(line))]
    if not rows:
        raise FleetError(f"{remote.host.name}: no record in {RECORDS}")
    return _name_in(remote, max(rows, key=lambda row: float(row[1]))[2])


def since(remote: Remote, wall_s: float) -> list[str]:
    """Return the names of a host's records that were written to after a time."""
    words = ("find", RECORDS, "-name", "*.mcap", "-newermt", f"@{wall_s:.0f}", "-printf", "%h\\n")
    listed = remote.must(*words, as_user=True)
    return sorted({_name_in(remote, line) for line in listed.splitlines() if line})


def fetch(remote: Remote, name: str, into: Path) -> Path:
    """Bring one record here; what is still being written comes as far as it is."""
    try:
        into.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=into) as packed:
            remote.fetch("sh", "-c", _PACK, "-", RECORDS, name, into=packed)
            with tarfile.open(fileobj=packed) as archive:
                archive.extractall(into, filter="data")
    except (OSError, tarfile.TarError) as error:
        raise RunError(f"{into}: {remote.host.name}'s {name} is not written: {error}") from None
    return into / name


def is_fleets(remote: Remote) -> bool:
    """Return True for the host whose record is of the whole fleet."""
    return RECORDER in remote.host.services


def fleets_run(folder: Path) -> RunIndex:
    """Return the fleet's newest run in a folder: a recorder that was killed begins another."""
    return RunIndex(folder, runs_in(folder)[-1])


def _name_in(remote: Remote, folder: str) -> str:
    name = folder.rsplit("/", 1)[-1]
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", name):
        raise FleetError(f"{remote.host.name}: {name[:40]!r} is no name of a record")
    return name
