"""`./deploy/mutants`: checks that tests detect mutants of the code that keeps the robot standing.

mutmut makes the mutants. `tests/mutants.toml` lists groups of modules with their tests, and every
mutant that may survive, with the reason. Each group runs in a separate folder, with links to the
project and with settings for mutmut.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import msgspec
import tomli_w

from shared.arguments import FlagParser
from shared.exceptions import FAULT_EXIT_CODE, RunError, XrlError
from shared.toml_file import Section, read_toml
from tools.terminal import Console, marked

ROOT: Final = Path(__file__).resolve().parents[2]
FILE: Final = ROOT / "tests" / "mutants.toml"
LEAST_SHARE: Final = 0.95
"""Required mutation score: the share of mutants that fail a test."""
SAMPLE: Final = "*__mutmut_13"
"""Sample for CI: the thirteenth mutant of every function that has at least thirteen."""
DEAD: Final = frozenset(("killed", "timeout", "segfault"))
UNTRIED: Final = "not checked"
LINKED: Final = ("services", "shared", "tests", "tools", "deploy", "docs", "README.md")
EXAMPLES: Final = """examples:
  ./deploy/mutants                      all groups; an hour on two cores
  ./deploy/mutants --group joint        one group
  ./deploy/mutants --resume             continue a stopped run
"""


class Group(Section, frozen=True):
    """Modules, and the tests that their mutants must fail."""

    name: str
    modules: tuple[str, ...]
    tests: tuple[str, ...]
    without: tuple[str, ...] = ()
    """Folders in `tests` to omit, because they test other modules."""


class Mutation(Section, frozen=True, order=True):
    """One mutant."""

    function: str
    """mutmut's name, such as `services.joint.differential.x_limit_torque`."""
    was: str
    """Changed lines of code before the mutation, stripped and joined by spaces."""
    becomes: str


class Reason(Section, frozen=True):
    """Reason why some mutants may survive."""

    why: Annotated[str, msgspec.Meta(min_length=20)]
    lives: tuple[Mutation, ...]


class MutantsFile(Section, frozen=True):
    """The whole file."""

    group: tuple[Group, ...]
    reason: tuple[Reason, ...] = ()


class _GroupResult(NamedTuple):
    """Result of a group."""

    counts: Counter[str]
    """Number of mutants by mutmut's status."""
    alive: list[tuple[str, Mutation]]
    """Names and changes of the surviving mutants."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the groups; return 0 if enough mutants fail a test, and the file lists the survivors.

    In a run of all groups, the file must list no other mutants.
    """
    args = _parser().parse_args(argv)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as Ctrl-C does
    console = Console(highlight=False)
    try:
        listed = read_toml(FILE, MutantsFile)
        known = {group.name: group for group in listed.group}
        names = args.group or ([listed.group[0].name] if args.sample else list(known))
        for name in names:
            if name not in known:
                raise RunError(f"--group {name}: unknown; use one of {', '.join(known)}")
        return _judge([_run(known[name], args, console) for name in names], listed, args, console)
    except XrlError as error:
        console.print(f"mutants: {error}", style="red")
        return error.exit_code
    except KeyboardInterrupt:
        console.print("stopped; continue with: ./deploy/mutants --resume")
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = FlagParser(
        prog="./deploy/mutants",
        description=__doc__.split("\n", 1)[0] if __doc__ else None,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--group", action="append", help="only this group; may be repeated")
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--sample", action="store_true", help="a fixed sample; of the first group by default"
    )
    which.add_argument("--resume", action="store_true", help="continue a stopped run")
    parser.add_argument("--children", type=int, default=os.cpu_count(), help="number of processes")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "out" / "mutants", help="folder (default: out/mutants)"
    )
    return parser


def _run(group: Group, args: argparse.Namespace, console: Console) -> _GroupResult:
    folder = args.out.resolve() / group.name
    if not args.resume and folder.exists():
        shutil.rmtree(folder)
    _prepare(group, folder)
    console.print(
        marked("[bold]{}[/]: {} modules; log: {}/run.log", group.name, len(group.modules), folder)
    )
    _mutmut_run(folder, ["--max-children", str(args.children), *[SAMPLE] * args.sample])
    ran = [row for row in _statuses(folder) if row[1] != UNTRIED]
    alive = [
        (name, _change_of(name, _mutmut(folder, "show", name)))
        for name, status in ran
        if status not in DEAD
    ]
    return _GroupResult(Counter(status for _, status in ran), alive)


