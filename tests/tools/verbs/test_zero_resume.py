"""`xrl drive zero --resume` on the simulated robot that hangs, with its power off and on."""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from services.joint.differential import joint_from_motor
from services.joint.drivers.base import Drive
from services.joint.drivers.wired_drive import MotorFrame
from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import DriveStatus
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, DriveError
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tests.tools.bringup.hung_robot import HungDrive, HungRobot
from tools.bringup import drive_access, motion_runner, zero_record, zeroing
from tools.bringup.boards import Value
from tools.bringup.zero_record import Identity, ModuleZero, ZeroRecord, why_stranger
from tools.verbs.drive import zero as verb
from tools.verbs.drive.zero import ZeroFlags

EXACT = 3e-4
"""rad; a count of the encoder is 0.01 mrad at the joint."""


class Bench:
    """The robot that hangs, and the verb on it."""

    def __init__(self, robot: RobotConfig, run_dir: Path) -> None:
        self.robot, self.run_dir = robot, run_dir
        self.hung = HungRobot(robot, changed(PlantConfig(), {"drivetrain.joint_damping": 10.0}))
        self.identities: dict[str, Identity] = {}

    @contextlib.contextmanager
    def drives_of(
        self, robot: RobotConfig, modules: Iterable[str], _run_dir: Path
    ) -> Iterator[Mapping[str, Drive]]:
        yield {
            name: HungDrive(
                self.hung,
                self.hung.drives[name]._drive,  # type: ignore[arg-type]
                MotorFrame(0.0, robot.module_named(name).motor_signs),
            )
            for name in modules
        }

    def run(self, **flags: object) -> int:
        flags.setdefault("all", True)
        given = ZeroFlags(config=DEFAULT_CONFIG, run_dir=self.run_dir, yes=True, **flags)  # type: ignore[arg-type]
        given.check()
        return verb.run(given)

    def zero(self) -> None:
        """Keep the true zero, as a perfect protractor would, and where the joints rest."""
        self.hung.wait(2.0)
        record = zero_record.read_zeros(self.path, self.robot)
        modules: dict[str, ModuleZero] = {}
        with self.drives_of(self.robot, MODULES, self.run_dir) as drives:
            for name, drive in drives.items():
                seen = zeroing.look(drive, self.robot)
                assert seen.angles is not None
                identity = self.identities.get(name)
                modules[name] = zero_record.zeroed(
                    self.robot, name, seen.q_there, seen.angles, identity
                )
        zero_record.write_zeros(self.path, msgspec.structs.replace(record, modules=modules))

    @property
    def path(self) -> Path:
        return zero_record.path_of(self.robot, DEFAULT_CONFIG, self.run_dir)

    def cut_power(self) -> None:
        for axis in range(0, 12, 2):
            self.hung.bank.reboot(axis)
        self.hung.wait(2.5)

    def push(self) -> None:
        """Push both feet forward and to the right, and let go."""
        data, joints = self.hung.world.data, self.hung.world.joints
        speed = np.zeros(12)
        speed[2:6] = speed[8:12] = 1.0, 1.0, 1.2, 1.2
        data.qvel[joints.v_index] = speed

    def errors(self) -> list[float]:
        """Return by how much each joint's zero is off, rad; a joint of an unzeroed drive by 9."""
        found = []
        for index, (name, drive) in enumerate(self.hung.drives.items()):
            reading = drive.read(0.02)
            assert reading is not None
            turns = self.hung.world.motor_turns()[0][2 * index : 2 * index + 2]
            signs = self.robot.module_named(name).motor_signs
            true = joint_from_motor((turns[0] * signs[0], turns[1] * signs[1]), 17.5)
            q = joint_from_motor(reading.pos_turns, 17.5)
            off = max(abs(a - b) for a, b in zip(q, true, strict=True))
            found.append(9.0 if reading.status is DriveStatus.UNZEROED else off)
        return found


