"""The walls of docs/architecture.md, read from the source by its imports."""

from __future__ import annotations

import ast
import fnmatch
import graphlib
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, TypeVar

import pytest

from shared.extras import EXTRAS

ROOT = Path(__file__).parents[1]
PACKAGES = ("services", "shared", "tools")
N = TypeVar("N", bound=ast.AST)


class Import(NamedTuple):
    """One import: `from module import name`, or `import module` with no name."""

    module: str
    name: str

    @property
    def top(self) -> str:
        return self.module.partition(".")[0]

    @property
    def full(self) -> str:
        return f"{self.module}.{self.name}".rstrip(".")


def imports_in(tree: ast.AST) -> list[Import]:
    """Return every import below a node, also those inside functions."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [Import(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            found += [Import(module, alias.name) for alias in node.names]
    return found


SOURCES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}
TREES = {file: ast.parse(source) for file, source in SOURCES.items()}
IMPORTS = {file: imports_in(tree) for file, tree in TREES.items()}


def is_among(file: str, patterns: Iterable[str]) -> bool:
    return any(fnmatch.fnmatch(file, pattern) for pattern in patterns)


def nodes_of(kind: type[N], *folders: str) -> Iterator[tuple[str, N]]:
    """Yield file and node of all of a kind in the files below some folders."""
    for file, tree in TREES.items():
        if file.startswith(folders or ""):
            yield from ((file, node) for node in ast.walk(tree) if isinstance(node, kind))


VENDORS = {
    "getpass": ["shared/places.py"],
    "zenoh": [
        "shared/bus/pubsub.py",
        "shared/bus/session.py",
        "services/ros2_gateway/ros_session.py",
    ],
    "rosbags": ["services/ros2_gateway/conversions.py", "tools/export/ros2_bag.py"],
    "shtab": ["tools/verbs/completion.py"],
    "mujoco": [
        "services/simulator/physics/world.py",
        "services/simulator/physics/body.py",
        "services/simulator/physics/posture.py",
    ],
    "pinocchio": ["services/planner/law/model.py"],
    "aiohttp": ["tools/view/server.py"],
    "cryptography": ["tools/keys/certificates.py"],
    "cvxpy": ["tools/lab/design/split_program.py"],
    "matplotlib": [
        "tools/output.py",
        "tools/judge/figure.py",
    ],
    "PIL": ["tools/judge/reports/moving_picture.py"],
    "casadi": [
        "services/planner/law/certificate.py",
        "services/planner/law/symbolic.py",
        "services/simulator/drives/axis_control.py",
        "services/simulator/physics/actuation.py",
        "shared/robot/compiled_graph.py",
        "tools/graph_libraries.py",
    ],
    "odrive": ["services/joint/drivers/odrive_usb.py", "tools/bringup/usb_board.py"],
    "mcap": ["shared/mcap_log/*.py", "tools/logs/reexecution/rewritten.py"],
    "supervisor": ["tools/fleet/*.py"],
    "can": [
        "shared/can/unix_can.py",
        "services/joint/drivers/odrive_can.py",
        "services/joint/drivers/odrive_frames.py",
        "services/joint/drivers/can_link.py",
        "shared/can/can_sensor.py",
        "tools/bringup/can_monitor.py",
    ],
}
"""Who may import a vendor's package: one owner each; MCAP is written and read in two places,
and python-can is the wire itself to those that speak on it."""

NEEDS_EXTRA = {
    "services/joint/drivers/odrive_usb.py": "usb",
    "tools/bringup/usb_board.py": "usb",
    "tools/view/server.py": "view",
    "tools/export/ros2_bag.py": "ros2",
    "tools/judge/reports/moving_picture.py": "plot",
}
"""Modules that cannot be imported without an extra. Whoever imports one, by a function, has called
`require` there. All others can be imported with the packages of `dependencies` alone."""

EDGES = [
    "services/*/__main__.py",
    "services/*/loop.py",
    "services/joint/drivers/can_link.py",
    "services/joint/drivers/odrive_can.py",
    "services/joint/drivers/odrive_frames.py",
    "services/joint/drivers/odrive_usb.py",
    "services/joint/rearm_guard.py",
    "services/network_proxy/*.py",
    "services/planner/controller.py",
    "services/recorder/auto_recover.py",
    "services/recorder/host_watch.py",
    "services/ros2_gateway/ros_session.py",
    "services/simulator/fronts/*.py",
    "shared/robot/compiled_graph.py",
]
"""Where a service touches clock, bus, wires, threads or files. All its other modules are laws."""

TOOL_LAWS = [
    "shared/can/cansimple*.py",
    "shared/mcap_log/records.py",
    "shared/mcap_log/sequence_stats.py",
    "tools/bringup/hanging_leg.py",
    "tools/bringup/identify.py",
    "tools/bringup/motion.py",
    "tools/bringup/whole_turns.py",
    "tools/lab/design/*.py",
    "tools/logs/reexecution/compare.py",
    "tools/logs/reexecution/params.py",
    "tools/reach.py",
]

LAWS = [
    file
    for file in SOURCES
    if is_among(file, TOOL_LAWS)
    or (file.startswith(("services/", "shared/robot/")) and not is_among(file, EDGES))
]
"""Pure: state, now, inputs -> outputs."""

IMPURE = {
    "asyncio", "can", "datetime", "logging", "multiprocessing", "odrive", "os", "queue", "random",
    "secrets", "select", "signal", "socket", "subprocess", "sys", "threading", "time", "zenoh",
    "shared.bus.session", "shared.log", "shared.process", "shared.can.unix_can",
}  # fmt: skip

LINES_MAX = 600
"""A file has one reason to change, and its length follows; one as long as this has two."""

FOLDERS = {"services", "shared", "deploy", "tests", "tools", "docs", "examples", "findings", ".ci"}


def service_of(file: str) -> str:
    """Return "joint" for services/joint/pd_law.py; "" outside of the services."""
    parts = file.split("/")
    return parts[1] if parts[0] == "services" and len(parts) > 2 else ""


def offenders(files: Iterable[str], wrong: Callable[[str, Import], bool]) -> set[tuple[str, str]]:
    """Return file and import of all that break a rule."""
    return {(file, i.full) for file in files for i in IMPORTS[file] if wrong(file, i)}


def in_folder(*folders: str) -> list[str]:
    return [file for file in IMPORTS if file.startswith(folders)]


def test_imports_are_absolute_and_found_wherever_they_stand() -> None:
    assert offenders(IMPORTS, lambda _, i: i.module.startswith(".")) == set()
    source = "import a.b as c\ndef f():\n    from d.e import g, h\nfrom .i import j"
    found = {imported.full for imported in imports_in(ast.parse(source))}
    assert found == {"a.b", "d.e.g", "d.e.h", ".i.j"}
    assert {service_of(file) for file in SOURCES} == {
        "", "joint", "planner", "harness", "imu", "simulator", "recorder", "network_proxy",
        "ros2_gateway",
    }  # fmt: skip
    assert sum(len(found) for found in IMPORTS.values()) > 300


def test_shared_and_tools_import_nothing_above_them_and_no_circle() -> None:
    above = ("services", "tools", "tests")
    assert offenders(in_folder("shared/"), lambda _, i: i.top in above) == set()
    assert offenders(in_folder("tools/"), lambda _, i: i.top == "tests") == set()
    tuple(graphlib.TopologicalSorter(GRAPH).static_order())  # raises CycleError, which names them


def test_a_service_imports_only_shared_and_itself() -> None:
    def is_foreign(file: str, i: Import) -> bool:
        own = f"services.{service_of(file)}."
        return i.top in ("tools", "tests") or (
            i.top == "services" and not f"{i.full}.".startswith(own)
        )

    assert offenders(in_folder("services/"), is_foreign) == set()


FILE_OF = {
    file.removesuffix(".py").removesuffix("/__init__").replace("/", "."): file for file in SOURCES
}
GRAPH = {
    file: {FILE_OF.get(i.full) or FILE_OF.get(i.module, file) for i in imports} - {file}
    for file, imports in IMPORTS.items()
}
"""Files of ours that a file imports, at its top or in a function."""


def test_a_service_holds_what_its_process_imports_and_nothing_else() -> None:
    """At its start, or later by a function: what only tools import is a tool's."""
    files = {file for file in SOURCES if service_of(file) and not file.endswith("/__init__.py")}
    reached: set[str] = set()
    coming = {file for file in files if file.endswith("/__main__.py")}
    while coming:
        reached |= coming
        coming = set().union(*(GRAPH[file] for file in coming)) - reached
    assert files - reached == set()


