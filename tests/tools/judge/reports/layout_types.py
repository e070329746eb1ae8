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


class Titled(Known):
    foxglove_panel_title: str
    lichtblick_panel_title: str


class PlotPath(Known):
    value: str
    """A message path, or a number: a line across the plot."""
    enabled: bool
    timestamp_method: TimestampMethod
    color: str | UnsetType = UNSET
    label: str | UnsetType = UNSET
    show_line: bool | UnsetType = UNSET
    line_size: float | UnsetType = UNSET


class Plot(Titled, kw_only=True):
    paths: list[PlotPath]
    show_legend: bool
    legend_display: Literal["floating", "top", "left", "none"]
    show_plot_values_in_legend: bool
    show_x_axis_labels: bool
    show_y_axis_labels: bool
    is_synced: bool
    x_axis_val: Literal["timestamp", "index", "custom", "currentCustom"]
    sidebar_dimension: float
    min_x_value: float | UnsetType = UNSET
    max_x_value: float | UnsetType = UNSET
    min_y_value: float | str | UnsetType = UNSET
    max_y_value: float | str | UnsetType = UNSET
    following_view_width: float | UnsetType = UNSET


class StateTransitionPath(Known):
    value: str
    timestamp_method: TimestampMethod
    color: str | UnsetType = UNSET
    label: str | UnsetType = UNSET
    enabled: bool | UnsetType = UNSET


class StateTransitions(Titled):
    paths: list[StateTransitionPath]
    is_synced: bool


class RawMessages(Titled):
    diff_enabled: bool
    diff_method: Literal["custom", "previous message"]
    diff_topic_path: str
    show_full_message_for_diff: bool
    topic_path: str
    expansion: Literal["all", "none"] | dict[str, str] | UnsetType = UNSET


class CameraState(Known):
    distance: float
    perspective: bool
    phi: float
    target: Vector
    target_offset: Vector
    target_orientation: tuple[float, float, float, float]
    theta_offset: float
    fovy: float
    near: float
    far: float


class SceneTransforms(Known):
    editable: bool | UnsetType = UNSET
    show_label: bool | UnsetType = UNSET
    label_size: float | UnsetType = UNSET
    axis_scale: float | UnsetType = UNSET
    line_width: float | UnsetType = UNSET
    line_color: str | UnsetType = UNSET
    enable_preloading: bool | UnsetType = UNSET


class Scene(Known):
    enable_stats: bool | UnsetType = UNSET
    background_color: str | UnsetType = UNSET
    label_scale_factor: float | UnsetType = UNSET
    ignore_collada_up_axis: bool | UnsetType = UNSET
    transforms: SceneTransforms | UnsetType = UNSET
    sync_camera: bool | UnsetType = UNSET
    topics_visible: bool | UnsetType = UNSET


class TopicSettings(Known):
    visible: bool
    frame_locked: bool | UnsetType = UNSET
    show_outlines: bool | UnsetType = UNSET
    color: str | UnsetType = UNSET


class GridLayer(Known):
    visible: bool
    frame_locked: bool
    label: str
    instance_id: str
    layer_id: Literal["foxglove.Grid"]
    frame_id: str
    size: float
    divisions: int
    line_width: float
    color: str
    position: Vector
    rotation: Vector
    order: int | UnsetType = UNSET


class ThreeDee(Titled):
    camera_state: CameraState
    follow_mode: Literal["follow-pose", "follow-position", "follow-none"]
    follow_tf: str
    scene: Scene
    transforms: dict[str, TopicSettings]
    topics: dict[str, TopicSettings]
    layers: dict[str, GridLayer]


class Split(Known):
    direction: Literal["row", "column"]
    first: Split | str
    second: Split | str
    split_percentage: float


class OneTab(Known):
    title: str
    layout: Split | str


class Tab(Known):
    active_tab_idx: int
    tabs: list[OneTab]


class PlaybackConfig(Known):
    speed: float


class Layout(Known):
    """Layout file; the start of a panel's id names the type of its configuration."""

    config_by_id: dict[str, dict[str, Any]]
    layout: Split | str
    global_variables: dict[str, Any]
    user_nodes: dict[str, Any]
    playback_config: PlaybackConfig


PANELS: Final[dict[str, type[Known]]] = {
    "3D": ThreeDee,
    "Plot": Plot,
    "StateTransitions": StateTransitions,
    "RawMessages": RawMessages,
    "Tab": Tab,
}
"""Panel types that this layout uses."""
