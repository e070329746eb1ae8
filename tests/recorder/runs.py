"""Runs for the tests: sample messages, a source in memory, files written from it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
from msgspec import inspect

from services.recorder.mcap_log import RunWriter
from shared import codec, topics
from shared.messages import JointState, Message
from shared.topics import Topic

ROBOT = "lab"
OFFSET_NS = 1_700_000_000_000_000_000
METADATA = {"run": {"robot": ROBOT, "schema_version": "1"}, "packages": {"xrl": "0"}}
ATTACHMENTS = {"robot.toml": b'name = "lab"\n', "model.xml": b"<mujoco/>"}
STATE_KEY = topics.JOINT_STATE.key(ROBOT, "knee_right")


class Queue:
    """A source that gives what it was given."""

    def __init__(self, items: Iterable[tuple[str, bytes, int]] = ()) -> None:
        self.items = deque(items)

    def take(self) -> tuple[str, bytes, int] | None:
        return self.items.popleft() if self.items else None


def recorded_topics() -> dict[str, Topic]:
    return {key: topic for key, topic in topics.all_keys(ROBOT).items() if topic.recorded}


def sample(message_type: type[Message], **fields: Any) -> Any:
    """Return a message with a value of the right type in every field."""
    info = inspect.type_info(message_type)
    assert isinstance(info, inspect.StructType)
    values = {field.name: _value(field.type) for field in info.fields}
    return msgspec.convert(values | fields, message_type)


def state(seq: int) -> JointState:
    return sample(JointState, seq=seq, t_ns=1_000_000 * seq, q=(seq * 0.001, -0.37))


def item(seq: int, key: str = STATE_KEY) -> tuple[str, bytes, int]:
    return key, codec.encode(state(seq)), 1_000_000 * seq + 500


def writer(directory: Path, chunk_kib: int = 16) -> RunWriter:
    return RunWriter(
        directory,
        recorded_topics(),
        offset_ns=OFFSET_NS,
        metadata=METADATA,
        attachments=ATTACHMENTS,
        chunk_kib=chunk_kib,
    )


def write(directory: Path, items: Iterable[tuple[str, bytes, int]]) -> Path:
    """Write a finished file and return its path."""
    with writer(directory) as run:
        run.take_from(Queue(items), 1_000_000)
    return run.path


def _value(info: inspect.Type) -> Any:
    if isinstance(info, inspect.TupleType):
        return [_value(member) for member in info.item_types]
    values = {
        inspect.BoolType: True,
        inspect.IntType: 1,
        inspect.FloatType: 0.25,
        inspect.StrType: "word",
    }
    return values[type(info)]
