"""Recorder: `python -m services.recorder --out DIR` writes DIR/run.mcap until stopped.

An existing file is never touched: the new one is then run-1.mcap, run-2.mcap, ...
SIGTERM and SIGINT finish the file; after SIGKILL what was flushed is readable.
"""

from __future__ import annotations

import argparse
import logging
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from services.recorder import provenance
from services.recorder.mcap_log import FILE_NAME, SCHEMA_VERSION, RunWriter, Source
from shared import gain_schedule, log, topics
from shared.bus import open_session
from shared.clock import NS_PER_MS, NS_PER_S, now_ns
from shared.config import load
from shared.config_sections import RecorderConfig
from shared.exceptions import ConfigError, RunError
from shared.priority import raise_priority
from shared.process import StopFlag, run_service, service_parser

FIFO_PRIORITY: Final = 5
"""Below every control service, above what has no such priority: a starved recorder's
messages are dropped by their senders before they reach its queue."""

CAPACITY: Final = 65_536
"""Messages that may wait while the disk is slow: 13 s of the fleet."""

DRAIN_PERIOD_S: Final = 0.02
"""Bounds how late `log_time` is. 5, 10 and 20 ms cost the same CPU at 5000 messages/s."""

LAST_WORDS_S: Final = 0.1
"""After a stop, for what other stopping services still have to say."""

REPORT_PERIOD_S: Final = 10.0


class Deadline:
    """True once per period."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._due_ns = now_ns() + period_ns

    def passed(self, now: int) -> bool:
        """Return True, and begin the next period, if this one is over."""
        if now < self._due_ns:
            return False
        self._due_ns = now + self._period_ns
        return True


def record(
    source: Source,
    writer: RunWriter,
    config: RecorderConfig,
    stop: StopFlag,
    logger: logging.Logger,
) -> None:
    """Write what comes until `stop`, then what is left.

    Raises:
        RunError: the file cannot be written.
    """
    flush = Deadline(int(config.flush_ms * NS_PER_MS))
    sync = Deadline(int(config.fsync_s * NS_PER_S))
    report = Deadline(int(REPORT_PERIOD_S * NS_PER_S))
    while not stop:
        writer.take_from(source, CAPACITY)
        now = now_ns()
        if sync.passed(now):
            writer.sync()
        elif flush.passed(now):
            writer.flush()
        if report.passed(now):
            logger.info("%s", summary(writer))
        time.sleep(DRAIN_PERIOD_S)
    writer.take_from(source, CAPACITY)
    time.sleep(LAST_WORDS_S)
    writer.take_from(source, CAPACITY)


def summary(writer: RunWriter) -> str:
    """Return the counts in one line."""
    counts = writer.counts.values()
    line = (
        f"{writer.messages} messages on {sum(1 for c in counts if c.count)} keys, "
        f"{sum(c.missing for c in counts)} missing in {sum(c.gaps for c in counts)} gaps, "
        f"{sum(c.restarts for c in counts)} restarts"
    )
    for what, keys in (("unknown keys", writer.unknown), ("malformed", writer.malformed)):
        if keys:
            line += f"; {sum(keys.values())} left out, {what}: {', '.join(sorted(keys))}"
    return line


def main() -> int:
    """Run the recorder; return the exit code."""
    stop = StopFlag()
    logger = log.setup("recorder")
    arguments = _arguments()
    config = load(arguments.config)
    attachments = _attachments(arguments)
    metadata = _metadata(config.name, arguments)
    recorded = {key: t for key, t in topics.all_keys(config.name).items() if t.recorded}
    granted = raise_priority(FIFO_PRIORITY)
    # The bus before the file: an endpoint that is taken leaves no empty file behind.
    with open_session(config, "recorder", arguments.run_dir) as session:
        stream = session.stream([f"xrl/{config.name}/**"], capacity=CAPACITY)
        try:
            with RunWriter(
                arguments.out,
                recorded,
                offset_ns=time.time_ns() - now_ns(),
                metadata=metadata,
                attachments=attachments,
                chunk_kib=config.recorder.chunk_kib,
            ) as writer:
                if writer.path.name != FILE_NAME:
                    logger.warning("%s exists and is left alone", arguments.out / FILE_NAME)
                what = (len(recorded), writer.path, granted)
                logger.info("recording %d keys to %s, priority %s", *what)
                record(stream, writer, config.recorder, stop, logger)
        except RunError as error:
            logger.error("%s", error)
            return 1
    logger.info("finished %s: %s", writer.path, summary(writer))
    return 0


def _arguments() -> argparse.Namespace:
    parser = service_parser(
        "Record the bus into one MCAP file.", "python -m services.recorder --out out/run"
    )
    parser.add_argument("--out", type=Path, required=True, help=f"directory for {FILE_NAME}")
    parser.add_argument("--scenario", type=Path, help="scenario file, attached as scenario.toml")
    parser.add_argument("--scenario-text", default="", help="what this run is, in words")
    parser.add_argument(
        "--attach",
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="attach a file under a name, for example the generated model (repeatable)",
    )
    return parser.parse_args()


def _attachments(arguments: argparse.Namespace) -> dict[str, bytes]:
    files: dict[str, Path] = {"robot.toml": arguments.config}
    schedule = gain_schedule.path_beside(arguments.config)
    if schedule.is_file():
        files["robot.gains.json"] = schedule
    if arguments.scenario is not None:
        files["scenario.toml"] = arguments.scenario
    for text in arguments.attach:
        name, equals, file = text.partition("=")
        if not (name and equals and file) or name in files:
            raise ConfigError("--attach", "NAME=FILE", repr(text), "a new name, = and a file")
        files[name] = Path(file)
    contents = {}
    for name, path in files.items():
        try:
            contents[name] = path.read_bytes()
        except OSError as error:
            found = f"cannot be read: {error.strerror}"
            raise ConfigError(
                str(path), "(file)", found, f"it is to be attached as {name}"
            ) from None
    return contents


def _metadata(robot: str, arguments: argparse.Namespace) -> dict[str, dict[str, str]]:
    root = Path(__file__).resolve().parents[2]
    run = {
        "schema_version": SCHEMA_VERSION,
        "robot": robot,
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "scenario": arguments.scenario_text,
        "scenario_file": arguments.scenario.name if arguments.scenario else "",
    }
    return {
        "run": run | provenance.code(root) | provenance.machine(),
        "packages": provenance.packages(),
    }


if __name__ == "__main__":
    run_service(main)
