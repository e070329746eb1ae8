"""Command lines that are refused before anything is touched: what is typed, and what is said.

LOG stands for a short record. What a hostile file or number does is in tests/tools/test_bad_input.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Final

import pytest

from tests.shared.mcap_log.runs import item, write
from tests.tools.exit_codes import exit_code
from tools.verbs import inject

LENGTH: Final = 40
"""Messages of the record, a millisecond apart."""

REFUSALS: Final = {
    "levitate": "no verb 'levitate'",
    "staus": "did you mean status",
    "demo --duration 0": "a number of at least 0.001 s",
    "demo --pace 2": "a number from 0.1 to 1",
    "demo --config no_such.toml": "no_such.toml: (file): not found",
    "demo --scenario flight": "no scenario 'flight'; must be one of",
    "demo --kill plannner@3": "services:",
    "demo --kill planner@3:BLINK": "signals:",
    "demo --kill planner@30": "not before the end of the run",
    "demo --restart planner@3": "kill it first",
    "demo --kill recorder@3": "without the recorder the run cannot be judged",
    "demo --push 1:2": "write START:DURATION:FX,FY,FZ",
    "sim --loss 1.5": "a number from 0 to 1",
    "sim --delay -1": "of at least 0 ms",
    "sim --hand LOG": "nobody led the hand in it",
    "sim --controller nowhere.py": "nowhere.py: --controller: no such Python file",
    "sim --controller x.py --control centralised": "both choose what computes the torques",
    "up --config nowhere.toml": "nowhere.toml",
    "up --scenario moonwalk": "no scenario 'moonwalk'; must be one of bad_network, crawl, ",
    "up --only planner,elbow": "no service 'elbow'; must be one of",
    "up --only ,": "--only names no service",
    "up --only host_recorder": "runs other services but not",
    "up --no-sim --scenario squat": "--scenario needs the simulator, which --no-sim leaves out",
    "up --only planner --plant ideal": "--plant needs the simulator, which --only leaves out",
    "up --only harness --injectable": "--injectable needs the planner",
    "up --accept estop": "--accept needs the gateway to ROS 2; add --ros2",
    "status": "no fleet is up in",
    "kill planner": "no fleet is up in",
    "status --json --watch": "not allowed with",
    "down --limp --sit": "not allowed with",
    "down --wait 0": "a number of at least 0.001 s",
    "pendant": "no joint service",
    "pendant --for 0": "a number of at least 0.001 s",
    "estop --partly knee_left": "--partly needs --local",
    "estop --local --partly elbow": "'elbow': must be one of",
    "estop --local --wait": "--wait needs the bus",
    "lead --hold a --stop a": "give two different buttons",
    "view": "`xrl up` starts one",
    "view no-such-file.mcap": "no-such-file.mcap",
    "view --port 70000 --sim": "a whole number from 0 to 65535",
    "view --sim --act": "--act needs a running fleet",
    "view LOG --sim": "a record and --sim cannot be combined",
    "view LOG --act": "--act needs a running fleet",
    "view --html x.html": "--html needs a record; give one",
    "drive zero knee_left --at 0.1": (
        "expected 2 numbers (phi and theta in rad, such as 0,-0.5), got 1"
    ),
    "drive zero knee_left --at a,b": "'a': not a valid number; expected phi and theta in rad",
    "drive zero knee_left --at 0,0": "knee_left: theta 0 rad is outside of -3 to -0.2",
    "drive zero knee_left --at nan,-0.5": "'nan': not a valid number",
    "drive zero --all --at 0,-0.5": "for one module; with --all, give --standing",
    "drive zero knee_left --at 0,-28": "if these are degrees: --at 0,-0.4887",
    "drive zero knee_left --at 0,-3.1": "a vertical force alone could not bend the leg",
    "drive zero knee_left --standing 1.5": "between 0 and",
    "drive zero knee_left --standing 1188": "if this is in mm: --standing 1.188",
    "drive zero knee_left --standing nan": "'nan': must be a number",
    "drive zero knee_left --standing 0.4": "cannot be reached",
    "drive zero knee_left --standing 1.294": "at its limit",
    "drive zero knee_left": "give --at or --standing; after a loss of power, --resume",
    "drive zero --all --rest --resume": "--rest changes no zero",
    "drive zero knee_left --at 0,-0.5 --untouched": "--level need --resume",
    "drive zero --at 0,0": "one of the arguments MODULE --all is required",
    "drive tare": "no fleet is up in",
    "drive jog elbow": "invalid choice: 'elbow' (choose from 'ankle_right'",
    "drive jog knee_left --by 0": "--by 0: moves nothing; use at most 0.5 rad either way",
    "drive jog knee_left --by -0.51": "a number from -0.5 to 0.5 rad",
    "drive jog knee_left --period 0.4": "a number from 0.5 to 60 s",
    "drive jog knee_left --cycles 101": "a whole number from 1 to 100",
    "drive jog knee_left --torque-limit 0.5": "--torque-limit",
    "drive configure --dry-run --apply": "not allowed with",
    "drive configure --restore none.json": "none.json",
    "drive configure --apply --again": "--again and --yes need --calibrate",
    "drive configure --calibrate --restore none.json": "remove --restore",
    "drive identify": "one of the arguments MODULE --all is required",
    "drive identify --all knee_left": "not allowed with",
    "drive identify shin_left": "shin_left: must be one of ankle_right",
    "drive identify knee_left --torque -1": "'-1': must be a number of at least 0.001 N m",
    "log export LOG": "no output is given; add --gif FILE",
    "log export LOG --ros2bag b --topic estop": "--topic selects the topics of tables",
    "log export LOG --gif LOG --force": "is the record itself",
    "log export LOG --csv t --topic joint/foot/state": "no topic has this name",
    "log export LOG --csv t --topic imu/attitude": "no message of these topics",
    "log export LOG --csv t --rate 10 --topic run/event": "none of these topics has",
    "log export LOG --csv t --from 900 --to 901": "has nothing after 900 s",
    "log export LOG --gif x.gif --rate 5": "--rate is for tables or a bag",
    "log export LOG --csv t --rate 0": "a number from 0.001 to 10000 Hz",
    "log export LOG --csv t --rate nan": "a number from 0.001 to 10000 Hz",
    "log export LOG --gif x.gif --topic sim/truth": "--topic selects the topics of tables",
    "log report LOG --from 3 --to 2": "--from 3 --to 2: --from must be less than --to",
    "log report LOG -o LOG": "is the record itself",
    "log report LOG -o .": "is a directory",
    "log report LOG -o absent/report.html": "absent/report.html",
    "log report LOG --from 900": "it covers 0.00 to 0.04 s",
    "log report LOG --to -900": "it covers 0.00 to 0.04 s",
    "log recover LOG -o LOG --force": "is the record itself",
    "log recover LOG -o no/x.mcap": "cannot be written: No such file or directory",
    "log resim LOG --tolerance -1": "a number of at least 0",
    "log resim LOG --service elbow": "invalid choice: 'elbow'",
    "log explain no_such.mcap": "cannot be read",
    "log play LOG --rate 0": "a number from 0.001 to 1000",
    "log play LOG --rate -1": "a number from 0.001 to 1000",
    "log play LOG --from 9": "has nothing after 9 s",
    "log play LOG --topic joint/*/sate": "no topic has this name",
    "log play LOG --topic estop": "none of these topics has a message",
    "topic echo": "TOPIC",
    "topic echo foo": "foo",
    "topic echo estop --field mode": "--field mode: estop has no such field; its fields are",
    "topic echo estop --count 0": "a whole number from 1",
    "topic echo estop --hz 0": "a number from 0.001 to 10000 Hz",
    "keys pack planner": "one of the arguments -o/--out --install is required",
    "keys renew": "one of the arguments NAME --all is required",
    "gains --config nowhere.toml": "nowhere.toml",
    "bench --rounds 0": "a whole number from 1",
    "bench bus --rounds 0": "a whole number from 1",
    "bench bus --seconds 0": "a number of at least 0.001 s",
    "bench bus --transport pigeon": "invalid choice: 'pigeon'",
    "bench fleet --pace 0": "a number from 0.1 to 1",
    "bench fleet --pace 3": "a number from 0.1 to 1",
    "bench fleet --json /no-such-folder/fleet.json": "must be a file in an existing folder",
    "bench fleet --json /": "must be a file in an existing folder",
    "study kill --n 0": "--n: '0': must be a whole number from 1",
    "study robust --n 0": "--n: '0': must be a whole number from 1",
    "study latency --n 0": "--n: '0': must be a whole number from 1",
    "study kill --workers 0": "--workers: '0': must be a whole number from 1",
    "study kill --only -1": "--only: '-1': must be a whole number from 0",
    "study kill --cluster tcp://127.0.0.1:1 --workers 2": "--workers is for this machine",
    "study kill --cluster tcp://127.0.0.1:1 --only 1": "--only runs here",
    "study kill --push 0": "--push: '0'",
    "study kill --push -1": "--push: '-1'",
    "study kill --push 4": "--push: '4'",
    "study robust --push nan": "--push: 'nan'",
    "study robust --slope 40": "--slope: '40': must be a number from 0 to",
    "study push --duration 0": "--duration: '0': must be a number of at least",
    "study latency --loss 1.5": "from 0 to 1",
    "study latency --control mine": "'mine': must be one of distributed, diagonal, centralised",
    "study latency --control ,": "name at least one of distributed",
    "study latency --delay 0-200": "numbers from 0 to 60000 separated by commas",
    "study crash --only kill-kne_left": (
        "--only kill-kne_left: no such case; perhaps kill-knee_left, kill-ankle_left, "
        "kill-hip_left; `xrl study crash --list` lists all"
    ),
    "inject 'all loss=20'": "loss: '20' is out of range; must be from 0 to 1 (1 is 100 %)",
    "inject 'all loss=x'": "'all loss=x': loss: 'x' is not valid; write 0.2 or 20%",
    "inject 'all delay=5 at=inf'": "at: 'inf' is not valid; write 4 (s) or 500ms",
    "inject 'all delay=5 at=1e12'": "at: '1e12' is out of range; must be from 0 to 86400 s",
    "inject 'all delay=5 at=-1'": "at: '-1' is out of range",
    "inject 'all loss=0.1 distribution=pareto'": "give a jitter",
    "inject 'all ordered'": "give a delay, a rate or a partition",
    "inject": "'LINK KEY=VALUE ...' --list --clear is required",
    "inject --clear planner-": "'planner-'; the shell used the rest",
    "inject --list 'all loss=1'": "not allowed with",
}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("log"), [item(n) for n in range(LENGTH)])


@pytest.mark.parametrize("typed", REFUSALS)
def test_what_cannot_be_meant_is_refused_with_what_is_right(
    typed: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    before = log.read_bytes()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XRL_RUN_DIR", str(tmp_path / "r"))
    monkeypatch.setattr(inject, "ProxyClient", lambda _run_dir: None)
    assert exit_code([log if word == "LOG" else word for word in shlex.split(typed)]) == 2
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert REFUSALS[typed] in " ".join(" ".join(lines).split())
    assert len(lines) == 1 or lines[0].startswith("usage: xrl ")
    assert out == ""
    assert list(tmp_path.iterdir()) == [], "nothing was begun"
    assert log.read_bytes() == before, "a record is never touched"
