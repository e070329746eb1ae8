"""Keys of the bus by the names that a person types, such as `joint/*/state`."""

from __future__ import annotations

import fnmatch
from collections.abc import Collection, Sequence
from typing import NamedTuple

from shared.bus import topics
from shared.bus.topics import Topic
from shared.config.robot_config import SERVICES
from shared.exceptions import RunError
from shared.joints import MODULES


class TopicKey(NamedTuple):
    """A key of a robot's bus."""

    topic: Topic
    module: str
    """"" for a topic with one key."""

    @property
    def name(self) -> str:
        """Name below the robot's, such as `joint/knee_left/state`."""
        return self.topic.name.replace("*", self.module)


def every_key() -> list[TopicKey]:
    """Return every key, in the order of the table of topics."""
    return [
        TopicKey(topic, module)
        for topic in topics.TOPICS
        for module in (MODULES if topic.per_module else ("",))
    ]


def keys_named(patterns: Sequence[str], left_out: Collection[Topic] = ()) -> list[TopicKey]:
    """Return the keys whose names match a pattern, in the order of the table of topics."""
    known = every_key()
    for pattern in patterns:
        if not any(fnmatch.fnmatch(key.name, pattern) for key in known):
            names = ", ".join(topic.name for topic in topics.TOPICS)
            raise RunError(f"{pattern}: no topic is so named; there are {names}")
    if not patterns:
        return [key for key in known if key.topic not in left_out]
    return [key for key in known if any(fnmatch.fnmatch(key.name, p) for p in patterns)]


def sender_of(topic: Topic, module: str = "") -> str:
    """Return the service that puts a topic; "" if tools do, on any host."""
    if topic.writers == ("*",):
        return module
    return topic.writers[0] if len(topic.writers) == 1 and topic.writers[0] in SERVICES else ""
