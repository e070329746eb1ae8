"""A host's bundle: certificates and keys of what it runs, and never the authority's key."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterable
from pathlib import Path

from shared.atomic_file import replace_file
from shared.bus import credentials
from shared.bus.credentials import certificate_file, key_file
from shared.exceptions import BusError
from tools.keys.authority import Authority


def bundle(authority: Authority, names: Iterable[str]) -> dict[str, bytes]:
    """Return the files of a bundle by their names."""
    folder = authority.folder
    files = {
        credentials.AUTHORITY: authority.certificate,
        credentials.NAMES: credentials.to_toml(authority.names),
    }
    for name in names:
        if name not in authority.names.generations:
            right = f"one of {', '.join(authority.names.generations)}"
            raise BusError(f"{name!r} has no certificate here; {right}")
        for file in (certificate_file(folder, name), key_file(folder, name)):
            try:
                files[file.name] = file.read_bytes()
            except OSError as error:
                raise BusError(f"{file}: {error.strerror}; `xrl keys renew {name}`") from None
    return files


def to_tar(files: dict[str, bytes]) -> bytes:
    """Return a tar file that unpacks into one folder, each file its owner's alone."""
    written = io.BytesIO()
    with tarfile.open(fileobj=written, mode="w") as tar:
        for name, content in files.items():
            entry = tarfile.TarInfo(f"keys/{name}")
            entry.size, entry.mode = len(content), 0o600
            tar.addfile(entry, io.BytesIO(content))
    return written.getvalue()


def held_files(folder: Path) -> list[str]:
    """Return the names of the certificates and keys in a folder."""
    return sorted(path.name for path in folder.iterdir() if path.suffix in (".pem", ".key"))


def install(files: dict[str, bytes], folder: Path) -> None:
    """Write a bundle into this host's folder of keys, and take away keys that are not in it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        for name, content in files.items():
            replace_file(folder / name, content, private=True)
        for old in set(held_files(folder)) - set(files):
            (folder / old).unlink()
    except OSError as error:
        raise BusError(f"{folder}: cannot be written: {error.strerror}") from None
