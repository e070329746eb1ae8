"""Page of topics and messages, from `shared.bus.topics` and the message structs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Final, get_args, get_origin, get_type_hints

import msgspec

from shared.bus import messages, topics
from shared.bus.topics import Topic
from shared.bus.traces import Batch
from shared.joints import MODULES
from shared.mcap_log.schema import ENUMERATIONS
from tools.dev.reference.markdown import cell_docs, one_line, summary, table

ENUMS: Final[tuple[type[IntEnum], ...]] = tuple(
    sorted(set(ENUMERATIONS.values()), key=lambda enum: enum.__name__)
)

_INTRODUCTION: Final = """\
# Topics and messages

A topic's key is `xrl/<robot>/<topic>`; `*` stands for a module. Payloads are JSON in SI units; a
suffix such as `_ms` or `_n` (newtons) names the unit. Enumerations are integers. Rates are nominal.
`operator` is any tool that may write. The recorder and tools may read every topic; all
messages are recorded.
"""


def page() -> Iterator[str]:
    """Yield the page in Markdown."""
    yield _INTRODUCTION
    headings = "topic | message | rate | priority | from | to | purpose"
    yield from table(headings, map(_topic_row, topics.TOPICS))
    yield ""
    yield "## Messages\n"
    yield "Each message begins with these fields:\n"
    yield from _fields(messages.Message, own=True)
    for kind in dict.fromkeys(topic.type for topic in topics.TOPICS):
        yield from _message(kind)
    yield "## Enumerations\n"
    for enum in ENUMS:
        yield f"### {enum.__name__}\n"
        yield f"{summary(enum)}\n"
        docs = cell_docs(enum)
        members = ((one.value, f"`{one.name}`", docs.get(one.name, "")) for one in enum)
        yield from table("value | name | meaning", members)
        yield ""


def _topic_row(topic: Topic) -> tuple[str, ...]:
    return (
        f"`{topic.name}`",
        f"[{topic.type.__name__}](#{topic.type.__name__.lower()})",
        f"{topic.rate_hz:g} Hz" if topic.rate_hz else "event",
        topic.priority.name.lower().replace("_", " "),
        _names(topic.writers),
        _names(topic.readers),
        f"{one_line(topic.why)}{' (recorded unpacked)' if topic.type is Batch else ''}",
    )


def _names(names: Sequence[str]) -> str:
    if tuple(names) == MODULES:
        return "all modules"
    return ", ".join("its module" if name == "*" else name for name in names)


def _message(kind: type[msgspec.Struct]) -> Iterator[str]:
    names = ", ".join(f"`{topic.name}`" for topic in topics.TOPICS if topic.type is kind)
    yield f"### {kind.__name__}\n"
    yield f"On {names}. {summary(kind)}\n"
    yield from _fields(kind)
    for part in _parts(kind):
        yield f"### {part.__name__}\n"
        yield f"Part of [{kind.__name__}](#{kind.__name__.lower()}). {summary(part)}\n"
        yield from _fields(part, own=True)


def _parts(kind: type[msgspec.Struct]) -> Iterator[type[msgspec.Struct]]:
    for hint in get_type_hints(kind).values():
        for part in (hint, *get_args(hint)):
            if isinstance(part, type) and issubclass(part, msgspec.Struct):
                yield part


def _fields(kind: type[msgspec.Struct], *, own: bool = False) -> Iterator[str]:
    docs, hints = cell_docs(kind), get_type_hints(kind)
    base = () if own else messages.Message.__struct_fields__
    fields = [name for name in kind.__struct_fields__ if name not in base]
    if not fields:
        yield "No further fields.\n"
        return
    enums = {name: ENUMERATIONS.get((kind, name)) for name in fields}
    types = {
        name: f"[{enum.__name__}](#{enum.__name__.lower()})" if enum else _type(hints[name])
        for name, enum in enums.items()
    }
    rows = ((f"`{name}`", shown, docs.get(name, "")) for name, shown in types.items())
    yield from table("field | type | meaning", rows)
    yield ""


def _type(hint: object) -> str:
    if get_origin(hint) is not tuple:
        return getattr(hint, "__name__", str(hint))
    args = get_args(hint)
    if args[-1] is Ellipsis:
        return f"{_type(args[0])}[]"
    return f"{_type(args[0])}[{len(args)}]"
