"""Translates a robot's graphs into C and keeps the libraries: `python -m tools.graph_libraries`.

The graphs are those of the law, of the simulated drivetrain and of the simulated drives. A library
is kept only if its results equal the graph's own, to the last bit, on random arguments
(`shared.robot.compiled_graph`).
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import casadi as ca
import numpy as np

from services.planner.law import certificate, symbolic
from services.planner.law.model import leg_geometry
from services.simulator.drives import axis_control
from services.simulator.physics.actuation import step_graph
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import PlantConfig
from shared.arguments import FlagParser
from shared.arrays import Array
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, RunError
from shared.extras import is_installed
from shared.robot.compiled_graph import FLAGS, FOLDER, library_of
from tools.flags import ConfigFlags, add_flags, read_flags

SAMPLES: Final = 200
"""Number of random arguments on which library and graph must agree."""
DRAWN_MAX: Final = (0.3, 2.0)
"""Largest random arguments, used in turn. With the first, most results are finite; the second
covers the range of the joints."""
_HELPERS_BEGIN: Final = '#pragma GCC push_options\n#pragma GCC optimize ("fp-contract=fast")\n'
_HELPERS_END: Final = "/* Configuration this file was compiled with */\n"
"""Line in a graph's C code; the functions before it are also in CasADi's own library."""
_HELPER: Final = re.compile(r"^(?=(?:void|int|casadi_int|casadi_real) casadi_\w+\()", re.MULTILINE)
_NO_COMPILER: Final = "no C compiler `cc` on PATH: CasADi interprets the graphs, more slowly"


def command() -> str:
    """Return the command that runs this module from any directory."""
    return shlex.join([sys.executable, "-P", "-m", "tools.graph_libraries"])


def graphs_of(robot: RobotConfig) -> list[ca.Function]:
    """Return the graphs of the law, and those of the simulator if the extra `sim` is installed."""
    graphs = [*symbolic.build(robot, leg_geometry(robot)), certificate.stiffness_graph()]
    if is_installed("sim"):
        body = body_of(robot, PlantConfig())
        drivetrain = step_graph(
            body.plant.drivetrain, body.motor_from_joint, body.model.opt.timestep
        )
        graphs += [drivetrain, axis_control.law_graph()]
    return graphs


def build(function: ca.Function, folder: Path = FOLDER) -> Path:
    """Translate a graph into C, compile it, and keep the library if the results are the same."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise RunError(_NO_COMPILER)
    path = folder / library_of(function).name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _build(function, compiler, path)
    except (OSError, RuntimeError) as error:
        raise RunError(f"{function.name()}: {error}") from None
    return path


def translation(function: ca.Function) -> str:
    """Return a graph as C code.

    The interpreter computes operation by operation, but calls CasADi's library for matrix products
    and similar operations. On Arm that library uses fused multiply-adds, so there the C code uses
    them too.
    """
    code = ca.CodeGenerator(f"{function.name()}.c")
    code.add(function)
    helpers, end, own = code.dump().partition(_HELPERS_END)
    helpers = _HELPER.sub("static ", helpers)  # GCC 14 applies the option only to static functions
    return f"{_HELPERS_BEGIN}{helpers}#pragma GCC pop_options\n{end}{own}"


def _build(function: ca.Function, compiler: str, path: Path) -> None:
    """Build a library under a temporary name, and move it to its path only if it is correct."""
    folder = path.parent
    with tempfile.TemporaryDirectory(dir=folder) as name:
        here, source = Path(name), f"{function.name()}.c"
        (here / source).write_text(translation(function), encoding="utf-8")
        library = here / path.name
        done = subprocess.run(
            [compiler, *FLAGS, source, "-o", str(library), "-lm"],
            check=False, cwd=here, capture_output=True, text=True,
        )  # fmt: skip
        if done.returncode:
            raise RunError(f"{function.name()}: {compiler} failed: {done.stderr.strip()}")
        compare(function, ca.external(function.name(), str(library)))
        _sync(library)
        library.replace(path)
        _sync(folder)


def _sync(path: Path) -> None:
    """Flush a file or folder to disk, because an incomplete library would crash processes."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def compare(function: ca.Function, translated: ca.Function) -> None:
    """Raise RunError if a graph and its translation differ on random arguments."""
    draw, finite = np.random.default_rng(1), 0
    for sample in range(SAMPLES):
        most = DRAWN_MAX[sample % 2]
        arguments = [draw.uniform(-most, most, function.size_in(i)) for i in range(function.n_in())]
        results, others = _called(function, arguments), _called(translated, arguments)
        finite += all(np.isfinite(one).all() for one in results)
        for index, (one, other) in enumerate(zip(results, others, strict=True)):
            if not _is_same(one, other):
                raise RunError(
                    f"{function.name()}: result {index} of the C library differs from the "
                    "graph's; the library is not used"
                )
    if finite < SAMPLES // 4:
        raise RunError(
            f"{function.name()}: cannot be compared: only {finite} of {SAMPLES} results are finite"
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Build the missing libraries, or report a missing compiler. Return 0 if no graph failed."""
    parser = FlagParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_flags(parser, ConfigFlags)
    flags = read_flags(ConfigFlags, parser.parse_args(argv))
    robot = config_file.load(flags.config)
    if shutil.which("cc") is None:
        print(_NO_COMPILER, file=sys.stderr)
        return 0
    missing = [graph for graph in graphs_of(robot) if not library_of(graph).is_file()]
    failed = 0
    for graph in missing:
        try:
            build(graph)
        except RunError as error:
            failed += 1
            print(f"{error}; CasADi interprets this graph", file=sys.stderr)
    return FAULT_EXIT_CODE if failed else 0


def _is_same(one: Array, other: Array) -> bool:
    """Return True if two results agree in every bit, or are NaN at the same places."""
    a, b = np.isnan(one), np.isnan(other)
    return np.array_equal(a, b) and one[~a].tobytes() == other[~b].tobytes()


def _called(function: ca.Function, arguments: Sequence[Array]) -> list[Array]:
    found = function.call([ca.DM(argument) for argument in arguments])
    return [np.array(one) for one in found]


if __name__ == "__main__":
    sys.exit(main())
