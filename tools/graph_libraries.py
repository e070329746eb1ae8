"""Translates a robot's graphs into C and keeps the libraries: `python -m tools.graph_libraries`.

The graphs are those that a planner and a simulated world of this robot use; they are found by
making both. A library is kept only if it gives the graph's own numbers, to the last bit, on drawn
arguments (`shared.robot.compiled_graph`).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import casadi as ca
import numpy as np

from services.planner.planner import Planner
from services.simulator.body import body_of
from services.simulator.plant import PlantConfig
from services.simulator.world import World
from shared.config import files as config_file
from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.process import DEFAULT_CONFIG
from shared.robot import gain_schedule
from shared.robot.compiled_graph import FOLDER, Array, CompiledGraph, library_of
from tools.runs.experiment import scenario_file

FLAGS: Final = ("-O2", "-ffp-contract=off", "-fPIC", "-shared")
"""No fused multiply-add: it would round otherwise than CasADi's interpreter."""
SAMPLES: Final = 200
"""Drawn arguments on which library and graph must agree."""
DRAWN_MAX: Final = 0.3
"""Largest drawn argument: with most the graphs' angles exist."""
_NO_COMPILER: Final = "no C compiler `cc` on PATH: CasADi interprets the law's graphs, all runs"


def graphs_of(robot: RobotConfig) -> list[ca.Function]:
    """Return every graph that a planner and a simulated world of a robot call."""
    with _gathered() as found:
        Planner(robot, session=1)
        World(body_of(robot, PlantConfig()), scenarios.load(scenario_file("stand")))
    return list({library_of(function): function for function in found}.values())


def build(function: ca.Function, folder: Path = FOLDER) -> Path:
    """Translate a graph into C, compile it, compare both, and keep the library.

    Args:
        function: the graph.
        folder: where libraries are kept; made if absent.

    Returns:
        The library's path.

    Raises:
        RunError: there is no compiler, it failed, or the library gives other numbers.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        raise RunError(_NO_COMPILER)
    path = folder / library_of(function).name
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as name:
        here, source = Path(name), f"{function.name()}.c"
        code = ca.CodeGenerator(source)
        code.add(function)
        (here / source).write_text(code.dump(), encoding="utf-8")
        library = here / path.name
        done = subprocess.run(
            [compiler, *FLAGS, source, "-o", str(library), "-lm"],
            check=False, cwd=here, capture_output=True, text=True,
        )  # fmt: skip
        if done.returncode:
            raise RunError(f"{function.name()}: {compiler} failed: {done.stderr.strip()}")
        compare(function, ca.external(function.name(), str(library)))
        library.replace(path)
    return path


def compare(function: ca.Function, translated: ca.Function) -> None:
    """Compare a graph with its translation on drawn arguments.

    Raises:
        RunError: a number differs in any bit.
    """
    draw, finite = np.random.default_rng(1), 0
    for _ in range(SAMPLES):
        arguments = [
            draw.uniform(-DRAWN_MAX, DRAWN_MAX, function.size_in(i)) for i in range(function.n_in())
        ]
        results, others = _called(function, arguments), _called(translated, arguments)
        finite += all(np.isfinite(one).all() for one in results)
        for index, (one, other) in enumerate(zip(results, others, strict=True)):
            if not _is_same(one, other):
                raise RunError(
                    f"{function.name()}: result {index} of the C library differs from the "
                    "graph's; it is not used"
                )
    if finite < SAMPLES // 2:
        raise RunError(f"{function.name()}: {finite} of {SAMPLES} results are numbers: no proof")


def main(argv: Sequence[str] | None = None) -> int:
    """Build what is missing; what cannot be built is said, and is no error."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--config", type=Path, default=DEFAULT_CONFIG, help="robot file")
    arguments = parser.parse_args(argv)
    robot = config_file.load(arguments.config)
    gain_schedule.require(robot, arguments.config)
    if shutil.which("cc") is None:
        print(_NO_COMPILER, file=sys.stderr)
        return 0
    missing = [graph for graph in graphs_of(robot) if not library_of(graph).is_file()]
    for graph in missing:
        try:
            build(graph)
        except RunError as error:
            print(f"{error}; CasADi interprets this graph", file=sys.stderr)
    return 0


def _is_same(one: Array, other: Array) -> bool:
    """Return True if two results agree in every bit, or are no numbers at the same places."""
    a, b = np.isnan(one), np.isnan(other)
    return np.array_equal(a, b) and one[~a].tobytes() == other[~b].tobytes()


def _called(function: ca.Function, arguments: Sequence[Array]) -> list[Array]:
    found = function.call([ca.DM(argument) for argument in arguments])
    return [np.array(one) for one in found]


@contextmanager
def _gathered() -> Iterator[list[ca.Function]]:
    """Yield a list that gets the graph of every `CompiledGraph` made meanwhile."""
    found: list[ca.Function] = []
    original = CompiledGraph.__init__

    def gather(self: CompiledGraph, function: ca.Function) -> None:
        found.append(function)
        original(self, function)

    CompiledGraph.__init__ = gather  # type: ignore[method-assign]
    try:
        yield found
    finally:
        CompiledGraph.__init__ = original  # type: ignore[method-assign]


if __name__ == "__main__":
    sys.exit(main())
