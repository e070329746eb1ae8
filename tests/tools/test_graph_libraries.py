"""Graphs in C: they give the interpreter's numbers, and without them all runs."""

from __future__ import annotations

import platform
import shutil
import subprocess
from pathlib import Path

import casadi as ca
import pytest

from services.planner.planner import Planner
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import PlantConfig
from services.simulator.physics.world import World
from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.robot import compiled_graph
from shared.robot.compiled_graph import FLAGS, SWITCH, CompiledGraph, library_of
from tools import graph_libraries
from tools.graph_libraries import build, compare, graphs_of
from tools.live.experiment import scenario_file

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")

FUSED = ("-mfma",) if platform.machine() == "x86_64" else ()
"""Has a compiler use fused multiply-adds, if it may; on Arm it does of itself."""
can_fuse = pytest.mark.skipif(
    bool(FUSED) and " fma " not in Path("/proc/cpuinfo").read_text(encoding="utf-8"),
    reason="the processor has no fused multiply-add",
)


def graph(factor: float = 2.0) -> ca.Function:
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2, 2)
    return ca.Function("wave", [x, y], [factor * ca.sin(x) / 3.0, y @ y + ca.dot(x, x)])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(compiled_graph, "FOLDER", tmp_path)
    monkeypatch.delenv(SWITCH, raising=False)
    return tmp_path


def called(one: CompiledGraph) -> list[bytes]:
    one.arguments[0][:] = 0.1, -0.7, 2.5
    one.arguments[1][:] = [[0.3, 0.1], [-0.4, 1e-3]]
    one()
    return [result.tobytes() for result in one.results]


@needs_compiler
def test_a_translated_graph_gives_the_interpreters_numbers_to_the_last_bit_and_no_other_uses_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interpreted = CompiledGraph(graph())
    assert not interpreted.translated
    assert build(graph(), folder) == library_of(graph())
    translated = CompiledGraph(graph())
    assert translated.translated
    assert called(translated) == called(interpreted)
    assert not CompiledGraph(graph(factor=2.0000001)).translated
    monkeypatch.setenv(SWITCH, "interpreted")
    assert not CompiledGraph(graph()).translated, "the switch leaves libraries aside"


@can_fuse
@needs_compiler
def test_products_of_matrices_are_fused_where_a_processor_can_and_a_graphs_own_sums_are_not(
    tmp_path: Path,
) -> None:
    """As CasADi's library and its interpreter round on Arm, where every graph is compared."""
    a, b, c = 1.0 + 2.0**-30, 1.0 - 2.0**-30, -1.0
    row, scalars = ca.MX.sym("row", 1, 2), ca.SX.sym("scalars", 3)
    own = ca.Function("own", [scalars], [scalars[0] * scalars[1] + scalars[2]])
    column, three = ca.MX.sym("column", 2), ca.MX.sym("three", 3)
    both = ca.Function("both", [row, column, three], [row @ column, own(three)])
    (tmp_path / "both.c").write_text(graph_libraries.translation(both), encoding="utf-8")
    words = ["cc", *FLAGS, *FUSED, "both.c", "-o", "both.so"]
    subprocess.run(words, check=True, cwd=tmp_path)
    library = ca.external("both", str(tmp_path / "both.so"))
    product, own_sum = library.call([ca.DM([[c, a]]), ca.DM([1.0, b]), ca.DM([a, b, c])])
    assert float(product) == -(2.0**-60), "once rounded"
    assert float(own_sum) == 0.0, "twice rounded"


def test_a_library_with_other_numbers_or_hardly_any_is_refused() -> None:
    with pytest.raises(RunError, match="result 0 of the C library differs"):
        compare(graph(), graph(factor=2.0 * (1.0 + 2.0**-52)))
    x = ca.SX.sym("x")
    root = ca.Function("root", [x], [ca.sqrt(x - 10.0)])
    with pytest.raises(RunError, match="only 0 of 200 results are finite"):
        compare(root, root)


def test_without_a_compiler_it_says_so_and_succeeds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    assert graph_libraries.main([]) == 0
    assert "more slowly" in capsys.readouterr().err
    with pytest.raises(RunError, match="no C compiler"):
        build(graph())


@needs_compiler
def test_what_cannot_be_built_leaves_nothing_and_what_cannot_be_loaded_is_built_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(graph_libraries, "FLAGS", ("--no-such-flag",))
        with pytest.raises(RunError, match="failed"):
            build(graph(), folder)
    assert list(folder.iterdir()) == []
    library_of(graph()).write_bytes(b"")
    assert not CompiledGraph(graph()).translated
    build(graph(), folder)
    assert CompiledGraph(graph()).translated
    with pytest.raises(RunError, match=r"wave: .*Not a directory"):
        build(graph(), library_of(graph()) / "graphs")


@needs_compiler
def test_every_graph_of_the_shipped_robot_is_translated_and_found_by_planner_and_world(
    folder: Path, robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = graphs_of(robot)
    assert {one.name() for one in found} >= {"sharing", "pose", "hessian", "stance", "drivetrain"}
    for one in found:
        assert build(one, folder).stat().st_size > 0
    made: list[CompiledGraph] = []
    original = CompiledGraph.__init__

    def gather(self: CompiledGraph, function: ca.Function) -> None:
        original(self, function)
        made.append(self)

    monkeypatch.setattr(CompiledGraph, "__init__", gather)
    Planner(robot, session=1)
    World(body_of(robot, PlantConfig()), scenarios.load(scenario_file("stand")))
    assert len(made) > 5
    assert all(one.translated for one in made)
