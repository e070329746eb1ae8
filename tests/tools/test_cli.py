"""The command line skeleton, as a user meets it."""

from __future__ import annotations

import dataclasses
import errno
import importlib.metadata
import itertools
import os
import pty
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest

from services.simulator.physics.plant import plant_from
from shared import revision
from shared.exceptions import BUG_EXIT_CODE, RunError, XrlError
from shared.places import DEFAULT_CONFIG
from shared.process import run_service
from tests.tools.exit_codes import exit_code
from tools import cli
from tools.flags import read_flags
from tools.lab.studies.sweeps import pool
from tools.live.experiment import ExperimentFlags, PlantFlags, make_scenario
from tools.verb_table import NOUNS, PERSONS, VERBS, Verb
from tools.verbs import faults

ROOT = Path(__file__).resolve().parents[2]


def test_help_is_a_screen_that_lists_every_verb_or_its_noun_and_imports_none() -> None:
    code = (
        "import sys, contextlib, tools.cli\n"
        "with contextlib.suppress(SystemExit): tools.cli.main(['--help'])\n"
        "heavy = {'zenoh', 'numpy', 'rich', 'supervisor', 'mujoco', 'pinocchio', 'matplotlib'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    words = [sys.executable, "-c", code]
    said = subprocess.run(words, check=True, capture_output=True, text=True, timeout=60).stdout
    words = " ".join(PERSONS.values()).split()
    assert sorted(words) == sorted({verb.name.split()[0] for verb in VERBS})
    for word in words:
        assert re.search(rf"  {word} +[a-z]", said)
    lines = said.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 100


@pytest.mark.parametrize(
    ("words", "usage", "hint"),
    [
        ("down --li", "xrl down", "unknown flag '--li'; did you mean --limp? "),
        ("demo --kil planner@3", "xrl demo", "unknown flag '--kil'; did you mean --kill? "),
        ("demo --kil=planner@3", "xrl demo", "unknown flag '--kil'; did you mean --kill? "),
        (
            "drive tare -reun-dir=x",
            "xrl drive tare",
            "unknown flag '-reun-dir'; did you mean --run-dir? ",
        ),
        ("sim --nosuch", "xrl sim", "unknown flag '--nosuch'; `--help`"),
        ("drive --nosuch jog", "xrl drive", "unknown flag '--nosuch'; `--help`"),
        ("--nosuch sim", "xrl", "unknown flag '--nosuch'; `--help`"),
        ("status more", "xrl status", "unexpected argument: more"),
    ],
)
def test_a_shortened_or_unknown_flag_is_refused_with_its_verbs_usage_and_the_closest_flag(
    words: str, usage: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """`xrl down --li` was taken as `--limp`, and let a standing robot fall."""
    assert exit_code(words.split()) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"usage: {usage} [")
    assert f"\n{usage}: error: {hint}" in told


DEPLOYED = ("demo", "up", "down", "status", "kill")
"""Scripts in `deploy` that are verbs with the environment made first."""
STAND_INS = {"MODULE": "knee_left", "KIND": "brown_out", "SERVICE": "planner", "VERB": "status"}
"""A value for each placeholder of the pages that a parser would refuse."""


def commands(line: str) -> Iterator[list[str]]:
    """Yield the arguments of each `xrl` in a line of shell."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    for is_joint, part in itertools.groupby(lexer, lambda word: word in ("|", ">", "&&", ";")):
        command = list(part)
        if command[0] in ("sudo", "uvx") and "xrl" in command:
            command = command[command.index("xrl") :]
        folder, _, name = command[0].rpartition("/")
        if folder == "./deploy" and name in DEPLOYED:
            yield [name, *command[1:]]
        elif not is_joint and command[0] in ("xrl", ".venv/bin/xrl"):
            yield command[1:]


def read(words: list[str]) -> str:
    """Read a command as `xrl` does before it starts anything; return its verb."""
    if words[0] == "help":
        words = [*words[1:], "--help"]
    parser = cli._parser(words)
    asked = cli._asked(parser, words)
    found = parser.parse_args(cli._with_values(words))
    flags = read_flags(next(verb for verb in VERBS if verb.name == asked).declaration, found)
    if isinstance(flags, PlantFlags):
        plant_from(flags.plant)
    if isinstance(flags, ExperimentFlags):
        make_scenario(dataclasses.replace(flags, scenario=flags.scenario or "squat"))
    return asked


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb.name)
def test_every_example_of_every_help_is_read_and_its_flags_fit_each_other(verb: Verb) -> None:
    read_verbs = [read(words) for line in verb.examples for words in commands(line)]
    assert verb.name in read_verbs


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def lines_of(page: Path) -> Iterator[tuple[str, bool]]:
    """Yield the commands of a page, and whether it shows them in full, in a block.

    A command with an ellipsis stands for many.
    """
    text = re.sub(r"\b[A-Z]+\b", lambda word: STAND_INS.get(word[0], word[0]), page.read_text())
    blocks = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    for kind, block in blocks.findall(text):
        lines = block.replace("\\\n", " ").splitlines() if kind in ("", "sh", "bash") else ()
        for line in lines:
            if re.match(r"\s*(?:\S+=|sudo |uvx |\./deploy/|(?:\.venv/bin/)?xrl )", line):
                yield line, True
    for span in re.findall(r"`(xrl [^`]+)`", blocks.sub("", text)):
        yield " ".join(span.split()), False


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_is_read(
    page: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("robot.toml", "lab.toml"):
        shutil.copy(DEFAULT_CONFIG, name)
    refused = []
    for line, is_whole in lines_of(page):
        for words in commands(line):
            if "..." in words or " ".join(words) in {verb.name for verb in VERBS} | set(NOUNS):
                continue
            try:
                read(words)
            except (SystemExit, XrlError) as error:
                said = f"{error} {capsys.readouterr().err}"
                is_part = re.search("arguments are required|expected one argument", said)
                if error.args != (0,) and (is_whole or not is_part):
                    refused.append(f"{line}: {said}")
    assert refused == []


@pytest.mark.parametrize("line", ["faults", "--help"])
def test_an_output_that_takes_nothing_is_one_line_and_no_fall(line: str) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "tools.cli", *line.split()],
            stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert done.returncode == 2
    assert re.fullmatch(r"xrl: No space left on device; a disk is full: .*\n", done.stderr)


def test_a_reader_that_has_gone_ends_a_verb_without_words() -> None:
    script = '"$0" -m tools.cli faults | true; echo "${PIPESTATUS[0]}"'
    done = subprocess.run(
        ["bash", "-c", script, sys.executable],
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("141\n", "")


@pytest.mark.parametrize(
    ("ends_by", "code"), [("print('more')", 129), ("raise FleetError('x')", 2), ("1 / 0", 70)]
)
def test_a_terminal_that_is_gone_is_no_fall(ends_by: str, code: int) -> None:
    """As after a dropped ssh session: the error could not be printed, and Python's code was 1."""
    script = (
        "import sys, time\n"
        "from shared.exceptions import FleetError\n"
        "from tools import cli, keyboard\n"
        "from tools.verbs import faults\n"
        "def run(flags: faults.FaultsFlags) -> int:\n"
        "    while not keyboard.is_hung_up(1): time.sleep(0.01)\n"
        f"    {ends_by}\n"
        "faults.run = run\n"
        "sys.exit(cli.main(['faults']))\n"
    )
    person, terminal = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=terminal, stdout=terminal, stderr=terminal
    ) as verb:
        os.close(terminal)
        os.close(person)
        assert verb.wait(timeout=60) == code


