"""A controller from a user's file: found, or refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.planner.controller_file import absolute, controller_maker, split_spec
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError

GOOD = """
class Controller:
    made = 0
    def __init__(self, robot):
        self.name = robot.name
        Controller.made += 1
    def reset(self, seen): pass
    def step(self, seen): pass

def other(robot):
    return Controller(robot)
"""


@pytest.mark.parametrize("name", ["", ":Controller", ":other"])
def test_each_planner_gets_one_of_its_own(tmp_path: Path, robot: RobotConfig, name: str) -> None:
    path = tmp_path / "mine.py"
    path.write_text(GOOD, encoding="utf-8")
    make = controller_maker(f"{path}{name}", robot)
    assert make() is not make()
    assert make().name == robot.name  # type: ignore[attr-defined]  # of the file


@pytest.mark.parametrize(
    ("text", "name", "said"),
    [
        (GOOD, ":Absent", "has no Absent; a class or function Absent"),
        ("def Controller(robot): return 3", "", "has no reset and no step"),
        ("class Controller:\n  def reset(self, s): pass\n  def __init__(self, r): pass", "",
         "has no step; reset"),
        ("def Controller(): pass", "", "raised TypeError"),
        ("import nowhere_to_be_found", "", "raised ModuleNotFoundError: No module named"),
        ("def (", "", "raised SyntaxError"),
        ("1 / 0", "", "raised ZeroDivisionError"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_used_is_one_clear_line(
    tmp_path: Path, robot: RobotConfig, text: str, name: str, said: str
) -> None:
    path = tmp_path / "mine.py"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        controller_maker(f"{path}{name}", robot)
    assert said in str(caught.value)
    assert "mine.py" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("spec", ["absent.py", "absent", "absent.txt", ""])
def test_a_file_that_is_not_there_is_one_clear_line(spec: str, robot: RobotConfig) -> None:
    with pytest.raises(ConfigError, match=r"FILE\.py or FILE\.py:NAME"):
        controller_maker(spec, robot)


def test_a_spec_is_file_and_name() -> None:
    assert split_spec("a/b.py") == (Path("a/b.py"), "Controller")
    assert split_spec("a/b.py:LQR") == (Path("a/b.py"), "LQR")
    assert split_spec("/home/me/.pyenv/c/mine.py:B") == (Path("/home/me/.pyenv/c/mine.py"), "B")
    assert absolute("b.py:LQR") == f"{Path.cwd() / 'b.py'}:LQR"


def test_the_one_that_was_looked_at_is_the_first_planners(
    tmp_path: Path, robot: RobotConfig
) -> None:
    """It may have opened a device, which a second one could not."""
    path = tmp_path / "mine.py"
    path.write_text(GOOD.replace("def __init__", "all = []\n    def __init__"), encoding="utf-8")
    make = controller_maker(str(path), robot)
    first = make()
    assert type(first).made == 1  # type: ignore[attr-defined]  # of the file
    make()
    assert type(first).made == 2  # type: ignore[attr-defined]


def test_a_file_beside_it_can_be_imported(tmp_path: Path, robot: RobotConfig) -> None:
    (tmp_path / "beside_my_controller.py").write_text("GAIN = 3", encoding="utf-8")
    path = tmp_path / "mine.py"
    path.write_text(f"import beside_my_controller\n{GOOD}", encoding="utf-8")
    controller_maker(str(path), robot)