ORDER = {
    "shared": ("config", "bus", "robot", "can", "network", "mcap_log"),
    "services/planner": ("law", "watch"),
    "services/simulator": ("drives", "physics", "fronts"),
    "tools": (
        "fleet", "keys", "pads", "logs", "judge", "export", "live", "sim", "bringup", "hosts",
        "view", "lab", "verbs", "dev",
    ),
}  # fmt: skip
"""Rooms of each storey, the lowest first: a room knows those before it. What lies beside rooms of
`shared` and `tools` is below them all; in a service `TOPS` are above them."""
TOPS = ("__main__", "loop", "planner")


@pytest.mark.parametrize("storey", ORDER)
def test_a_room_imports_only_those_below_it(storey: str) -> None:
    rooms = ORDER[storey]
    found = {file.removeprefix(f"{storey}/").split("/")[0] for file in in_folder(f"{storey}/")}
    assert {name for name in found if not name.endswith(".py")} == set(rooms)
    package = storey.replace("/", ".")

    def is_above(file: str, i: Import) -> bool:
        own, other = (
            (name.removeprefix(f"{package}.") + ".").split(".")[0]
            for name in (file.replace("/", "."), i.full)
        )
        if not i.full.startswith(f"{package}.") or own == other:
            return False
        if own not in rooms:
            return other in rooms and not package.startswith("services")
        if other not in rooms:
            return other in TOPS
        return rooms.index(other) > rooms.index(own)

    assert offenders(in_folder(f"{storey}/"), is_above) == set()


