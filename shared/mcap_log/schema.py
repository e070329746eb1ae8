"""JSON schemas of the messages, flat enough for Foxglove and PlotJuggler.

Foxglove reads an object whose properties are booleans, strings, numbers, integers, objects, or
arrays of one of these: no `$ref`, no unions, no null, no tuples and no array in an array. msgspec's
own schemas contain most of these constructs (docs/logs.md), so the schemas here are made from the
types themselves.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Final

import msgspec
from msgspec import inspect

from shared.bus import messages
from shared.bus.messages import Message
from shared.exceptions import RunError

ENCODING: Final = "jsonschema"
"""MCAP's name for this kind of schema."""

ENUMERATIONS: Final[dict[tuple[type, str], type[IntEnum]]] = {
    (messages.JointState, "mode"): messages.Mode,
    (messages.JointState, "cause"): messages.Cause,
    (messages.JointEvent, "mode_before"): messages.Mode,
    (messages.JointEvent, "mode_after"): messages.Mode,
    (messages.JointEvent, "cause"): messages.Cause,
    (messages.Wrench, "tare"): messages.Tare,
    (messages.PlannerStatus, "mode"): messages.PlannerMode,
    (messages.PlannerStatus, "split"): messages.SplitSource,
    (messages.JointState, "drive"): messages.DriveStatus,
    (messages.JointState, "outside"): messages.Outside,
    (messages.JointState, "refusal"): messages.Refusal,
    (messages.PlannerStatus, "trip"): messages.Trip,
    (messages.PlannerStatus, "heat"): messages.HeatAction,
    (messages.PlannerStatus, "wearer"): messages.Wearing,
    (messages.PlannerStatus, "park_requested"): messages.Park,
    (messages.OperatorIntent, "park"): messages.Park,
    (messages.RunEvent, "kind"): messages.RunEventKind,
}
"""Enumeration of each field that is a plain integer on the bus."""

_PLAIN: Final[dict[type[inspect.Type], str]] = {
    inspect.BoolType: "boolean",
    inspect.IntType: "integer",
    inspect.FloatType: "number",
    inspect.StrType: "string",
}


def name_of(message_type: type[Message]) -> str:
    """Return the schema's name in the file, for example `xrl.JointState`."""
    return f"xrl.{message_type.__name__}"


def json_schema(message_type: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the flat JSON schema of a message type; raise RunError for a field that cannot fit."""
    info = inspect.type_info(message_type)
    if not isinstance(info, inspect.StructType):
        raise RunError(f"{message_type}: not a msgspec struct; recorded messages must be structs")
    return _object(info, message_type.__name__)


def encoded(message_type: type[Message]) -> bytes:
    """Return a message type's schema, encoded for the file."""
    return msgspec.json.encode(json_schema(message_type))


def _object(info: inspect.StructType, where: str) -> dict[str, Any]:
    properties: dict[str, Any] = {}
    required = []
    for field in info.fields:
        node = _node(field.type, f"{where}.{field.name}")
        enumeration = ENUMERATIONS.get((info.cls, field.name))
        if enumeration is not None:
            node = _enumeration(enumeration)
        properties[field.encode_name] = node
        if field.required:
            required.append(field.encode_name)
    return {
        "title": info.cls.__name__,
        "description": (info.cls.__doc__ or "").partition("\n")[0],
        "type": "object",
        "properties": properties,
        "required": required,
        "additionalProperties": False,
    }


def _node(info: inspect.Type, where: str) -> dict[str, Any]:
    if type(info) in _PLAIN:
        return {"type": _PLAIN[type(info)]}
    if isinstance(info, inspect.Metadata):
        return _node(info.type, where)
    if isinstance(info, inspect.StructType):
        return _object(info, where)
    if isinstance(info, inspect.EnumType) and issubclass(info.cls, IntEnum):
        return _enumeration(info.cls)
    if isinstance(info, inspect.UnionType):
        members = [member for member in info.types if not isinstance(member, inspect.NoneType)]
        if len(members) == 1:
            return _node(members[0], where)
    if isinstance(info, inspect.TupleType):
        items = [_node(item, f"{where}[]") for item in info.item_types]
        if items and all(item == items[0] for item in items):
            return _array(items[0], where) | {"minItems": len(items), "maxItems": len(items)}
    if isinstance(info, inspect.ListType | inspect.VarTupleType):
        return _array(_node(info.item_type, f"{where}[]"), where)
    raise RunError(
        f"{where}: {type(info).__name__} does not fit into a flat JSON schema; use numbers, "
        "strings, booleans, structs, integer enumerations, or arrays of these"
    )


def _array(items: dict[str, Any], where: str) -> dict[str, Any]:
    if items["type"] == "array":
        raise RunError(f"{where}: Foxglove rejects an array in an array; flatten it")
    return {"type": "array", "items": items}


def _enumeration(enumeration: type[IntEnum]) -> dict[str, Any]:
    names = ", ".join(f"{member.value} {member.name}" for member in enumeration)
    return {"type": "integer", "description": f"{enumeration.__name__}: {names}"}
