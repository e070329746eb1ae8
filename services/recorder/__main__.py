"""Recorder: `python -m services.recorder --out DIR` writes DIR/run.mcap until stopped.

A run never replaces a file: if run.mcap exists, the run is named run-1.mcap, run-2.mcap, ...
`[recorder]` of the robot file sets when a long run is split into run.mcap, run_1.mcap, ... The
recorder also recovers unfinished files of earlier recorders in DIR. SIGTERM and SIGINT finish the
file. After SIGKILL the next recorder, or `xrl log recover`, recovers the flushed messages.

With --of it records only the named services of its own host, and continues if the network to the
fleet's recorder is cut.
"""

from __future__ import annotations

import argparse
import logging
import os
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from services.recorder.auto_recover import AutoRecovery
from services.recorder.host_watch import MIB, Roster, RunDirWatch, free_bytes_at
from services.recorder.loop import Recorder, summary
from shared import log, revision, scheduling
from shared.bus import topics
from shared.bus.session import open_session
from shared.clock import keep_pace, now_ns, pace
from shared.config import gain_schedule
from shared.config.files import load, wearer_path
from shared.config.robot_config import SERVICES
from shared.config.sections import RecorderConfig
from shared.exceptions import ConfigError, RunError
from shared.mcap_log import provenance
from shared.mcap_log.files import FIRST
from shared.mcap_log.writer import SCHEMA_VERSION, RunWriter
from shared.process import StopFlag, run_service, service_parser

DRAIN_PERIOD_S: Final = 0.02
"""Period of the recorder's cycles, s. Together with the 20 ms of a batch, it limits the delay of
`log_time`. 5, 10 and 20 ms cost the same CPU time."""

LAST_WORDS_S: Final = 0.1
"""Time after a stop for which the last messages of other stopping services are recorded, s."""


def main() -> int:
    """Run the recorder; return the exit code."""
    os.umask(0o027)  # the group may read a record, but not change it
    stop = StopFlag()
    logger = log.setup("recorder")
    arguments = _arguments()
    config = load(arguments.config)
    keep_pace(arguments.run_dir)
    attachments = _attachments(arguments)
    metadata = _metadata(config.name, arguments, config.recorder)
    recorded = _recorded(config.name, arguments.of)
    granted = scheduling.apply("recorder")
    # Open the bus before the file: if the endpoint is in use, no empty file is left behind.
    name = topics.HOST_RECORDER if arguments.of else topics.RECORDER
    with open_session(config, name, arguments.run_dir, only=arguments.of) as session:
        stream = session.recording()
        auto_recovery = AutoRecovery(arguments.out, config.recorder.free_min_mib * MIB, logger)
        try:
            with RunWriter(
                arguments.out,
                recorded,
                offset_ns=time.time_ns() - now_ns(),
                metadata=metadata,
                attachments=attachments,
                chunk_kib=config.recorder.chunk_kib,
                begin=False,
            ) as writer:
                recording = Recorder(
                    stream, writer, config.recorder, logger,
                    free_bytes=lambda: free_bytes_at(arguments.out), now_ns=now_ns(),
                )  # fmt: skip
                logger.info("%s, priority %s", _about(writer, len(recorded)), granted)
                auto_recovery.start()
                roster = None if arguments.of else Roster(session)
                host = RunDirWatch(arguments.run_dir, logger, now_ns())
                _record(recording, stop, roster, host)
        except RunError as error:
            logger.error("%s", error)
            return error.exit_code
        finally:
            auto_recovery.halt()
    return _tell_end(writer, recording, summary(writer, stream), logger)


def _tell_end(writer: RunWriter, recording: Recorder, counts: str, logger: logging.Logger) -> int:
    """Log the counts; return the exit code, which is 2 if a file was removed."""
    what = f"finished {writer.path}" if writer.path.exists() else "nothing written"
    logger.info("%s: %s", what, counts)
    if recording.removed_files:
        logger.error(
            "removed while being written: %d of %d files, with %d of the messages",
            recording.removed_files, writer.begun, recording.removed_messages,
        )  # fmt: skip
        return RunError.exit_code
    return 0