@pytest.fixture
def bench(robot: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    tmp_path.chmod(0o700)
    made = Bench(robot, tmp_path)

    @contextlib.contextmanager
    def ours(*_: object, **__: object) -> Iterator[bool]:
        yield False

    virtual = SimpleNamespace(
        monotonic=lambda: made.hung.now_ns * 1e-9, strftime=lambda _: "now", sleep=made.hung.wait
    )
    for module in (zeroing, zero_record):
        monkeypatch.setattr(module, "time", virtual)
    clock = {"clock": virtual.monotonic}
    monkeypatch.setattr(verb, "watch", functools.partial(zeroing.watch, **clock))
    monkeypatch.setattr(zeroing, "await_reading", functools.partial(
        motion_runner.await_reading, clock=made.hung.clock
    ))  # fmt: skip
    monkeypatch.setattr(zeroing, "now_ns", made.hung.clock)
    monkeypatch.setattr(zero_record, "drives_of", made.drives_of)
    monkeypatch.setattr(zero_record, "identities", lambda *_: made.identities)
    monkeypatch.setattr(drive_access, "drives_to_ourselves", ours)
    monkeypatch.setattr(drive_access, "service_on", lambda *_: None)
    return made


def test_a_night_without_power_is_resumed_to_a_milliradian(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.zero()
    bench.cut_power()
    assert bench.errors() == [9.0] * 6
    assert bench.run(resume=True) == 0
    assert max(bench.errors()) < EXACT
    said = capsys.readouterr().out
    assert said.count("unmoved") == 6
    assert bench.run(resume=True) == 0
    assert "already zeroed; left unchanged" in capsys.readouterr().out


def test_legs_that_were_cut_off_at_work_are_resumed_once_they_have_swung(
    bench: Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.zero()
    record = zero_record.read_zeros(bench.path, bench.robot)
    legs = dict.fromkeys(module for module in MODULES if not module.startswith("ankle"))
    zero_record.write_zeros(bench.path, zero_record.with_rests(record, legs))  # cut off at work
    bench.cut_power()
    assert bench.run(resume=True, untouched=True, level=True) == FAULT_EXIT_CODE
    assert max(bench.errors()[1:3]) == 9.0
    said = capsys.readouterr().out
    assert re.search(r"hip_left: refused: its last rest is not stored.*--swing", said, re.DOTALL)
    watch = zeroing.watch

    def pushed(*args: object) -> object:
        bench.push()
        return watch(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(verb, "watch", pushed)
    bench.run(resume=True, untouched=True, level=True, swing=True)
    errors = dict(zip(MODULES, bench.errors(), strict=True))
    assert max(errors[module] for module in legs) < EXACT
    said = capsys.readouterr().out
    assert said.count("gravity") >= 4
    assert "second best" in said
    for module in ("ankle_right", "ankle_left"):  # they moved with the swing, or not
        if errors[module] == 9.0:
            assert re.search(rf"{module}: refused.*--at PHI,THETA", said, re.DOTALL)


def test_without_a_stored_zero_the_protractor_is_named(bench: Bench) -> None:
    with pytest.raises(DriveError, match=r"no zero is stored.*protractor"):
        bench.run(resume=True)


def test_a_zero_is_kept_with_the_angles(bench: Bench) -> None:
    with bench.drives_of(bench.robot, ["knee_left"], bench.run_dir) as drives:
        q = zeroing.look(drives["knee_left"], bench.robot).q
    at = (q[0] + 0.01, min(q[1] - 0.02, -0.2))
    assert bench.run(module="knee_left", all=False, at=at) == 0
    before = zero_record.read_zeros(bench.path, bench.robot).modules["knee_left"]
    rest = before.rest
    assert rest is not None
    assert joint_from_motor(rest, 17.5) == pytest.approx(at, abs=1e-4)
    bench.cut_power()
    assert bench.run(module="knee_left", all=False, resume=True) == FAULT_EXIT_CODE
    assert bench.errors()[4] == 9.0, "its hip and ankle have no stored zero"


def test_where_the_joints_rest_is_stored_of_zeroed_drives_only(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.zero()
    bench.push()
    assert bench.run(rest=True) == 0
    bench.cut_power()
    assert bench.run(resume=True) == 0
    assert max(bench.errors()) < EXACT
    bench.cut_power()
    assert bench.run(rest=True) == FAULT_EXIT_CODE
    assert "it is unzeroed" in capsys.readouterr().out
    assert bench.run(resume=True) == FAULT_EXIT_CODE, "its rest was forgotten"


def test_down_stores_where_real_drives_rest(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = tmp_path / "lab.toml"
    lab.write_bytes(DEFAULT_CONFIG.read_bytes())
    services = ["planner", *MODULES]
    assert zero_record.rests_after_down(lab, tmp_path, services) == "", "emulated drives are gone"
    monkeypatch.setattr(zero_record, "is_simulated", lambda _: False)
    assert zero_record.rests_after_down(lab, tmp_path, services) == "", "no zero was stored"
    bench.zero()
    kept = bench.path.rename(tmp_path / "lab.zeros.json")
    before = zero_record.read_zeros(kept, bench.robot)
    nowhere = zero_record.with_rests(before, dict.fromkeys(MODULES))
    zero_record.write_zeros(kept, nowhere)
    assert "6 of 6 modules rest" in zero_record.rests_after_down(lab, tmp_path, services)
    after = zero_record.read_zeros(kept, bench.robot)
    for module, zero in before.modules.items():
        assert after.modules[module].rest == pytest.approx(zero.rest, abs=1e-3)
    kept.write_text("{")
    assert "are not stored: " in zero_record.rests_after_down(lab, tmp_path, services)


# ---- whose zero it is


KEPT: dict[str, Value] = {"axis0.encoder.config.phase_offset": 4021}


@pytest.mark.parametrize(
    ("identity", "words"),
    [
        (None, "^$"),
        (Identity("3A0000000005", KEPT), "^$"),
        (
            Identity("3A0000000009", KEPT),
            "board 3A0000000009, but its zero is of board 3A0000000005",
        ),
        (
            Identity("3A0000000005", {"axis0.encoder.config.phase_offset": 3977}),
            "calibrated after it was zeroed.*phase_offset is 3977, but was 4021",
        ),
    ],
)
def test_another_board_or_calibration_is_named(
    robot: RobotConfig, identity: Identity | None, words: str
) -> None:
    before = Identity("3A0000000005", KEPT)
    zero = zero_record.zeroed(robot, "knee_left", (0.0, -1.0), (0.2, 0.7), before)
    assert re.search(words, why_stranger(zero, robot, "knee_left", identity))


def test_the_robot_file_s_own_changes_are_named(robot: RobotConfig) -> None:
    zero = zero_record.zeroed(robot, "knee_left", (0.0, -1.0), (0.2, 0.7), None)
    other = msgspec.structs.replace(zero, serial_number="3A0000000009")
    assert "the zero is of board 3A0000000009" in why_stranger(other, robot, "knee_left", None)
    other = msgspec.structs.replace(zero, motor_signs=(1, -1))
    assert "motor_signs" in why_stranger(other, robot, "knee_left", None)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not a file of `xrl drive zero`"),
        ('{"gear_ratio": 17.5, "encoder_counts_per_turn": 8192}', "counts_per_turn is 8192"),
        ('{"gear_ratio": 17.5, "encoder_counts_per_turn": 16384, "x": 1}', "unknown field"),
    ],
)
def test_a_file_that_is_damaged_or_another_robot_s_is_refused(
    robot: RobotConfig, tmp_path: Path, text: str, words: str
) -> None:
    path = tmp_path / "zeros.json"
    path.write_text(text)
    with pytest.raises(DriveError, match=words):
        zero_record.read_zeros(path, robot)


def test_a_file_is_read_back_as_it_was_written(robot: RobotConfig, tmp_path: Path) -> None:
    zero = zero_record.zeroed(robot, "knee_left", (0.0, -1.0), (0.2, 0.7), Identity("3A", KEPT))
    record = ZeroRecord(gear_ratio=17.5, encoder_counts_per_turn=16384, modules={"knee_left": zero})
    path = tmp_path / "zeros.json"
    zero_record.write_zeros(path, record)
    assert zero_record.read_zeros(path, robot) == record
