"""Animated GIF of a run: the robot from the side and from the front."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from shared.arrays import Array
from shared.atomic_file import atomic_file
from shared.bus import topics
from shared.bus.messages import Mode, RunEvent, RunEventKind
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import MODULES, SIDES
from shared.robot.frames import UPRIGHT, Quaternion, product, rotated
from tools.judge.reports.robot_pose import FORCE_MIN_N, RobotPose, frames, poses
from tools.logs.run_log import RunLog

Point = tuple[float, float]
FRAMES_S: Final = 12.5
"""Frames per second; a GIF shows each frame for a multiple of 0.01 s."""
SCALE: Final = 2
"""Frames are drawn larger by this factor and then reduced, for smooth lines."""
SIZE: Final = (640, 400)
COLOURS_MAX: Final = 64
MIXTURES: Final = 4
"""Shades of each ink, for smooth edges."""
PX_PER_M: Final = 200.0 * SCALE
GROUND_Y: Final = 365.0 * SCALE
PX_PER_N: Final = 0.9 * SCALE
VIEWS: Final = ((170.0 * SCALE, 0, 1.0), (465.0 * SCALE, 1, -1.0))
"""Centre, px; horizontal axis (0: x, seen from the side; 1: y, seen from the front); its sign."""
BACKGROUND, INK, LINK, TORSO, COM_INK = "#ffffff", "#30363d", "#7b858f", "#c9d1d9", "#0d5ea6"
HAND_INK, PUSH_INK = "#c44f1c", "#8c3399"
MODE_INK: Final[dict[int, str]] = {
    Mode.DISARMED: "#8a8f98",
    Mode.HOLD: "#d98f1f",
    Mode.TRACK: "#2e8a5c",
    Mode.DAMP: "#8254b8",
    Mode.FAULT: "#bf382b",
}


def write_gif(
    log: RunLog, robot: RobotConfig, path: Path, progress: Callable[[float], None]
) -> int:
    """Draw a run from the start of its scenario, and return the number of frames.

    The pose comes from the simulated world, or else from the legs' kinematics. `progress` receives
    the fraction that is drawn.
    """
    events: list[RunEvent] = log.messages(topics.RUN_EVENT)
    began = next((event.t_ns for event in events if event.kind == RunEventKind.STARTED), 0)
    chosen = [pose for pose in poses(log, robot, FRAMES_S) if pose.t_ns >= began]
    if not chosen:
        raise RunError(
            f"{log.path}: no pose after the start of the scenario; there is nothing to draw"
        )
    images = []
    for number, pose in enumerate(chosen):
        image = Image.new("RGB", (SIZE[0] * SCALE, SIZE[1] * SCALE), BACKGROUND)
        caption = f"{(pose.t_ns - began) / NS_PER_S:4.1f} s   {_caption(events, pose)}"
        _draw_frame(ImageDraw.Draw(image), robot, pose, caption)
        images.append(image.resize(SIZE, Image.Resampling.LANCZOS))
        progress((number + 1) / len(chosen))
    palette = _palette()
    flat = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    try:
        with atomic_file(path) as file:
            flat[0].save(
                file,
                format="GIF",
                save_all=True,
                append_images=flat[1:],
                duration=round(1000.0 / FRAMES_S),
                loop=0,
                optimize=True,
            )
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from None
    return len(flat)


def world_frames(robot: RobotConfig, pose: RobotPose) -> dict[str, tuple[Array, Quaternion]]:
    """Return each frame's origin (3,), m, and rotation, in the world."""
    placed = {"world": (np.zeros(3), UPRIGHT)}
    for frame in frames(robot, pose.torso, pose.angles, pose.com, pose.q):
        origin, rotation = placed[frame.parent]
        placed[frame.child] = (
            origin + rotated(rotation, frame.position),
            product(rotation, frame.rotation),
        )
    return placed


def _palette() -> Image.Image:
    """Return an image whose palette contains every ink, also mixed with the background."""
    inks = (BACKGROUND, INK, LINK, TORSO, COM_INK, HAND_INK, PUSH_INK, *MODE_INK.values())
    swatches = Image.new("RGB", (len(inks), MIXTURES), BACKGROUND)
    for column, ink in enumerate(inks):
        for row in range(MIXTURES):
            mixed = Image.blend(
                Image.new("RGB", (1, 1), BACKGROUND), Image.new("RGB", (1, 1), ink), row / MIXTURES
            )
            swatches.paste(mixed, (column, row))
        swatches.putpixel((column, 0), ImageColor.getrgb(ink))
    return swatches.quantize(COLOURS_MAX)


