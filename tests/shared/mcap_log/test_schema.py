from __future__ import annotations

from enum import IntEnum
from typing import Any

import msgspec
import pytest

from shared.bus import codec, messages, topics
from shared.bus.topics import Topic
from shared.exceptions import RunError
from shared.mcap_log import schema
from tests.shared.mcap_log.runs import sample

RECORDED = [topic for topic in topics.TOPICS if topic.recorded]
PLAIN = {"boolean": bool, "integer": int, "number": (int, float), "string": str}


def fits(value: Any, node: dict[str, Any]) -> bool:
    """Validate as JSON schema does, for the keywords that `schema` uses."""
    if node["type"] == "object":
        names = set(node["properties"])
        return (
            isinstance(value, dict)
            and set(node["required"]) <= set(value) <= names
            and all(fits(value[name], node["properties"][name]) for name in value)
        )
    if node["type"] == "array":
        if not isinstance(value, list):
            return False
        low, high = node.get("minItems", 0), node.get("maxItems", len(value))
        return low <= len(value) <= high and all(fits(entry, node["items"]) for entry in value)
    if isinstance(value, bool) and node["type"] != "boolean":
        return False
    return isinstance(value, PLAIN[node["type"]])


each_recorded = pytest.mark.parametrize("topic", RECORDED, ids=lambda topic: topic.type.__name__)


@each_recorded
def test_schema_has_no_references_and_no_arrays_in_arrays(topic: Topic) -> None:
    text = schema.encoded(topic.type).decode()
    for refused in ("$ref", "$defs", "anyOf", "oneOf", "prefixItems", "null", '"enum"'):
        assert refused not in text

    def look(node: dict[str, Any]) -> None:
        for member in node["properties"].values():
            item = member["items"] if member["type"] == "array" else member
            if item["type"] == "object":
                look(item)
            else:
                assert item["type"] in PLAIN

    look(msgspec.json.decode(text))


@each_recorded
def test_encoded_message_fits_its_schema_and_a_damaged_one_does_not(topic: Topic) -> None:
    """A field with a default may be missing."""
    fields = msgspec.structs.fields(topic.type)
    newer = {field.name for field in fields if field.default is not msgspec.NODEFAULT}
    assert len(newer) < 2 * len(fields) / 3
    node = schema.json_schema(topic.type)
    value = msgspec.json.decode(codec.encode(sample(topic.type)))
    assert fits(value, node)
    for name in value:
        assert not fits({**value, name: None}, node)
        without = {other: value[other] for other in value if other != name}
        assert fits(without, node) is (name in newer)
    assert not fits({**value, "extra": 1}, node)


def test_every_enumeration_of_the_messages_names_its_values_in_a_schema() -> None:
    described = "".join(schema.encoded(topic.type).decode() for topic in RECORDED)
    kinds = [kind for kind in IntEnum.__subclasses__() if kind.__module__ == messages.__name__]
    assert len(kinds) >= 4
    for member in (member for kind in kinds for member in kind):
        assert f"{member.value} {member.name}" in described
    for message_type, field in schema.ENUMERATIONS:
        node = schema.json_schema(message_type)["properties"][field]
        assert node["type"] == "integer"


class Matrix(msgspec.Struct):
    rows: tuple[tuple[float, float], tuple[float, float]]


class Mixed(msgspec.Struct):
    pair: tuple[int, str]


class Either(msgspec.Struct):
    value: int | str


@pytest.mark.parametrize("refused", [Matrix, Mixed, Either])
def test_what_foxglove_cannot_read_is_refused_with_type_and_field(
    refused: type[msgspec.Struct],
) -> None:
    with pytest.raises(RunError, match=rf"^{refused.__name__}\.\w+: "):
        schema.json_schema(refused)
