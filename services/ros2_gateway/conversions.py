"""Conversion of the robot's messages to ROS 2. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shared.bus.messages import (
    LOST_DRIVE,
    Cause,
    DriveStatus,
    JointState,
    Mode,
    PlannerMode,
    PlannerStatus,
    Vector3,
    Wrench,
)
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.extras import late
from shared.joints import AXES, MODULES, SIDES
from shared.robot.frames import ORIGIN, UPRIGHT, FramePose, leg_modules, rotation_about, torso_pose
from shared.robot.robot_urdf import cross_of
from shared.robot.trip_table import reason_of, remedy_of

if TYPE_CHECKING:
    from rosbags import typesys
else:
    typesys = late("rosbags.typesys")


class RosTypes:
    """Message types of a distribution in `shared.config.checks.ROS2_DISTRIBUTIONS`."""

    def __init__(self, distribution: str) -> None:
        self._store = typesys.get_typestore(typesys.Stores[f"ROS2_{distribution.upper()}"])

    def hash(self, type_name: str) -> str:
        """Return the hash of a type's description, such as `RIHS01_a13e...`."""
        return self._store.hash_rihs01(type_name)

    def make(self, type_name: str, /, **fields: Any) -> Any:
        """Return a message; `fields` must contain all of its fields."""
        return self._store.types[type_name](**fields)

    def encode(self, type_name: str, message: Any) -> bytes:
        """Return a message in CDR, little endian, with its header of four bytes."""
        return bytes(self._store.serialize_cdr(message, type_name))

    def decode(self, type_name: str, payload: bytes) -> Any | None:
        """Return the message of a payload from the network; None if it is not of this type."""
        try:
            return self._store.deserialize_cdr(payload, type_name)
        except Exception:  # noqa: BLE001 - unknown bytes may cause any error
            return None

    def definition(self, type_name: str) -> str:
        """Return a type's definition in ROS 2's message language, with the types that it uses."""
        text, _ = self._store.generate_msgdef(type_name, ros_version=2)
        return text


JOINT_STATE: Final = "sensor_msgs/msg/JointState"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
TEXT: Final = "std_msgs/msg/String"
CLOCK: Final = "rosgraph_msgs/msg/Clock"

OK, WARN, ERROR, STALE = range(4)
"""Levels of `diagnostic_msgs/msg/DiagnosticStatus`."""
MODE_LEVEL: Final = {
    Mode.TRACK: OK,
    Mode.HOLD: WARN,
    Mode.DISARMED: WARN,
    Mode.DAMP: ERROR,
    Mode.FAULT: ERROR,
}
NOT_STOPPED: Final = "emergency stop"
"""Key of the gateway's figure that reports a failed emergency stop from ROS 2."""
TIME_FIRST_NS: Final = 0
TIME_LAST_NS: Final = (2**31 - 1) * NS_PER_S
"""ROS 2 times are signed 32-bit seconds since 1970, so they end on 2038-01-19."""
_UNKNOWN_POSITION: Final = (*LOST_DRIVE, DriveStatus.UNZEROED)


def knows_position(state: JointState) -> bool:
    """Return True if a module's joint angles are valid."""
    return DriveStatus(state.drive) not in _UNKNOWN_POSITION


