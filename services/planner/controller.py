"""Interface of a custom controller, and its loader.

A custom controller replaces the shipped law (docs/own-controller.md), and runs inside the planner:
live, in lockstep and in re-execution. Everything around it stays active: the planner's stance,
load, assist, engagement and trips; the certificate of the local gains
(`services.planner.watch.controller_guard`); the joint services' age rule, envelope and torque
limits. Joints are in the order of `shared.joints`; the pose is p = [COM x y z; torso roll pitch
yaw].
"""

from __future__ import annotations

import importlib.machinery
import importlib.util
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple, Protocol, TypeVar

from services.planner.intents import OperatorRequest
from services.planner.law.hocca import LawOutput
from shared.arrays import Array
from shared.bus.messages import Wrench
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError


class Action(NamedTuple):
    """Setpoints for the joint services: arrays (12,).

    A joint's torque is D (q_ref - q) + D_B (v_ref - v) + tau_ff + tau_coupled; q_ref and tau_ff are
    extrapolated by the command's age. HOLD keeps q_ref and tau_ff, drops v_ref and tau_coupled, and
    raises some gains to the stand gains.
    """

    q_ref: Array
    """rad"""
    v_ref: Array
    """Rate of q_ref, rad/s. An ankle's service refuses a q_ref that does not follow this rate."""
    tau_ff: Array
    """N m; torque that supports the body, without feedback."""
    dtau_ff: Array
    """Rate of tau_ff, N m/s."""
    tau_coupled: Array
    """N m; whole-body feedback. Low-pass it, because the joints flex."""
    D: Array
    """Local stiffness, N m/rad. It must hold the robot without the planner. The schedule sets the
    damping D_B."""

    @classmethod
    def from_law(cls, law: LawOutput) -> Action:
        """Return the shipped law's action at this tick."""
        return cls(law.q_ref, law.v_ref, law.tau_ff, law.dtau_ff, law.tau_coupled, law.local.D)


class Observation(NamedTuple):
    """Input of a controller in one tick."""

    time_s: float
    """Time since the controller's last reset, s."""
    dt: float
    """Time since the last tick, s."""
    q: Array
    """Joint angles (12,), rad."""
    v: Array
    """Joint rates (12,), rad/s."""
    tau: Array
    """Joint torques (12,), N m."""
    p: Array
    """Measured pose (6,), m and rad."""
    pdot: Array
    """Its rate (6,)."""
    J: Array
    """dp/dq (6, 12)."""
    T: Array
    """Joint rates per unit of p along the closed chain (12, 6), at the law's reference pose."""
    wrench: Wrench | None
    """Wrench of the person on the torso, at the harness, torso axes; None if unknown."""
    request: OperatorRequest
    """Assist and shift that the operator requests."""
    law: LawOutput
    """Output of the shipped law at this tick."""


class Controller(Protocol):
    """Interface of a controller; each planner makes its own instance."""

    def reset(self, seen: Observation) -> None:
        """Start from this state; called at every tick in which the planner does not lead."""

    def step(self, seen: Observation) -> Action:
        """Return the action at a tick in which the planner leads: every 4 ms at 250 Hz."""


DEFAULT_NAME: Final = "Controller"
_SPEC: Final = re.compile(r"(.+\.py)(?::(\w+))?")
T = TypeVar("T")
ATTACHED: Final = "controller.py"
"""Name under which a run's log contains the controller's file."""


def split_spec(spec: str) -> tuple[Path, str]:
    """Return the path and the name in a spec, `FILE.py` or `FILE.py:NAME`."""
    match = _SPEC.fullmatch(spec)
    return (Path(match[1]), match[2] or DEFAULT_NAME) if match else (Path(spec), DEFAULT_NAME)


def absolute(spec: str) -> str:
    """Return the spec as `FILE.py:NAME`, with an absolute path."""
    path, name = split_spec(spec)
    return f"{path.absolute()}:{name}"


def controller_maker(spec: str, robot: RobotConfig) -> Callable[[], Controller]:
    """Return a function that makes a file's controllers, one for each planner.

    Args:
        spec: `FILE.py` or `FILE.py:NAME`. NAME is a class or function, by default `Controller`.
        robot: argument with which NAME is called.

    Raises:
        ConfigError: the file cannot be read or run, NAME is missing, or its result is not a
            controller.
    """
    path, name = split_spec(spec)
    if not path.is_file() or _SPEC.fullmatch(spec) is None:
        found, right = "no such Python file", "use FILE.py or FILE.py:NAME"
        raise ConfigError(str(path), "--controller", found, right)
    module_spec = importlib.util.spec_from_file_location(f"xrl_controller_{path.stem}", path)
    if module_spec is None or module_spec.loader is None:
        raise ConfigError(
            str(path), "--controller", "not a Python file", "use FILE.py or FILE.py:NAME"
        )
    module = importlib.util.module_from_spec(module_spec)
    sys.modules[module_spec.name] = module
    sys.path.append(str(path.absolute().parent))  # so it can import its neighbours
    make = _checked(path, "running it", lambda: _executed(module_spec, module, name))
    if make is None:
        right = f"define a class or function {name}(robot)"
        raise ConfigError(str(path), "--controller", f"has no {name}", right)
    made = _checked(path, f"{name}(robot)", lambda: make(robot))
    missing = [part for part in ("reset", "step") if not callable(getattr(made, part, None))]
    if missing:
        right = "define reset(seen) and step(seen), as in services/planner/controller.py"
        raise ConfigError(str(path), name, f"has no {' and no '.join(missing)}", right)
    first = [made]
    # the first planner gets the instance made for the check, which may have opened a device
    return lambda: first.pop() if first else _checked(path, f"{name}(robot)", lambda: make(robot))


def _executed(
    spec: importlib.machinery.ModuleSpec, module: object, name: str
) -> Callable[[RobotConfig], Controller] | None:
    assert spec.loader is not None  # noqa: S101 - checked by the caller
    spec.loader.exec_module(module)  # type: ignore[arg-type]  # it is a module
    return getattr(module, name, None)


def _checked(path: Path, what: str, run: Callable[[], T]) -> T:
    try:
        return run()
    except Exception as error:
        found = f"{what} raised {type(error).__name__}: {error}"
        raise ConfigError(
            str(path), "--controller", found, "run it in Python to see the traceback"
        ) from error
