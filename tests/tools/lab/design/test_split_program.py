"""The schedule that `xrl gains` computes: certified, and the softest that is."""

from __future__ import annotations

import cvxpy as cp
import msgspec
import numpy as np
import pytest

from services.planner.law.certificate import Margins
from shared.arrays import Array
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.robot.robot_model import stand_pose
from tests.planner.states import Stand, at_pose, com_height, shipped_ik
from tools.lab.design import split_program
from tools.lab.design.dynamic_certificate import TRACK, DynamicCertificate

SOLVED = 1e-3
"""The solver's tolerance, in margins and in shares of the cost."""
NODES = ((3, 1), (8, 4), (12, 1), (16, 3), (21, 1))
"""(height, pitch) of the nodes looked at: deep and high, upright and crawling."""


@pytest.fixture(scope="session")
def progress() -> list[tuple[int, int]]:
    return []


@pytest.fixture(scope="session")
def solved(robot: RobotConfig, progress: list[tuple[int, int]]) -> GainSchedule:
    assert robot.gain_schedule is not None
    return split_program.solve(
        robot,
        lambda done, total: progress.append((done, total)),
        design=split_program.design_of(robot.gain_schedule),
        check=False,
    )


@pytest.fixture(scope="module", params=NODES, ids=lambda n: f"node{n[0]}-{n[1]}")
def node(
    request: pytest.FixtureRequest, robot: RobotConfig, solved: GainSchedule
) -> tuple[Array, Stand, Stand]:
    """Return a node's D (6,), and the stand there without and with the full assist."""
    i, j = request.param
    p = np.array([0.0, 0.0, solved.z[i], 0.0, solved.pitch[j], 0.0])
    q = at_pose(robot, shipped_ik(), p, np.array(stand_pose(robot, 1.1)))
    unloaded, loaded = Stand(robot, q, 0.0), Stand(robot, q, robot.assist.force_max)
    return np.array(solved.D[i][j]), unloaded, loaded


def margins(D: Array, stands: tuple[Stand, ...]) -> Margins:
    """Return the smaller of the margins of a leg's D (6,) without and with assist."""
    each = [stand.certificate.margins(np.tile(D, 2)) for stand in stands]
    return Margins(min(m.service for m in each), min(m.onboard for m in each))


def cost(D: Array, stand: Stand) -> float:
    """Return what docs/law.md#gain-split minimises."""
    K_loc = stand.T.T @ np.diag(np.tile(D, 2)) @ stand.T
    return float(K_loc[2, 2] / 1000.0 + K_loc[4, 4] / 10.0 + 1e-3 * 2.0 * D.sum())


def D_max(robot: RobotConfig, stands: tuple[Stand, ...]) -> Array:  # noqa: N802 - the paper's letter
    diagonals = [np.diagonal(stand.gains().K_q)[:6] for stand in stands]
    return np.asarray(robot.certificate.k_q_fraction_max * np.max(diagonals, axis=0), float)


def test_the_shipped_schedule_is_what_the_program_makes(
    robot: RobotConfig, solved: GainSchedule
) -> None:
    """To the solver's digits: they differ from one machine class to another."""
    shipped = robot.gain_schedule
    assert shipped is not None
    assert (solved.digest, solved.inputs) == (shipped.digest, shipped.inputs)
    np.testing.assert_allclose(solved.z, shipped.z)
    np.testing.assert_array_equal(solved.pitch, shipped.pitch)
    np.testing.assert_allclose(solved.D, shipped.D, rtol=0.01, atol=2.0)


def test_the_schedule_covers_the_squat_and_the_crawl(
    robot: RobotConfig, solved: GainSchedule
) -> None:
    assert solved.z[0] < com_height(robot, 0.79)
    assert solved.z[-1] > com_height(robot, 1.188)
    assert solved.pitch[0] <= -0.2
    assert solved.pitch[-1] > 1.2


def test_progress_counts_every_node_and_ends_at_the_last(
    solved: GainSchedule, progress: list[tuple[int, int]]
) -> None:
    total = len(solved.z) * len(solved.pitch)
    assert progress[-1] == (total, total)
    assert [done for done, _ in progress] == sorted(done for done, _ in progress)


def test_each_node_meets_all_that_is_required(
    robot: RobotConfig, node: tuple[Array, Stand, Stand]
) -> None:
    D, *stands = node
    found = margins(D, tuple(stands))
    assert found.service >= 1.0 - SOLVED
    assert found.onboard >= robot.certificate.onboard_fraction - SOLVED
    assert D.min() >= 0.0
    np.testing.assert_array_less(D, D_max(robot, tuple(stands)) + 0.01)


