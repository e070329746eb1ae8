"""The documentation: generated pages are up to date, and every reference leads somewhere."""

from __future__ import annotations

import ast
import fnmatch
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import msgspec
import pytest

from services.recorder import host_watch
from services.simulator.physics import posture
from shared.bus.session import peers_of
from shared.bus.topics import TOPICS
from shared.config import files
from shared.config.gain_schedule import inputs_of
from shared.config.robot_config import SERVICES
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tools.dev.reference.__main__ import FOLDER, PAGES, text_of
from tools.judge import standing

ROOT = Path(__file__).resolve().parents[1]
CERTIFICATE = files.load(DEFAULT_CONFIG).certificate
DOCS = ROOT / "docs"
_PAGE = re.compile(r"docs/([\w/-]+\.md)(?:#([\w-]+))?")
_PATH = re.compile(r"`((?:services|shared|tools|tests|deploy|docs|examples)/[\w./-]+?)/?`")
_NAME = re.compile(r"(?<!`)`([A-Za-z_][\w.]*\w)(?:\(\))?`(?!`)")
_DOTTED = re.compile(r"(?<!`)`(\w+)\.(?!(?:mcap|png|py|toml|md)`)([A-Za-z_]\w*)(?:\(\))?`(?!`)")
"""`module.name`, `Class.name` or `table.key`, but no file."""
_ABROAD = {
    *("odrv", "odrv0", "control_mode_updated", "flat_endpoints", "is_ready"),  # ODrive
    "erase_configuration",
    *("lowlatency", "wait_before_close"),  # Zenoh
    *("corrupt", "gemodel", "paretonormal"),  # netem
    *("x_limit_torque", "x_limit_torque__mutmut_3"),  # mutmut
    *("_ms", "_us", "_hz", "_degc"),  # endings of names
}
"""Names in backticks that are other programs'."""
_EQUATION = re.compile(r"docs/law\.md\s+((?:(?:,|\s+and)?\s*\(\d+\))+)")
"""One or several numbers of its equations: `docs/law.md (6) and (12)`."""

_SUFFIXES = (".py", ".toml", ".c", ".js", ".json", ".sh", ".md", ".lock", ".rules", "")


@cache
def _tracked() -> dict[Path, str]:
    """Return the text of each file of code, data and pages, but this one."""
    names = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True,
        check=True,
    ).stdout  # fmt: skip
    paths = [ROOT / name for name in names.splitlines()]
    return {
        path: path.read_text(encoding="utf-8")
        for path in paths
        if path.suffix in _SUFFIXES and path.is_file() and path != Path(__file__)
    }


def _texts(*suffixes: str) -> Iterator[tuple[Path, str]]:
    return ((path, text) for path, text in _tracked().items() if path.suffix in suffixes)


def _pages() -> Iterator[tuple[Path, str]]:
    """Yield the pages of docs/, and README.md."""
    for path, text in _texts(".md"):
        if path == ROOT / "README.md" or DOCS in path.parents:
            yield path, text


def _slug(heading: str) -> str:
    """Return a heading's anchor, as GitHub and MyST make it."""
    kept = re.sub(r"[^\w\- ]", "", heading.strip().lower().replace("`", ""))
    return kept.replace(" ", "-")


@cache
def _anchors(page: Path) -> set[str]:
    text = page.read_text(encoding="utf-8")
    labels = set(re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE))
    return labels | {_slug(title) for title in re.findall(r"^#+ (.+)$", text, re.MULTILINE)}


@pytest.mark.parametrize("name", PAGES)
def test_a_generated_page_is_up_to_date(name: str) -> None:
    if name == "verbs.md" and sys.version_info[:2] != (3, 11):
        pytest.skip("its help is as argparse of the oldest Python, 3.11, wraps it")
    path = FOLDER / name
    assert path.read_text(encoding="utf-8") == text_of(name), "run `python -m tools.dev.reference`"


def test_a_table_said_to_need_xrl_gains_is_wholly_an_input_of_the_gain_schedule() -> None:
    config = files.load(DEFAULT_CONFIG)
    inputs = set(inputs_of(config))
    text = DEFAULT_CONFIG.read_text(encoding="utf-8")
    said = re.findall(r"^\[(\w+)\].*after any change here, run `xrl gains`", text, re.MULTILINE)
    assert said
    for section in said:
        fields = msgspec.structs.fields(getattr(config, section))
        assert {f"{section}.{field.name}" for field in fields} <= inputs