class Conversions:
    """Converts the messages of one robot; frame names begin with its namespace.

    Each method returns a message in CDR. Times are in ns since 1970, or on the log's clock, and are
    clipped to the range of ROS 2. A missing state, status or wrench means that its process is
    silent.
    """

    def __init__(self, config: RobotConfig, types: RosTypes) -> None:
        self._config, self._types = config, types
        self._prefix = f"{config.ros2.namespace}/" if config.ros2.namespace else ""

    def joint_states(self, ns: int, states: Mapping[str, JointState]) -> bytes:
        """Return `sensor_msgs/msg/JointState` of the modules in `states`, in rad, rad/s and N m."""
        modules = [name for name in MODULES if name in states]
        q, v, tau = (
            np.array([value for name in modules for value in getattr(states[name], part)], float)
            for part in ("q", "v", "tau")
        )
        return self._encode(
            JOINT_STATE,
            header=self._header(ns, ""),
            name=[f"{name}_{axis}" for name in modules for axis in AXES],
            position=q,
            velocity=v,
            effort=tau,
        )

    def transforms(
        self, ns: int, states: Mapping[str, JointState], status: PlannerStatus | None
    ) -> bytes:
        """Return `tf2_msgs/msg/TFMessage`: torso in the world, COM, and the links of the URDF.

        The torso is placed only with all six states; the status gives COM and stance.
        """
        geometry = self._config.geometry
        rows = [FramePose("torso", "harness", geometry.harness_point, UPRIGHT)]
        if len(states) == len(MODULES):
            q = [angle for name in MODULES for angle in states[name].q]
            stance = status.stance if status is not None else (0.0,) * 6
            rows.append(FramePose("world", "torso", *torso_pose(geometry, q, stance)))
        if status is not None:
            x, y, z, *_ = status.p
            rows.append(FramePose("world", "com", (x, y, z), UPRIGHT))
        for side in SIDES:
            for parent, module, offset in leg_modules(geometry, side):
                if module in states:
                    phi, theta = states[module].q
                    cross = cross_of(module)
                    rows.append(FramePose(parent, cross, offset, rotation_about(1, -theta)))
                    rows.append(FramePose(cross, module, ORIGIN, rotation_about(0, -phi)))
        return self._encode(TRANSFORMS, transforms=[self._transform(ns, row) for row in rows])

    def wrench(self, ns: int, wrench: Wrench) -> bytes:
        """Return `geometry_msgs/msg/WrenchStamped`: the person's wrench on the torso."""
        content = self._types.make(
            "geometry_msgs/msg/Wrench",
            force=self._vector(wrench.force),
            torque=self._vector(wrench.moment),
        )
        return self._encode(
            WRENCH, header=self._header(ns, f"{self._prefix}harness"), wrench=content
        )

    def diagnostics(
        self,
        ns: int,
        states: Mapping[str, JointState],
        status: PlannerStatus | None,
        wrench: Wrench | None,
        gateway: Mapping[str, object],
    ) -> bytes:
        """Return `diagnostic_msgs/msg/DiagnosticArray`: a row for each process, even if silent.

        The processes are the joint services, planner, harness and gateway. `gateway` contains the
        gateway's own figures.
        """
        rows = [self._module_row(name, states.get(name)) for name in MODULES]
        rows += [self._planner_row(status), self._harness_row(wrench)]
        fault = gateway.get(NOT_STOPPED)
        level, said = (ERROR, str(fault)) if fault else (OK, "running")
        rows.append(self._row("ros2_gateway", level, said, gateway))
        return self._encode(DIAGNOSTICS, header=self._header(ns, ""), status=rows)

    def text(self, text: str) -> bytes:
        """Return `std_msgs/msg/String`."""
        return self._encode(TEXT, data=text)

    def clock(self, ns: int) -> bytes:
        """Return `rosgraph_msgs/msg/Clock`."""
        return self._encode(CLOCK, clock=self._time(ns))

    def _module_row(self, name: str, state: JointState | None) -> Any:
        if state is None:
            return self._row(name, STALE, "silent: see `xrl status`", {})
        mode, remedy = Mode(state.mode), remedy_of(state).replace("MODULE", name)
        said = f"{mode.name}: {Cause(state.cause).name}"
        values = {
            "way out": remedy or "none needed",
            "command age, ms": f"{state.age_ns / NS_PER_MS:.1f}" if state.age_ns >= 0 else "none",
            "drive": DriveStatus(state.drive).name,
            "drive error": f"{state.drive_error:#x}",
            "commands refused": state.refused,
            "recent dropouts": state.dropouts,
            "late cycles": f"{state.late} of {state.cycle}",
            "windings, C": f"{state.celsius[0]:.0f}, {state.celsius[1]:.0f}",
            "seconds left at this load": f"{state.heat_left_s:.0f}",
        }
        return self._row(name, MODE_LEVEL[mode], f"{said}; {remedy}" if remedy else said, values)

    def _planner_row(self, status: PlannerStatus | None) -> Any:
        if status is None:
            return self._row("planner", STALE, "silent: each module holds on its own", {})
        mode, reason = PlannerMode(status.mode), reason_of(status)
        values = {
            "margin": f"{status.margin:.2f}",
            "margin, drives alone": f"{status.margin_onboard:.2f}",
            "assist, N": f"{status.assist_n:.1f}",
            "tick, us": f"{status.tick_us:.0f}",
            "oldest state, ms": f"{max(status.state_age_ns) / NS_PER_MS:.1f}",
            "leads again in, s": f"{status.wait_s:.0f}",
        }
        level = OK if mode is PlannerMode.LEADING else WARN
        return self._row(
            "planner", level, f"{mode.name}; {reason}" if reason else mode.name, values
        )

    def _harness_row(self, wrench: Wrench | None) -> Any:
        if wrench is None:
            return self._row("harness", STALE, "silent", {})
        said = "valid" if wrench.valid else "not valid: saturated, frozen, stale or not tared"
        values = {"age, ms": f"{wrench.age_ns / NS_PER_MS:.1f}", "saturated": wrench.saturated}
        return self._row("harness", OK if wrench.valid else WARN, said, values)

    def _row(self, name: str, level: int, said: str, values: Mapping[str, object]) -> Any:
        pairs = [
            self._types.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
            for key, value in values.items()
        ]
        return self._types.make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level, name=f"{self._config.name}: {name}", message=said,
            hardware_id=self._config.name, values=pairs,
        )  # fmt: skip

    def _transform(self, ns: int, row: FramePose) -> Any:
        x, y, z, w = row.rotation
        content = self._types.make(
            "geometry_msgs/msg/Transform",
            translation=self._vector(row.position),
            rotation=self._types.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )
        world = "world" if row.parent == "world" else f"{self._prefix}{row.parent}"
        return self._types.make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(ns, world),
            child_frame_id=f"{self._prefix}{row.child}",
            transform=content,
        )

    def _vector(self, values: Vector3 | Sequence[float]) -> Any:
        x, y, z = values
        return self._types.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _header(self, ns: int, frame: str) -> Any:
        return self._types.make("std_msgs/msg/Header", stamp=self._time(ns), frame_id=frame)

    def _time(self, ns: int) -> Any:
        seconds, rest = divmod(min(max(ns, TIME_FIRST_NS), TIME_LAST_NS), NS_PER_S)
        return self._types.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)

    def _encode(self, type_name: str, /, **fields: Any) -> bytes:
        return self._types.encode(type_name, self._types.make(type_name, **fields))
