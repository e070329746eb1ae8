"""Bus keys by the names that a person types, such as `joint/*/state`.

A name is the part of a key after `xrl/<robot>/`. In a name, `*` stands for any part of one section
(`joint/*/state`), and `**` for any number of sections.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

from shared.bus import topics
from shared.bus.topics import Topic
from shared.bus.traces import Batch
from shared.config.robot_config import SERVICES
from shared.exceptions import RunError
from shared.joints import MODULES

_PARTS: Final = {"**": ".*", "*": "[^/]*"}


class TopicKey(NamedTuple):
    """One key on a robot's bus."""

    topic: Topic
    module: str
    """"" for a topic with one key."""

    @property
    def name(self) -> str:
        """The key without `xrl/<robot>/`, such as `joint/knee_left/state`."""
        return self.topic.name.replace("*", self.module)


def every_key() -> list[TopicKey]:
    """Return every key in order, except those of batches, whose messages have their own keys."""
    return [
        TopicKey(topic, module)
        for topic in topics.TOPICS
        if topic.type is not Batch
        for module in (MODULES if topic.per_module else ("",))
    ]


def _is_named(key: TopicKey, name: str) -> bool:
    parts = re.split(r"(\*\*|\*)", name.strip("/"))
    pattern = "".join(_PARTS.get(part) or re.escape(part) for part in parts)
    return re.fullmatch(pattern, key.name) is not None


def keys_named(names: Sequence[str], left_out: Collection[Topic] = ()) -> list[TopicKey]:
    """Return the keys that match one of these names, in the order of the table of topics.

    Without names, return all keys except those of the topics `left_out`.
    """
    known = every_key()
    for name in names:
        if not any(_is_named(key, name) for key in known):
            rows = ", ".join(topic.name for topic in topics.TOPICS)
            raise RunError(
                f"{name}: no topic has this name; the topics are {rows}; * stands for any "
                "part between slashes, ** also for text with slashes"
            )
    if not names:
        return [key for key in known if key.topic not in left_out]
    return [key for key in known if any(_is_named(key, name) for name in names)]


def sender_of(topic: Topic, module: str = "") -> str:
    """Return the service that publishes a topic, or "" if tools on any host publish it."""
    if topic.writers == ("*",):
        return module
    return topic.writers[0] if len(topic.writers) == 1 and topic.writers[0] in SERVICES else ""