def _caption(events: Sequence[RunEvent], pose: RobotPose) -> str:
    words = "led by the hand"
    for event in events:
        if event.t_ns <= pose.t_ns and event.kind == RunEventKind.KILLED:
            words = f"{event.subject} killed: the robot holds"
        elif event.t_ns <= pose.t_ns and event.kind == RunEventKind.RESTARTED:
            words = f"{event.subject} restarted"
    return words + ("   push" if any(pose.push) else "")


def _draw_frame(
    canvas: ImageDraw.ImageDraw, robot: RobotConfig, pose: RobotPose, caption: str
) -> None:
    frames = world_frames(robot, pose)
    width, text = SIZE[0] * SCALE, partial(_text, canvas)
    canvas.line([(20.0 * SCALE, GROUND_Y), (width - 20.0 * SCALE, GROUND_Y)], INK, 3)
    for view in VIEWS:
        _draw_robot(canvas, robot, pose, frames, view)
    text((20, 14), caption, 17)
    text((20, 38), f"height {pose.torso[2]:.3f} m   hand {abs(pose.force[2]):3.0f} N", 14)
    for number, mode in enumerate((Mode.TRACK, Mode.HOLD)):
        canvas.circle((520.0 * SCALE, (24 + 22 * number) * SCALE), 6.0 * SCALE, MODE_INK[mode])
        text((534, 15 + 22 * number), mode.name, 14)


def _text(canvas: ImageDraw.ImageDraw, at: tuple[int, int], text: str, size: int) -> None:
    """Write a text with its upper left corner at a pixel of the picture."""
    font = ImageFont.load_default(size * SCALE)
    canvas.text((at[0] * SCALE, at[1] * SCALE), text, fill=INK, font=font)


def _arrow(canvas: ImageDraw.ImageDraw, at: Point, by: Point, ink: str) -> None:
    """Draw an arrow from a point along a vector, unless it is shorter than a pixel."""
    length = float(np.hypot(*by))
    if length < SCALE:
        return
    x, y = at[0] + by[0], at[1] + by[1]
    ux, uy = by[0] / length * SCALE, by[1] / length * SCALE
    canvas.line([at, (x, y)], ink, 4 * SCALE)
    tip = [(x + 9 * ux, y + 9 * uy), (x - 7 * uy, y + 7 * ux), (x + 7 * uy, y - 7 * ux)]
    canvas.polygon(tip, ink)


def _draw_robot(
    canvas: ImageDraw.ImageDraw,
    robot: RobotConfig,
    pose: RobotPose,
    frames: dict[str, tuple[Array, Quaternion]],
    view: tuple[float, int, float],
) -> None:
    centre, axis, sign = view

    def at(point: Array) -> Point:
        up = float(point[2]) + robot.geometry.foot_height
        return (centre + sign * PX_PER_M * float(point[axis]), GROUND_Y - PX_PER_M * up)

    def box(name: str, size: Sequence[float], middle: Sequence[float]) -> list[Point]:
        origin, rotation = frames[name]
        half = 0.5 * size[axis], 0.5 * size[2]
        found = []
        for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            corner = [*middle]
            corner[axis] += a * half[0]
            corner[2] += b * half[1]
            x, y, z = corner
            found.append(at(origin + rotated(rotation, (x, y, z))))
        return found

    geometry = robot.geometry
    canvas.polygon(box("torso", geometry.torso_size, (0.0, 0.0, 0.0)), TORSO)
    hips = [at(frames[f"hip_{side}"][0]) for side in SIDES]
    canvas.line(hips, LINK, 7 * SCALE)
    foot = (geometry.l_foot, geometry.w_foot, geometry.foot_height)
    for side in SIDES:
        joints = [at(frames[f"{kind}_{side}"][0]) for kind in ("ankle", "knee", "hip")]
        canvas.polygon(box(f"ankle_{side}", foot, (0.0, 0.0, -foot[2] / 2)), INK)
        canvas.line(joints, LINK, 7 * SCALE, joint="curve")
        for kind, joint in zip(("ankle", "knee", "hip"), joints, strict=True):
            mode = pose.modes[MODULES.index(f"{kind}_{side}")]
            canvas.circle(joint, 8.5 * SCALE, MODE_INK.get(mode, INK))
    canvas.circle(at(np.array(pose.com)), 5.0 * SCALE, COM_INK)
    harness = at(frames["harness"][0])
    if abs(pose.force[2]) >= FORCE_MIN_N:
        _arrow(canvas, harness, (0.0, -PX_PER_N * pose.force[2]), HAND_INK)
    if pose.push[axis]:
        by = (sign * PX_PER_N * pose.push[axis], 0.0)
        _arrow(canvas, at(np.array(pose.torso)), by, PUSH_INK)