def test_the_design_of_the_gains_knows_the_planners_law_and_no_other_service() -> None:
    allowed = ("services.planner.", "shared.", "tools.lab.design.", "tools.reach.")

    def is_foreign(_: str, i: Import) -> bool:
        return i.top in PACKAGES and not f"{i.full}.".startswith(allowed)

    assert offenders(in_folder("tools/lab/design/"), is_foreign) == set()


@pytest.mark.parametrize("vendor", VENDORS)
def test_a_vendor_package_has_its_owner_and_no_other(vendor: str) -> None:
    users = {file for file, found in IMPORTS.items() if any(i.top == vendor for i in found)}
    assert {file for file in users if not is_among(file, VENDORS[vendor])} == set()
    assert users, f"nothing imports {vendor}: the row can go"


ALONE = """
import importlib, sys
for name in {hidden}:
    sys.modules[name] = None
for name in {modules}:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        print(name, error.name)
"""


def test_a_module_can_be_imported_without_the_packages_of_extras_but_those_listed() -> None:
    """Services, `--help` and completion are made of these."""
    hidden = sorted({name for names in EXTRAS.values() for name in names})
    modules = [file.removesuffix(".py").replace("/", ".") for file in SOURCES]
    code = ALONE.format(hidden=hidden, modules=modules)
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True, timeout=100)
    failed = dict(line.split() for line in done.stdout.splitlines())
    assert all(package.split(".")[0] in hidden for package in failed.values()), failed
    files = {name.replace(".", "/") + ".py" for name in failed}
    assert files == set(NEEDS_EXTRA)


