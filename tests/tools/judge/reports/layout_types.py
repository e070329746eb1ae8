"""Types of a layout file, key by key, from the sources of the viewers.

From Lichtblick (`packages/suite-base/src`: `context/CurrentLayoutContext/actions.ts`,
`panels/Plot/utils/config.ts`, `panels/StateTransitions/types.ts`, `panels/RawMessages/types.ts`,
`panels/ThreeDeeRender/IRenderer.ts`, `camera.ts`, `settings.ts`, `renderables/Grids.ts`,
`packages/message-path/src/grammar.ne`) and Foxglove Studio 1.48, the last open one, from which
Lichtblick comes. Each viewer silently drops a key that it does not know. The title of a panel is
the only key that they name differently; each ignores the key of the other.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import msgspec
from msgspec import UNSET, UnsetType

Vector = tuple[float, float, float]
TimestampMethod = Literal["receiveTime", "headerStamp"]

TOPIC: Final = r"[A-Za-z0-9_-]+(?:/[A-Za-z0-9_-]*)*"
FIELD: Final = r"\.[A-Za-z0-9_-]+(?:\[\d+\])?"
"""Parts of a message path: `id` with slashes, then names with one index each. Names with other
characters stand in quotes, and a leading slash is part of the name."""


class Known(msgspec.Struct, forbid_unknown_fields=True, rename="camel"):
    """Base class: an unknown key is an error."""


def known(name: str, may: dict[str, Any] | None = None, /, **must: Any) -> Any:
    """Return the type of an object that has all keys of `must`, perhaps those of `may`."""
    fields = [*must.items(), *((key, kind | UnsetType, UNSET) for key, kind in (may or {}).items())]
    return msgspec.defstruct(name, fields, bases=(Known,), kw_only=True)


def panel(name: str, may: dict[str, Any] | None = None, /, **must: Any) -> Any:
    """Return the type of a panel with a title, as both viewers have it."""
    return known(name, may, foxglove_panel_title=str, lichtblick_panel_title=str, **must)


PlotPath = known(
    "PlotPath",
    {"color": str, "label": str, "show_line": bool, "line_size": float},
    value=str, enabled=bool, timestamp_method=TimestampMethod,
)  # fmt: skip
"""Its value: a message path, or a number: a line across the plot."""
Plot = panel(
    "Plot",
    {"min_x_value": float, "max_x_value": float, "min_y_value": float | str,
     "max_y_value": float | str, "following_view_width": float},
    paths=list[PlotPath], show_legend=bool,
    legend_display=Literal["floating", "top", "left", "none"], show_plot_values_in_legend=bool,
    show_x_axis_labels=bool, show_y_axis_labels=bool, is_synced=bool,
    x_axis_val=Literal["timestamp", "index", "custom", "currentCustom"], sidebar_dimension=float,
)  # fmt: skip
StateTransitionPath = known(
    "StateTransitionPath",
    {"color": str, "label": str, "enabled": bool},
    value=str, timestamp_method=TimestampMethod,
)  # fmt: skip
StateTransitions = panel("StateTransitions", paths=list[StateTransitionPath], is_synced=bool)
RawMessages = panel(
    "RawMessages",
    {"expansion": Literal["all", "none"] | dict[str, str]},
    diff_enabled=bool, diff_method=Literal["custom", "previous message"], diff_topic_path=str,
    show_full_message_for_diff=bool, topic_path=str,
)  # fmt: skip
CameraState = known(
    "CameraState",
    distance=float, perspective=bool, phi=float, target=Vector, target_offset=Vector,
    target_orientation=tuple[float, float, float, float], theta_offset=float, fovy=float,
    near=float, far=float,
)  # fmt: skip
SceneTransforms = known(
    "SceneTransforms",
    {"editable": bool, "show_label": bool, "label_size": float, "axis_scale": float,
     "line_width": float, "line_color": str, "enable_preloading": bool},
)  # fmt: skip
Scene = known(
    "Scene",
    {"enable_stats": bool, "background_color": str, "label_scale_factor": float,
     "ignore_collada_up_axis": bool, "transforms": SceneTransforms, "sync_camera": bool,
     "topics_visible": bool},
)  # fmt: skip
TopicSettings = known(
    "TopicSettings", {"frame_locked": bool, "show_outlines": bool, "color": str}, visible=bool
)
GridLayer = known(
    "GridLayer",
    {"order": int},
    visible=bool, frame_locked=bool, label=str, instance_id=str,
    layer_id=Literal["foxglove.Grid"], frame_id=str, size=float, divisions=int, line_width=float,
    color=str, position=Vector, rotation=Vector,
)  # fmt: skip
ThreeDee = panel(
    "ThreeDee",
    camera_state=CameraState, follow_mode=Literal["follow-pose", "follow-position", "follow-none"],
    follow_tf=str, scene=Scene, transforms=dict[str, TopicSettings],
    topics=dict[str, TopicSettings], layers=dict[str, GridLayer],
)  # fmt: skip


class Split(Known):
    direction: Literal["row", "column"]
    first: Split | str
    second: Split | str
    split_percentage: float


OneTab = known("OneTab", title=str, layout=Split | str)
Tab = known("Tab", active_tab_idx=int, tabs=list[OneTab])
Layout = known(
    "Layout",
    config_by_id=dict[str, dict[str, Any]], layout=Split | str, global_variables=dict[str, Any],
    user_nodes=dict[str, Any], playback_config=known("PlaybackConfig", speed=float),
)  # fmt: skip
"""Layout file; the start of a panel's id names the type of its configuration."""

PANELS: Final[dict[str, Any]] = {
    "3D": ThreeDee, "Plot": Plot, "StateTransitions": StateTransitions,
    "RawMessages": RawMessages, "Tab": Tab,
}  # fmt: skip
"""Panel types that this layout uses."""
