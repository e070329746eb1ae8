"""Loads a controller from a user's file."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

from services.planner.controller import Controller
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError

DEFAULT_NAME: Final = "Controller"
_SPEC: Final = re.compile(r"(.+\.py)(?::(\w+))?")
T = TypeVar("T")
ATTACHED: Final = "controller.py"
"""Name of the file in a run's log."""


def split_spec(spec: str) -> tuple[Path, str]:
    """Return file and name of `FILE.py` or `FILE.py:NAME`."""
    match = _SPEC.fullmatch(spec)
    return (Path(match[1]), match[2] or DEFAULT_NAME) if match else (Path(spec), DEFAULT_NAME)


def absolute(spec: str) -> str:
    """Return a spec whose file is named as from anywhere."""
    path, name = split_spec(spec)
    return f"{path.absolute()}:{name}"


def controller_maker(spec: str, robot: RobotConfig) -> Callable[[], Controller]:
    """Return what makes controllers of a file, one for each planner.

    Args:
        spec: `FILE.py`, or `FILE.py:NAME`; NAME is called with the robot, and is `Controller` if it
            is not given.
        robot: the robot.

    Raises:
        ConfigError: the file cannot be read or run, or has nothing of that name, or what it makes
            is no controller.
    """
    path, name = split_spec(spec)
    if not path.is_file() or _SPEC.fullmatch(spec) is None:
        raise ConfigError(str(path), "--controller", "no such file", "FILE.py or FILE.py:NAME")
    module_spec = importlib.util.spec_from_file_location(f"xrl_controller_{path.stem}", path)
    if module_spec is None or module_spec.loader is None:
        raise ConfigError(str(path), "--controller", "is no Python file", "FILE.py or FILE.py:NAME")
    module = importlib.util.module_from_spec(module_spec)
    sys.modules[module_spec.name] = module
    sys.path.append(str(path.absolute().parent))  # for files beside it
    make = _checked(path, "it", lambda: _executed(module_spec, module, name))
    if make is None:
        right = f"a class or function {name}(robot)"
        raise ConfigError(str(path), "--controller", f"has no {name}", right)
    made = _checked(path, f"{name}(robot)", lambda: make(robot))
    missing = [part for part in ("reset", "step") if not callable(getattr(made, part, None))]
    if missing:
        right = "reset(seen) and step(seen), as services/planner/controller.py has them"
        raise ConfigError(str(path), name, f"has no {' and no '.join(missing)}", right)
    first = [made]
    # one that was made to look at it is the first planner's: it may have opened a device
    return lambda: first.pop() if first else _checked(path, f"{name}(robot)", lambda: make(robot))


def _executed(
    spec: importlib.machinery.ModuleSpec, module: object, name: str
) -> Callable[[RobotConfig], Controller] | None:
    assert spec.loader is not None  # noqa: S101 - looked at before
    spec.loader.exec_module(module)  # type: ignore[arg-type]  # it is a module
    return getattr(module, name, None)


def _checked(path: Path, what: str, run: Callable[[], T]) -> T:
    try:
        return run()
    except Exception as error:
        found = f"{what} raised {type(error).__name__}: {error}"
        raise ConfigError(str(path), "--controller", found, "see its line in Python") from error