def test_a_folder_that_is_gone_or_is_none_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XRL_RUN_DIR", str(tmp_path / "file"))
    for verb in ("down", "status"):
        assert cli.main([verb]) == 2
        assert capsys.readouterr().err.endswith("is not a directory; give another --run-dir\n")
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert cli.main(["up", "--run-dir", "run"]) == 2
    assert "the working directory was removed" in capsys.readouterr().err


def test_workers_without_shared_memory_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*_: object, **__: object) -> None:
        raise OSError(errno.ENOENT, "No such file or directory")

    monkeypatch.setattr("joblib.Parallel.__call__", no_locks)
    with pytest.raises(RunError, match=r"cannot start worker processes: .*/dev/shm"):
        list(pool.results(str, [1, 2], 2, str))


def test_a_bug_is_a_traceback_and_neither_a_fall_nor_bad_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(flags: faults.FaultsFlags) -> int:
        return flags.none  # type: ignore[attr-defined,no-any-return]

    monkeypatch.setattr(faults, "run", broken)
    assert cli.main(["faults"]) == BUG_EXIT_CODE
    told = capsys.readouterr().err
    assert "AttributeError" in told
    assert told.endswith("xrl: this is a bug in xrl; please report the lines above\n")


@pytest.mark.parametrize(
    ("error", "code"),
    [(RunError("x"), 2), (OSError(errno.ENOSPC, "full"), 2), (ValueError("x"), BUG_EXIT_CODE)],
)
def test_a_service_that_ends_by_an_error_has_its_exit_code(error: Exception, code: int) -> None:
    with pytest.raises(SystemExit) as left:
        run_service(Mock(side_effect=error))
    assert left.value.code == code


def test_version_and_help_are_flags_and_help_is_a_word_too(
    capsys: pytest.CaptureFixture[str],
) -> None:
    said = []
    for line in ("--version", "help", "--help", "help topic echo", "topic echo --help"):
        with pytest.raises(SystemExit) as left:
            cli.main(line.split())
        assert left.value.code == 0
        said.append(capsys.readouterr().out)
    assert said[0].startswith(f"xrl {importlib.metadata.version('xrl')} ")
    assert f"({revision.in_words(revision.code())})" in said[0]
    assert said[1] == said[2] != said[3] == said[4]
