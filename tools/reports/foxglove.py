"""Foxglove's well-known messages for 3-D, as JSON, and their schemas. Pure.

`foxglove.FrameTransforms` and `foxglove.SceneUpdate`: viewers know them by name. Positions
in m; quaternions as (x, y, z, w); colours as (r, g, b, a) from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, TypeAlias

from shared.clock import NS_PER_S

Json: TypeAlias = dict[str, Any]
Point: TypeAlias = Sequence[float]
Quaternion: TypeAlias = Sequence[float]
Colour: TypeAlias = tuple[float, float, float, float]

TRANSFORMS: Final = "foxglove.FrameTransforms"
SCENE: Final = "foxglove.SceneUpdate"

UPRIGHT: Final = (0.0, 0.0, 0.0, 1.0)


def _object(title: str, **properties: Json) -> Json:
    return {
        "title": title,
        "type": "object",
        "properties": properties,
        "required": list(properties),
    }


def _array(items: Json) -> Json:
    return {"type": "array", "items": items}


_NUMBER: Final[Json] = {"type": "number"}
_TEXT: Final[Json] = {"type": "string"}
_FLAG: Final[Json] = {"type": "boolean"}
_WHOLE: Final[Json] = {"type": "integer"}
_NSEC: Final[Json] = {"type": "integer", "minimum": 0, "maximum": 999_999_999}
_TIME: Final = _object("time", sec={"type": "integer", "minimum": 0}, nsec=_NSEC)
_DURATION: Final = _object("duration", sec=_WHOLE, nsec=_NSEC)
_VECTOR: Final = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POINT: Final = _object("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION: Final = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE: Final = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOUR: Final = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_PAIR: Final = _object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)
_SHAPE: Final = {"pose": _POSE, "size": _VECTOR, "color": _COLOUR}

_PRIMITIVES: Final[dict[str, Json]] = {
    "arrows": _object(
        "foxglove.ArrowPrimitive", pose=_POSE, shaft_length=_NUMBER, shaft_diameter=_NUMBER,
        head_length=_NUMBER, head_diameter=_NUMBER, color=_COLOUR,
    ),
    "cubes": _object("foxglove.CubePrimitive", **_SHAPE),
    "spheres": _object("foxglove.SpherePrimitive", **_SHAPE),
    "cylinders": _object(
        "foxglove.CylinderPrimitive", pose=_POSE, size=_VECTOR, bottom_scale=_NUMBER,
        top_scale=_NUMBER, color=_COLOUR,
    ),
    "lines": _object(
        "foxglove.LinePrimitive", type=_WHOLE, pose=_POSE, thickness=_NUMBER,
        scale_invariant=_FLAG, points=_array(_POINT), color=_COLOUR, colors=_array(_COLOUR),
        indices=_array(_WHOLE),
    ),
    "triangles": _object(
        "foxglove.TriangleListPrimitive", pose=_POSE, points=_array(_POINT), color=_COLOUR,
        colors=_array(_COLOUR), indices=_array(_WHOLE),
    ),
    "texts": _object(
        "foxglove.TextPrimitive", pose=_POSE, billboard=_FLAG, font_size=_NUMBER,
        scale_invariant=_FLAG, color=_COLOUR, text=_TEXT,
    ),
    "models": _object(
        "foxglove.ModelPrimitive", pose=_POSE, scale=_VECTOR, color=_COLOUR,
        override_color=_FLAG, url=_TEXT, media_type=_TEXT,
        data={"type": "string", "contentEncoding": "base64"},
    ),
}  # fmt: skip

SCHEMAS: Final[dict[str, Json]] = {
    TRANSFORMS: _object(
        TRANSFORMS,
        transforms=_array(
            _object(
                "foxglove.FrameTransform", timestamp=_TIME, parent_frame_id=_TEXT,
                child_frame_id=_TEXT, translation=_VECTOR, rotation=_QUATERNION,
            )
        ),
    ),
    SCENE: _object(
        SCENE,
        deletions=_array(
            _object("foxglove.SceneEntityDeletion", timestamp=_TIME, type=_WHOLE, id=_TEXT)
        ),
        entities=_array(
            _object(
                "foxglove.SceneEntity", timestamp=_TIME, frame_id=_TEXT, id=_TEXT,
                lifetime=_DURATION, frame_locked=_FLAG, metadata=_array(_PAIR),
                **{name: _array(shape) for name, shape in _PRIMITIVES.items()},
            )
        ),
    ),
}  # fmt: skip


def time(ns: int) -> Json:
    """Return a time of ns since 1970."""
    sec, nsec = divmod(ns, NS_PER_S)
    return {"sec": sec, "nsec": nsec}


def vector(values: Point) -> Json:
    """Return three numbers."""
    x, y, z = (float(value) for value in values)
    return {"x": x, "y": y, "z": z}


def transform(ns: int, parent: str, child: str, at: Point, turn: Quaternion) -> Json:
    """Return where a frame is in its parent."""
    return {
        "timestamp": time(ns),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": vector(at),
        "rotation": _turn(turn),
    }


def entity(ns: int, frame: str, name: str, **primitives: list[Json]) -> Json:
    """Return an entity that moves with its frame, until it is replaced by one of its name."""
    return {
        "timestamp": time(ns),
        "frame_id": frame,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": True,
        "metadata": [],
        **{kind: primitives.get(kind, []) for kind in _PRIMITIVES},
    }


def solid(size: Point, colour: Colour, at: Point = (0.0, 0.0, 0.0)) -> Json:
    """Return a cube, a sphere: so large along x, y and z."""
    return {"pose": pose(at), "size": vector(size), "color": _colour(colour)}


def cylinder(size: Point, colour: Colour, at: Point) -> Json:
    """Return a cylinder along z."""
    return {**solid(size, colour, at), "bottom_scale": 1.0, "top_scale": 1.0}


def arrow(at: Point, turn: Quaternion, length: float, width: float, colour: Colour) -> Json:
    """Return an arrow along x, turned, from its tail on."""
    head = min(length, 3.0 * width)
    return {
        "pose": pose(at, turn),
        "shaft_length": length - head,
        "shaft_diameter": width,
        "head_length": head,
        "head_diameter": 2.0 * width,
        "color": _colour(colour),
    }


def pose(at: Point, turn: Quaternion = UPRIGHT) -> Json:
    """Return a position and a turn."""
    return {"position": vector(at), "orientation": _turn(turn)}


def _turn(values: Quaternion) -> Json:
    x, y, z, w = (float(value) for value in values)
    return {"x": x, "y": y, "z": z, "w": w}


def _colour(values: Colour) -> Json:
    return dict(zip("rgba", values, strict=True))