def extra_of(imported: Import) -> str:
    """Return the extra that the imported module of ours cannot do without; "" if there is none."""
    files = (f"{name.replace('.', '/')}.py" for name in (imported.module, imported.full))
    return next((NEEDS_EXTRA[file] for file in files if file in NEEDS_EXTRA), "")


def test_what_needs_an_extra_is_imported_where_it_is_required() -> None:
    wrong = []
    for file in SOURCES.keys() - NEEDS_EXTRA.keys():
        wanted = {extra_of(imported) for imported in IMPORTS[file]} - {""}
        for node in ast.walk(TREES[file]) if wanted else ():
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                extras = {extra_of(imported) for imported in imports_in(node)} - {""}
                wanted -= extras
                required = [e for e in extras if f"require('{e}'" in ast.unparse(node)]
                wrong += [(file, node.name, e) for e in extras.difference(required)]
        wrong += [(file, "at its top", extra) for extra in wanted]
    assert wrong == []


def is_impure(_: str, i: Import) -> bool:
    clock = i.full.startswith("shared.clock") and not i.name.startswith("NS_PER_")
    return clock or bool(IMPURE & {i.top, i.module, i.full})


def test_a_law_is_pure_and_an_edge_is_not() -> None:
    """It may take the units of `shared.clock`, and nothing else of it."""
    assert offenders(LAWS, is_impure) == set()
    pure = [row for row in EDGES if not offenders(fnmatch.filter(SOURCES, row), is_impure)]
    assert pure == []
    assert [row for row in TOOL_LAWS if not fnmatch.filter(LAWS, row)] == []


def test_only_tools_print_and_every_package_describes_itself() -> None:
    calls = nodes_of(ast.Call, "services/", "shared/")
    printing = {file for file, call in calls if ast.unparse(call.func) == "print"}
    assert printing <= {"shared/process.py"}, "errors at the start go through run_service"
    silent = [file for file, tree in TREES.items() if not ast.get_docstring(tree)]
    assert silent == []


def test_there_is_no_folder_beside_those_of_the_design() -> None:
    ignored = (ROOT / ".gitignore").read_text(encoding="utf-8").split()
    patterns = [".git", *(line.rstrip("/") for line in ignored)]
    folders = {
        path.name for path in ROOT.iterdir() if path.is_dir() and not is_among(path.name, patterns)
    }
    assert folders == FOLDERS


def test_no_file_or_class_has_two_reasons_to_change() -> None:
    files = [
        path for name in (*PACKAGES, "tests", "examples") for path in (ROOT / name).rglob("*.py")
    ]
    long = {str(p.relative_to(ROOT)) for p in files if len(p.read_text().splitlines()) > LINES_MAX}
    assert long == set()
    # Fields of messages and of the robot file are not counted: these are layouts.
    many = {
        node.name
        for _, node in nodes_of(ast.ClassDef)
        if len(attributes_set_in(node)) > ATTRIBUTES_MAX
    }
    assert many == MANY_ATTRIBUTES


ATTRIBUTES_MAX = 20
"""What a reader can hold at once; a class that has more is made of parts that have names."""
MANY_ATTRIBUTES = {"AxisBank"}
"""It holds twelve axes in arrays, one for each quantity: parts would be arrays of two axes."""


def attributes_set_in(node: ast.ClassDef) -> set[str]:
    """Return the attributes of `self` that a class assigns, in whatever method and form."""
    return {
        target.attr
        for target in ast.walk(node)
        if isinstance(target, ast.Attribute)
        and isinstance(target.ctx, ast.Store)
        and ast.unparse(target.value) == "self"
    }


def test_no_controller_can_see_the_plant() -> None:
    """What is true of the simulated robot is the simulator's alone, and the tools' that run it."""
    others = [file for file in SOURCES if not file.startswith(("services/simulator/", "tools/"))]
    assert offenders(others, lambda _, i: i.full.startswith("services.simulator")) == set()
    controllers = [f"services/{name}/" for name in ("planner", "joint", "harness", "imu")]
    for file in in_folder(*controllers, "tools/lab/design/"):
        assert ".simulation" not in SOURCES[file], file