def test_the_page_of_networks_says_who_dials_whom() -> None:
    page = (DOCS / "networks.md").read_text(encoding="utf-8")
    for name in (service for service in SERVICES if service not in MODULES):
        (dialled,) = re.findall(rf"^\| `{name}`[^|]* \| ([^|]+) \|$", page, re.MULTILINE)
        six, *others = dialled.split(", ")
        assert six == "the six joint services"
        assert {*MODULES, *(other.strip("`") for other in others)} == set(peers_of(name))


def test_the_table_of_processes_has_every_topic_that_a_service_writes() -> None:
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    for service in (
        "planner",
        "six joint services",
        "harness",
        "imu",
        "recorder",
        "simulator",
        "network_proxy",
    ):
        (cell,) = re.findall(rf"^\| {service}[^|]*\| `[^|]*\| ([^|]*) \|", page, re.MULTILINE)
        told, folder = [], ""
        for name in re.findall(r"`([^`]+)`", cell.partition(";")[0]):
            told.append(name if "/" in name else folder + name)
            folder = told[-1].rpartition("/")[0] + "/"
        writer = "*" if service == "six joint services" else service
        written = {topic.name for topic in TOPICS if writer in topic.writers}
        told_of = {name: set(fnmatch.filter(written, name)) for name in told}
        assert all(told_of.values()), service
        assert set().union(*told_of.values()) == written, service


@pytest.mark.parametrize(
    ("page", "text"),
    [
        ("logs.md", f"| below {host_watch.WARN:g} | warns in its log; warns again only"),
        ("logs.md", f"again only after at least {host_watch.CALM:g} were free"),
        ("logs.md", f"| back to {host_watch.RESUME:g} or more |"),
        ("logs.md", f"the same multiples of {host_watch.RUN_DIR_MIN_MIB} MiB"),
        ("law.md", f"down to {CERTIFICATE.margin_min:g} (`certificate.margin_min`)"),
        (
            "law.md",
            f"down to {CERTIFICATE.onboard_margin_min:g} (`certificate.onboard_margin_min`)",
        ),
        ("tutorial.md", f"The planner accepts margins down to {CERTIFICATE.margin_min:g};"),
        ("simulator.md", f"| below {posture.FALLEN_HEIGHT:.2f} m;"),
        ("simulator.md", f"yaw, either way | over {posture.FALLEN_ANGLE:g} rad"),
        ("simulator.md", f"against the floor | over {posture.FALLEN_TILT:g} rad"),
        ("simulator.md", f"than {standing.SOLE_TILT_MAX:g} rad, roll and yaw"),
        ("simulator.md", f"roll and yaw within {standing.TURNED_MAX:g} rad"),
        ("simulator.md", f"pitch from {standing.PITCH[0]:g} to {standing.PITCH[1]:g} rad"),
    ],
)
def test_a_page_has_the_codes_figure(page: str, text: str) -> None:
    assert text in (DOCS / page).read_text(encoding="utf-8")


def test_every_page_is_linked_and_every_file_and_anchor_on_it_exists() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    pages = {path.name for path in DOCS.glob("*.md")} - {"index.md"}
    assert {page for page in pages if f"(docs/{page}" not in readme} == set()
    broken = []
    for path, text in _texts(".py", ".md", ".toml", ".sh"):
        for page, anchor in _PAGE.findall(text):
            target = DOCS / page
            if not target.exists() or (anchor and anchor not in _anchors(target)):
                broken.append(f"{path.relative_to(ROOT)}: docs/{page}#{anchor}")
    assert broken == []
    missing = [
        f"{page.relative_to(ROOT)}: {name}"
        for page, text in _pages()
        for name in _PATH.findall(text)
        if not (ROOT / name).exists()
    ]
    assert missing == []


def _functions_in_code() -> dict[str, set[int]]:
    """Return the equations of docs/law.md that docstrings name, by function."""
    found: dict[str, set[int]] = {}

    def visit(node: ast.AST, name: str) -> None:
        for child in ast.iter_child_nodes(node):
            inside = name
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                inside = f"{name}.{child.name}"
                for numbers in _EQUATION.findall(ast.get_docstring(child) or ""):
                    found.setdefault(inside, set()).update(map(int, re.findall(r"\d+", numbers)))
            visit(child, inside)

    for path, text in _texts(".py"):
        if _EQUATION.search(text):
            module = path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")
            visit(ast.parse(text), module)
    return found