def test_no_gains_nearby_are_softer_and_stand(
    robot: RobotConfig, node: tuple[Array, Stand, Stand]
) -> None:
    """The program is convex: a softer neighbour would be there if a softer one were anywhere."""
    D, unloaded, loaded = node
    most = D_max(robot, (unloaded, loaded))
    least, onboard = cost(D, unloaded), robot.certificate.onboard_fraction
    rng = np.random.default_rng(7)
    standing = 0
    for _ in range(400):
        stiffer = rng.uniform(0.0, 0.1) * (most - D)
        other = np.clip(D + stiffer + rng.normal(0.0, 15.0, 6), 0.0, most)
        found = margins(other, (unloaded, loaded))
        if found.service >= 1.0 and found.onboard >= onboard:
            standing += 1
            assert cost(other, unloaded) >= least * (1.0 - SOLVED)
    assert standing > 20
    softer = margins(0.97 * D, (unloaded, loaded))
    assert softer.service < 1.0 - SOLVED or softer.onboard < onboard - SOLVED


def test_smallest_margins_are_those_asked_for_but_for_what_interpolation_costs(
    robot: RobotConfig, schedule: GainSchedule
) -> None:
    """Without and with the full assist: the stiffness is linear in what lies between."""
    found = split_program.smallest_margins(robot, schedule)
    assert 0.9 <= found.service <= 1.0 + SOLVED
    assert 0.45 <= found.onboard <= 0.5 + SOLVED


def test_smallest_margins_see_a_single_node_that_would_fall(
    robot: RobotConfig, solved: GainSchedule
) -> None:
    rows = [list(row) for row in solved.D]
    rows[12][1] = (0.0,) * 6
    spoiled = msgspec.structs.replace(solved, D=tuple(tuple(row) for row in rows))
    assert split_program.smallest_margins(robot, spoiled).service < 0.5


def test_a_solver_that_stops_at_its_iteration_limit_gives_no_gains(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """CVXPY 1.9 does not raise then, and its variables have values."""
    solve = cp.Problem.solve
    monkeypatch.setattr(cp.Problem, "solve", lambda self, **how: solve(self, max_iter=2, **how))
    with pytest.raises(RunError, match=r"^COM height 0\..* stopped at its iteration limit"):
        split_program.solve(robot)


def test_what_no_gains_can_hold_is_refused_with_the_pose_and_what_to_change(
    robot: RobotConfig,
) -> None:
    certificate = msgspec.structs.replace(robot.certificate, K_required=(1e5,) * 6)
    with pytest.raises(RunError) as caught:
        split_program.solve(msgspec.structs.replace(robot, certificate=certificate))
    message = str(caught.value)
    assert message.startswith("COM height 0.")
    assert "no local gains meet the certificate" in message
    assert "lower certificate.K_required" in message
    assert "\n" not in message


def test_the_shipped_damping_meets_the_dynamic_certificate_everywhere(robot: RobotConfig) -> None:
    """Every pose, drivetrain, hand and delay of [robustness], with 6 dB and twice the delay."""
    assert robot.gain_schedule is not None
    nodes = split_program.dynamic_nodes(robot, robot.gain_schedule)
    split_program.check_design(robot, nodes, split_program.design_of(robot.gain_schedule))


def test_damping_that_shakes_the_rotors_is_refused_with_the_case(robot: RobotConfig) -> None:
    assert robot.gain_schedule is not None
    nodes = split_program.dynamic_nodes(robot, robot.gain_schedule)[:2]
    stiff = split_program.design_of(robot.gain_schedule)._replace(D_B=(150.0,) * 6)
    with pytest.raises(RunError, match=r"COM 0\.\d+ m.*grows by"):
        split_program.check_design(robot, nodes, stiff)


def test_the_search_starts_from_what_is_stable_and_ends_cheaper(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert robot.gain_schedule is not None
    monkeypatch.setattr(split_program, "ROUNDS", 1)
    wanted = msgspec.structs.replace(
        robot.robustness, stiffness=(8000.0,), hands=robot.robustness.hands[:1]
    )
    easier = msgspec.structs.replace(robot, robustness=wanted)
    nodes = split_program.dynamic_nodes(robot, robot.gain_schedule)
    few = DynamicCertificate(easier, nodes[4:5])
    found = split_program._descend(few, split_program.START, lambda _text: None)
    assert few.worst(found, TRACK).stable
    assert split_program._cost(few, found) < split_program._cost(few, split_program.START)
