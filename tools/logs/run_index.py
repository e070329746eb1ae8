"""What a run's files hold and where, without their messages.

A record of an hour has 2 GiB and, read whole, ten times that in memory. So its files are skimmed
once, and `tools/logs/run_log.py` reads the parts that are needed.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

from shared.exceptions import RunError
from shared.mcap_log.reader import LogRecord, LostBytes
from shared.mcap_log.writer import SCHEMA_VERSION
from shared.text_file import decoded
from tools.logs.host_clocks import hosts_of
from tools.logs.recorded_file import RecordedFile
from tools.logs.run_files import MetadataByName, files_in


class RunIndex:
    """A run's files: what is said about it, and the places of its messages."""

    def __init__(self, path: Path, files: Sequence[Path] = ()) -> None:
        self.path = path
        self.files = list(files) or (files_in(path) if path.is_dir() else [path])
        """The files of the run, in order: several if it was split."""
        self._files = [RecordedFile(file) for file in self.files]
        first = self._files[0]
        self._check_version(first.required("run", "schema_version"))
        self.robot = first.required("run", "robot")
        self.offset_ns = first.offset_ns
        """wall clock in ns since 1970 = `t_ns` of a message + `offset_ns`."""
        spans = [file.span_ns for file in self._files if file.span_ns is not None]
        self.began_ns = min((begin for begin, _ in spans), default=self.offset_ns)
        """Log time of the first message."""
        self.ended_ns = max((end for _, end in spans), default=self.offset_ns)
        """Log time of the last message."""

    @property
    def length_s(self) -> float:
        """Time from the first message to the last."""
        return (self.ended_ns - self.began_ns) / 1e9

    @property
    def metadata(self) -> MetadataByName:
        """Metadata records by name: `run`, `clock`, `packages`, at the end `counts`."""
        return dict(chain.from_iterable(file.metadata.items() for file in self._files))

    @property
    def attachments(self) -> dict[str, bytes]:
        """Attached files by name."""
        return dict(chain.from_iterable(file.attachments.items() for file in self._files))

    @property
    def hosts(self) -> dict[str, str]:
        """Host of each service, by the attached robot file; nothing if that says none."""
        text = self.attachments.get("robot.toml", b"")
        try:
            endpoints = tomllib.loads(decoded(text)).get("bus", {}).get("endpoints", {})
        except (tomllib.TOMLDecodeError, UnicodeError, AttributeError, RecursionError):
            return {}
        return hosts_of(endpoints) if isinstance(endpoints, dict) else {}

    @property
    def complete(self) -> bool:
        """True if the recorder finished every file; False if it was killed."""
        return all(file.finished for file in self._files)

    @property
    def damage(self) -> list[LostBytes]:
        """Places that could not be read, as far as they have been read: left out."""
        return [loss for file in self._files for loss in file.damage]

    @property
    def cut(self) -> LostBytes | None:
        """What follows the last whole record of a file that was cut off."""
        return next((file.cut for file in reversed(self._files) if file.cut is not None), None)

    def records(
        self, begin_ns: int, end_ns: int, keys: frozenset[str] | None = None
    ) -> Iterator[tuple[LogRecord, dict[int, str]]]:
        """Yield those chunks of all files, each with the full keys of its channels."""
        for file in self._files:
            for record in file.records(begin_ns, end_ns, keys):
                yield record, file.keys

    def _check_version(self, version: str) -> None:
        if version != SCHEMA_VERSION:
            raise RunError(
                f"{self.path}: the log has schema version {version}, and this code reads "
                f"{SCHEMA_VERSION}: read it with the checkout that wrote it"
            )