def test_each_equation_of_the_law_names_its_function_and_that_function_names_it() -> None:
    law = (DOCS / "law.md").read_text(encoding="utf-8")
    text, table = law.split("## Equations in the code")
    shown = [
        int(a or b) for a, b in re.findall(r"\\tag\{(\d+)\}|^\| \((\d+)\) \|", text, re.MULTILINE)
    ]
    listed = re.findall(r"^\| \((\d+)\) \| `([\w.]+)` \|$", table, re.MULTILINE)
    assert shown == list(range(1, len(shown) + 1)), "numbered in the page's order"
    assert [int(number) for number, _ in listed] == shown
    named: dict[str, set[int]] = {}
    for number, function in listed:
        assert callable(pkgutil.resolve_name(function)), function
        named.setdefault(function, set()).add(int(number))
    assert _functions_in_code() == named


_STRINGS = re.compile(
    r'''("(?!"")(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'|\w+"""[\s\S]*?""")|"""[\s\S]*?"""|#.*'''
)
"""The strings of a Python file, or else a docstring or a comment."""


def _known_names() -> set[str]:
    """Return every name in code, in its strings other than docstrings, in data and in paths."""
    known = set(_ABROAD)
    for path, text in _tracked().items():
        known.update(re.findall(r"\w+", str(path.relative_to(ROOT))))
        if path.suffix == ".py":
            known.update(re.findall(r"\w+", _STRINGS.sub(lambda found: found[1] or " ", text)))
        elif path.suffix != ".md":
            known.update(re.findall(r"\w+", text))
    return known


def test_every_name_in_backticks_exists() -> None:
    known = _known_names()
    stale = [
        f"{path.relative_to(ROOT)}: {name}"
        for path, text in _texts(".py", ".md")
        if path.name != "CHANGELOG.md"
        for name in _NAME.findall(text)
        if not known.issuperset(name.split("."))
    ]
    assert stale == [], "renamed or removed"


def test_a_dotted_name_on_a_page_is_in_the_module_or_class_that_it_names() -> None:
    words: dict[str, set[str]] = {}
    for path, text in _texts(".py"):
        found = set(re.findall(r"\w+", text))
        for name in (path.stem, *re.findall(r"^class (\w+)", text, re.MULTILINE)):
            words.setdefault(name, set()).update(found)
    config = files.load(DEFAULT_CONFIG)
    stale = [
        f"{page.relative_to(ROOT)}: {owner}.{name}"
        for page, text in _pages()
        for owner, name in _DOTTED.findall(text)
        if name not in words.get(owner, {name}) and not hasattr(getattr(config, owner, None), name)
    ]
    assert stale == [], "renamed, removed or moved"


def test_the_pages_build_without_a_warning(tmp_path: Path) -> None:
    made = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", DOCS, tmp_path],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    page = (tmp_path / "law.html").read_text(encoding="utf-8")
    sources = re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="(https?:[^"]+)"', page)
    assert sources == [], "the page must open without a network"


TEXT = (ROOT / "docs" / "hazards.md").read_text(encoding="utf-8")
CITED = sorted(set(re.findall(r"`(tests/[^`]+)`", TEXT)))


def test_hazards_name_tests_only_where_they_are_closed() -> None:
    kinds = re.findall(r"^## (.+)$", TEXT, flags=re.MULTILINE)
    assert [kind.split(",")[0] for kind in kinds] == [
        "It falls",
        "It moves unasked",
        "It sinks unasked",
        "It pinches",
        "It cannot be stopped",
    ]
    rows = [line.split("|") for line in TEXT.splitlines() if "**Open**" in line]
    assert rows
    assert all("tests/" not in row[3] for row in rows)


@pytest.mark.parametrize("cited", CITED)
def test_a_test_that_is_named_is_there(cited: str) -> None:
    file, _, name = cited.partition("::")
    assert (ROOT / file).is_file()
    assert not name or f"def {name}(" in (ROOT / file).read_text(encoding="utf-8")
