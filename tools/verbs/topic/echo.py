"""`xrl topic echo`: prints a topic's messages as they arrive."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from enum import IntEnum
from typing import Annotated, Any, Final

import msgspec

from shared.bus.messages import Message
from shared.bus.session import Session, open_session
from shared.exceptions import FAULT_EXIT_CODE, RunError
from shared.mcap_log.schema import ENUMERATIONS
from shared.process import StopFlag
from tools.flags import Arg, Count, Rate, RunDirFlags, Seconds, option, positional
from tools.fleet.supervise import SupervisedFleet
from tools.topic_keys import TopicKey, keys_named

POLL_S: Final = 0.002


EXAMPLES: Final = """
xrl topic echo planner/status --count 1
xrl topic echo 'joint/*/state' --field q --hz 5
xrl topic echo joint/knee_left/event
xrl topic echo harness/wrench --json | jq .force
"""


class EchoFlags(RunDirFlags):
    """Topics to print, and how much of them."""

    topic: Annotated[tuple[str, ...], positional("TOPIC")]
    """topic, such as 'joint/*/state'"""
    field: Annotated[tuple[str, ...], Arg(metavar="NAME")] = ()
    """print only this field; repeatable"""
    hz: Annotated[Rate | None, Arg(metavar="HZ")] = None
    """at most HZ messages per second of each topic and module"""
    count: Annotated[Count | None, Arg(metavar="N")] = None
    """stop after N messages"""
    for_s: Annotated[Seconds | None, option("--for")] = None
    """stop after S seconds"""
    json: bool = False
    """print each message as a line of JSON"""


def run(flags: EchoFlags) -> int:
    """Print until the requested end; return 0 if a message was printed."""
    keys = keys_named(flags.topic)
    for name in flags.field:
        without = [key.name for key in keys if name not in key.topic.type.__struct_fields__]
        if len(without) == len(keys):
            fields = ", ".join(keys[0].topic.type.__struct_fields__)
            raise RunError(
                f"--field {name}: {keys[0].name} has no such field; its fields are {fields}"
            )
    fleet = SupervisedFleet.attach(flags.run_dir)
    robot = fleet.manifest.robot()
    with open_session(robot, "echo", fleet.run.path) as session:
        return 0 if _print(session, keys, flags) else FAULT_EXIT_CODE


def _print(session: Session, keys: list[TopicKey], flags: EchoFlags) -> int:
    """Print the messages; return their number."""
    by_key = {key.topic.key(session.robot, key.module): key for key in keys}
    stream = session.stream(list(by_key))
    stop, printed = StopFlag(), 0
    deadline = None if flags.for_s is None else time.monotonic() + flags.for_s
    due: dict[str, float] = {}
    while not stop and (deadline is None or time.monotonic() < deadline):
        sample = stream.take()
        if sample is None:
            time.sleep(POLL_S)
            continue
        name, payload, _ = sample
        now = time.monotonic()
        if flags.hz is not None and now < due.get(name, 0.0):
            continue
        due[name] = now + (0.0 if flags.hz is None else 1.0 / flags.hz)
        text = as_text(by_key[name], payload, flags.field, as_json=flags.json)
        if text:
            print(text)
            sys.stdout.flush()
            printed += 1
        if flags.count is not None and printed >= flags.count:
            break
    return printed


def as_text(key: TopicKey, payload: bytes, fields: Sequence[str], *, as_json: bool) -> str:
    """Return a message as text; "" if it lacks every requested field.

    A payload that is not a message of the topic's type is described by its size.
    """
    try:
        message = msgspec.json.decode(payload, type=key.topic.type)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return f"{key.name}: {len(payload)} bytes that are not a valid {key.topic.type.__name__}"
    values = {
        name: getattr(message, name)
        for name in message.__struct_fields__
        if not fields or name in fields
    }
    if not values:
        return ""
    if as_json:
        return msgspec.json.encode({"topic": key.name, **values}).decode()
    rows = "".join(f"\n  {name}: {shown(message, name, value)}" for name, value in values.items())
    return f"{key.name}{rows}"


def shown(message: Message, name: str, value: Any) -> str:
    """Return a value in readable form: enumerations by name, numbers rounded."""
    kind: type[IntEnum] | None = ENUMERATIONS.get((type(message), name))
    if kind is not None:
        try:
            return f"{kind(value).name} ({value})"
        except ValueError:
            return f"{value}, which is not a valid {kind.__name__}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Message):
        fields = msgspec.structs.asdict(value).items()
        return " ".join(f"{name} {shown(value, name, part)}" for name, part in fields)
    if isinstance(value, tuple) and value and isinstance(value[0], Message):
        return "".join(f"\n    {shown(message, '', part)}" for part in value)
    if isinstance(value, tuple):
        return "[" + ", ".join(shown(message, "", part) for part in value) + "]"
    return str(value)