def _prepare(group: Group, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in LINKED:
        link = folder / name
        if not link.is_symlink():
            link.symlink_to(ROOT / name)
    for module in group.modules:
        if not (ROOT / module).is_file():
            raise RunError(f"{FILE.name}, group {group.name}: {module} does not exist")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    settings = {
        "source_paths": ["services", "shared"],
        "only_mutate": list(group.modules),
        "also_copy": ["tools", "deploy", "docs", "README.md"],
        "pytest_add_cli_args": [
            "-m", "not system", "-p", "no:cacheprovider", "--hypothesis-profile", "mutants",
            *(f"--ignore={folder}" for folder in group.without),
        ],
        "pytest_add_cli_args_test_selection": list(group.tests),
        "timeout_multiplier": 8.0,
        "timeout_constant": 20.0,  # other work may run in parallel
    }  # fmt: skip
    text = tomli_w.dumps({"tool": {"pytest": project["tool"]["pytest"], "mutmut": settings}})
    (folder / "pyproject.toml").write_text(text, encoding="utf-8")


def _mutmut_run(folder: Path, words: Sequence[str]) -> None:
    """Run mutmut; its output goes into run.log."""
    with (folder / "run.log").open("w", encoding="utf-8") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "mutmut", "run", *words],
            cwd=folder,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # so that its leftover processes end too
        )
        try:
            status = process.wait()
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
    if status != 0:
        last = (folder / "run.log").read_text(encoding="utf-8").strip().splitlines()[-3:]
        raise RunError(f"mutmut ended with exit code {status}: {' / '.join(last)}")


def _mutmut(folder: Path, *words: str) -> str:
    command = [sys.executable, "-m", "mutmut", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False).stdout


def _statuses(folder: Path) -> list[tuple[str, str]]:
    """Return each mutant of a group with mutmut's status."""
    lines = _mutmut(folder, "results", "--all", "true").splitlines()
    pairs = [line.strip().partition(": ") for line in lines if "__mutmut_" in line]
    return [(name, status) for name, _, status in pairs]


def _change_of(name: str, shown: str) -> Mutation:
    lines = [line for line in shown.splitlines() if not line.startswith(("---", "+++"))]
    was, becomes = (
        " ".join(line[1:].strip() for line in lines if line.startswith(sign)) for sign in "-+"
    )
    return Mutation(name.rpartition("__mutmut_")[0], was, becomes)


def _judge(
    groups: Sequence[_GroupResult], allowed: MutantsFile, args: argparse.Namespace, console: Console
) -> int:
    counts = sum((found.counts for found in groups), Counter[str]())
    total, dead = counts.total(), sum(counts[word] for word in DEAD)
    if not total:
        raise RunError("no mutant was tested; see run.log of each group")
    listed = {change for reason in allowed.reason for change in reason.lives}
    alive = [row for found in groups for row in found.alive]
    unlisted = [(name, change) for name, change in alive if change not in listed]
    for name, change in unlisted:
        console.print(f"survives: {name}", style="red")
        console.print(f"  - {change.was}\n  + {change.becomes}", markup=False, soft_wrap=True)
    whole = not (args.sample or args.group)
    stale = listed - {change for _, change in alive} if whole else set()
    for change in sorted(stale):
        text = f"listed, but does not survive: {change.function}: {change.becomes}"
        console.print(text, markup=False, soft_wrap=True)
    console.print(
        f"{dead} of {total} mutants fail a test ({dead / total:.1%}); {len(alive)} survive, "
        f"{len(alive) - len(unlisted)} of them for a reason in {FILE.relative_to(ROOT)}"
    )
    low = dead < LEAST_SHARE * total
    if low:
        console.print(f"at least {LEAST_SHARE:.0%} must fail a test", style="red")
    return FAULT_EXIT_CODE if unlisted or stale or low else 0


if __name__ == "__main__":
    sys.exit(main())