EXITS = ("sys.exit", "os._exit", "SystemExit")
CODES = (1, 2, 3, 70)


def bare_exit_codes(tree: ast.AST) -> list[int]:
    """Return the lines at which a function of type int, or an exit, gives a code without its name.

    A truth that is made an int is code 1 as well, and so is an exit with a text.
    """
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and ast.unparse(node.returns or node) == "int":
            inside = list(ast.walk(node))
            values = [each.value for each in inside if isinstance(each, ast.Return) and each.value]
            names = {value.id for value in values if isinstance(value, ast.Name)}
            assigned = (each for each in inside if isinstance(each, ast.Assign))
            values += [a.value for a in assigned if names & set(map(ast.unparse, a.targets))]
            found += [value.lineno for value in values if is_bare_code(value)]
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in EXITS:
            found += [node.lineno for value in node.args if is_bare_code(value, texts=True)]
    return found


def is_bare_code(value: ast.expr, *, texts: bool = False) -> bool:
    match value:
        case ast.Constant(value=constant):
            return texts if isinstance(constant, str) else constant in CODES
        case ast.IfExp():
            return any(is_bare_code(one, texts=texts) for one in (value.body, value.orelse))
        case ast.Call(func=ast.Name(id="int"), args=[truth]):
            is_truth = isinstance(truth, ast.Compare | ast.BoolOp)
            return is_truth or ast.unparse(truth).startswith(("not ", "all(", "any(", "bool("))
    return False


def test_an_exit_code_is_given_by_its_name() -> None:
    """1 is a robot that fell, and nothing else: whoever means a fall says `FELL_EXIT_CODE`."""
    trees = {file: TREES[file] for file in in_folder("services/", "tools/")}
    trees |= {path.name: ast.parse(path.read_text()) for path in (ROOT / "examples").glob("*.py")}
    assert {file: lines for file, tree in trees.items() if (lines := bare_exit_codes(tree))} == {}


def test_no_two_classes_have_the_same_name() -> None:
    """There were fourteen `Outcome`s: a name is to say which one is meant."""
    found: dict[str, set[str]] = {}
    for file, node in nodes_of(ast.ClassDef):
        found.setdefault(node.name, set()).add(file)
    assert {name: files for name, files in found.items() if len(files) > 1} == {}


def test_what_leads_a_live_fleet_is_where_the_script_looks_for_it() -> None:
    """`deploy/test` runs the live tests of one folder."""
    marked = [
        path.relative_to(ROOT)
        for path in sorted(ROOT.glob("tests/**/*.py"))
        if "pytest.mark.live" in path.read_text(encoding="utf-8") and path != Path(__file__)
    ]
    assert marked
    assert {path.parent.as_posix() for path in marked} == {"tests/system"}


def test_only_simulations_know_the_centralised_baseline_and_no_robot_file_names_it() -> None:
    users = {
        file
        for file, imports in IMPORTS.items()
        if any(f"{one.full}.".startswith("tools.sim.centralised.") for one in imports)
    }
    assert {file for file in users if not file.startswith("tests/")} == {
        "tools/sim/recorded_lockstep.py",
        "tools/verbs/sim.py",
        "tools/lab/studies/sweeps/latency.py",
    }
    for file in (ROOT / "deploy").rglob("*.toml"):
        assert "centralised" not in file.read_text(encoding="utf-8"), file


def test_no_parser_accepts_abbreviated_flags() -> None:
    """`xrl down --li` was `--limp`. All parsers are a `FlagParser`; an example stands alone."""
    trees = TREES | {
        path.name: ast.parse(path.read_text()) for path in (ROOT / "examples").glob("*.py")
    }
    calls = [
        (file, node.keywords)
        for file, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "argparse.ArgumentParser"
    ]
    assert calls, "the example's"
    for file, keywords in calls:
        assert [ast.unparse(each) for each in keywords] == ["allow_abbrev=False"], file