def _recorded(robot: str, of: tuple[str, ...] | None) -> dict[str, topics.Topic]:
    """Return the keys to record with their topics: all, or those that the services `of` write."""
    wanted = (
        None if of is None else {key for name in of for key in topics.written_keys(robot, name)}
    )
    return {
        key: topic
        for key, topic in topics.recorded_keys(robot).items()
        if wanted is None or key in wanted
    }


def _record(
    recording: Recorder,
    stop: StopFlag,
    roster: Roster | None,
    host: RunDirWatch,
) -> None:
    while not stop:
        now = now_ns()
        if roster is not None:
            roster.put_if_due(now, tuple(filter(None, (recording.trouble, host.trouble))))
        recording.cycle(now)
        host.check_if_due(now)
        time.sleep(DRAIN_PERIOD_S)
    recording.close()
    time.sleep(LAST_WORDS_S)
    recording.close()


def _about(writer: RunWriter, keys: int) -> str:
    if not writer.recording:
        return f"waiting for disk space to record {keys} keys"
    beside = "" if writer.path.name == FIRST else f" ({FIRST} exists already and is kept)"
    return f"recording {keys} keys to {writer.path}{beside}"


def _arguments() -> argparse.Namespace:
    parser = service_parser(
        "Record the bus to MCAP files.", "python -m services.recorder --out out/run"
    )
    parser.add_argument("--out", type=Path, required=True, help=f"directory for {FIRST}")
    parser.add_argument(
        "--of",
        type=_services,
        metavar="SERVICE,...",
        help="record only these services of this host; the fleet's recorder runs on another host",
    )
    parser.add_argument("--scenario", type=Path, help="scenario file, attached as scenario.toml")
    parser.add_argument("--scenario-text", default="", help="description of this run")
    parser.add_argument(
        "--attach",
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="attach a file under a name, for example the generated model (repeatable)",
    )
    return parser.parse_args()


def _services(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in SERVICES:
            right = f"use one of {', '.join(SERVICES)}"
            raise argparse.ArgumentTypeError(f"unknown service {name!r}; {right}")
    return names


def _attachments(arguments: argparse.Namespace) -> dict[str, bytes]:
    files: dict[str, Path] = {"robot.toml": arguments.config}
    beside = {
        "robot.gains.json": gain_schedule.path_beside(arguments.config),
        "robot.wearer.toml": wearer_path(arguments.config),
    }
    files |= {name: path for name, path in beside.items() if path.is_file()}
    if arguments.scenario is not None:
        files["scenario.toml"] = arguments.scenario
    for text in arguments.attach:
        name, equals, file = text.partition("=")
        if not (name and equals and file) or name in files:
            raise ConfigError("--attach", "NAME=FILE", repr(text), "use NAME=FILE, with a new NAME")
        files[name] = Path(file)
    contents = {}
    for name, path in files.items():
        try:
            contents[name] = path.read_bytes()
        except OSError as error:
            found = f"cannot be read: {error.strerror}"
            raise ConfigError(
                str(path), "(file)", found, f"give a readable file to attach as {name}"
            ) from None
    return contents


def _metadata(
    robot: str, arguments: argparse.Namespace, config: RecorderConfig
) -> dict[str, dict[str, str]]:
    run = {
        "schema_version": SCHEMA_VERSION,
        "robot": robot,
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "pace": f"{pace():g}",
        "scenario": arguments.scenario_text,
        "scenario_file": arguments.scenario.name if arguments.scenario else "",
        "of": ",".join(arguments.of or ()),
    }
    return {
        "run": run | revision.code() | provenance.machine(),
        "packages": provenance.packages(),
        "recorder": {
            "flush_ms": f"{config.flush_ms:g}",
            "fsync_s": f"{config.fsync_s:g}",
        },
    }


if __name__ == "__main__":
    run_service(main)
