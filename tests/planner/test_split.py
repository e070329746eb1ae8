"""What the joint services hold alone: the schedule's D, certified, or stiffer."""

from __future__ import annotations

from itertools import product

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.planner.law.certificate import Margins
from services.planner.law.split import GainSplit, JointGains, ScheduledGains
from shared.bus.messages import SplitSource
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.config.sections import CertificateConfig
from shared.exceptions import ConfigError
from tests.planner.states import ROBOT, Stand, closed, requiring, with_law

POSES = ((1.188, 0.0), (0.948, 0.0), (0.85, 0.6), (0.80, 1.2))
MARGIN, MARGIN_ONBOARD = 0.9, 0.45
"""Fractions of the required margins; the nodes are designed for 1 and 0.5."""


def is_enough(margins: Margins, least: CertificateConfig) -> bool:
    return margins.service >= least.margin_min and margins.onboard >= least.onboard_margin_min


@pytest.fixture(
    scope="module",
    params=product(POSES, (0.0, 200.0)),
    ids=lambda s: f"{s[0][0]:g}m-{s[0][1]:g}rad-{s[1]:g}N",
)
def stand(request: pytest.FixtureRequest) -> Stand:
    (height, pitch), assist = request.param
    return Stand(ROBOT, closed(height, pitch=pitch), assist)


def with_table(scale: float) -> RobotConfig:
    """Return the robot with its schedule's D scaled; what it was made from is kept."""
    schedule = ROBOT.gain_schedule
    assert schedule is not None
    D = (scale * np.array(schedule.D)).tolist()
    return msgspec.structs.replace(ROBOT, gain_schedule=msgspec.structs.replace(schedule, D=D))


@given(st.floats(0.5, 1.1), st.floats(-0.5, 1.7))
def test_between_nodes_each_gain_is_linear_in_height_and_in_pitch(
    schedule: GainSchedule, z: float, pitch: float
) -> None:
    """A table made of a + b z + c pitch + d z pitch comes back exactly; beyond it is held."""

    def bilinear(z: float, pitch: float) -> list[float]:
        return [100.0 * n + 300.0 * z - 20.0 * n * pitch + 70.0 * z * pitch for n in range(1, 7)]

    nodes = {"z": (0.6, 0.65, 0.8, 1.0), "pitch": (-0.4, 0.0, 1.0, 1.5)}
    D = [[bilinear(a, b) for b in nodes["pitch"]] for a in nodes["z"]]
    scheduled = ScheduledGains(msgspec.structs.replace(schedule, D=D, **nodes))
    inside = bilinear(float(np.clip(z, 0.6, 1.0)), float(np.clip(pitch, -0.4, 1.5)))
    np.testing.assert_allclose(scheduled.at(z, pitch), np.tile(inside, 2), rtol=1e-12)


def test_in_the_squat_and_the_crawl_the_schedule_is_enough(
    schedule: GainSchedule, stand: Stand
) -> None:
    local = stand.split(GainSplit(ROBOT))
    assert local.source is SplitSource.SCHEDULE
    assert local.margins.service >= MARGIN
    assert local.margins.onboard >= MARGIN_ONBOARD
    own = ScheduledGains(schedule).at(float(stand.p[2]), float(stand.p[4]))
    np.testing.assert_array_equal(local.D, own)


@pytest.mark.parametrize("seed", range(6))
def test_off_centre_the_schedule_is_enough(seed: int) -> None:
    """What a push leaves: up to 4 cm, 0.04 rad of roll and of yaw."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.04, 0.04, 2)
    roll, yaw = rng.uniform(-0.04, 0.04, 2)
    q = closed(rng.uniform(0.9, 1.18), pitch=rng.uniform(-0.1, 0.6), x=x, y=y, roll=roll, yaw=yaw)
    local = Stand(ROBOT, q, float(rng.uniform(0.0, 200.0))).split(GainSplit(ROBOT))
    assert local.source is SplitSource.SCHEDULE


def test_the_margins_told_are_of_what_is_sent(stand: Stand) -> None:
    for changed in (ROBOT, with_table(0.0), with_law(ROBOT, split="diagonal")):
        local = stand.split(GainSplit(changed))
        assert local.margins == pytest.approx(stand.certificate.margins(local.D))


def test_scheduled_gains_are_softer_where_a_person_leads(stand: Stand) -> None:
    """docs/law.md#gain-split: along z; diag(K_q) gives 2-3e5 N/m there."""
    soft = stand.split(GainSplit(ROBOT)).D
    stiff = stand.split(GainSplit(with_law(ROBOT, split="diagonal"))).D
    K_z = [float(stand.T[:, 2] @ (D * stand.T[:, 2])) for D in (soft, stiff)]
    assert K_z[0] < 0.35 * K_z[1]


def test_gains_that_fall_are_stiffened_no_further(stand: Stand) -> None:
    """A quarter of the way less would not have stood."""
    assert stand.certificate.margins(np.zeros(12)).service < 0.0
    local = stand.split(GainSplit(with_table(0.0)))
    assert local.source is SplitSource.STIFFENED
    assert is_enough(local.margins, ROBOT.certificate)
    stiff = stand.split(GainSplit(requiring(ROBOT, K_required=(1e5,) * 6))).D
    assert np.all(stiff - local.D >= -1e-9)
    softer = local.D - 0.25 * stiff
    assert softer.min() >= -1e-9
    assert not is_enough(stand.certificate.margins(softer), ROBOT.certificate)


@pytest.mark.parametrize("name", ["service", "onboard"])
def test_either_margin_alone_stiffens(stand: Stand, name: str) -> None:
    scheduled = stand.split(GainSplit(ROBOT)).margins
    key = "margin_min" if name == "service" else "onboard_margin_min"
    changed = requiring(ROBOT, **{key: min(1.0, getattr(scheduled, name) + 0.01)})
    local, least = stand.split(GainSplit(changed)), changed.certificate
    assert is_enough(scheduled, least) == (local.source is SplitSource.SCHEDULE)
    assert local.source is not SplitSource.STIFFENED or is_enough(local.margins, least)


def test_uncertified_gains_are_the_stiffest_allowed(stand: Stand) -> None:
    local = stand.split(GainSplit(requiring(ROBOT, K_required=(1e5,) * 6)))
    assert local.source is SplitSource.UNCERTIFIED
    assert local.margins.service < ROBOT.certificate.margin_min
    own = stand.split(GainSplit(ROBOT)).D
    one = ROBOT.stand
    power_up = np.tile([*one.ankle.k_p, *one.knee.k_p, *one.hip.k_p], 2)
    share = ROBOT.certificate.k_q_fraction_max
    for least in (np.zeros(12), own, power_up, share * np.diagonal(stand.gains().K_q)):
        within = np.minimum(least, ROBOT.joint_service.k_p_max)
        np.testing.assert_array_less(within, local.D + 1e-9)


def test_damping_is_the_schedule_s_whatever_the_stiffness(stand: Stand) -> None:
    assert ROBOT.gain_schedule is not None
    for scale in (1.0, 0.8, 0.0):
        local = stand.split(GainSplit(with_table(scale)))
        np.testing.assert_array_equal(local.D_B, np.tile(ROBOT.gain_schedule.D_B, 2))


@given(
    st.integers(0, 10_000),
    st.floats(1.0, 1e5),
    st.sampled_from(["certified", "diagonal"]),
    st.sampled_from([0.0, 1.0]),
)
def test_gains_are_never_negative_nor_over_the_limits(
    seed: int, size: float, split: str, load: float
) -> None:
    """Whatever K_q, B_q, T and the Hessian are; without a load the first choice stands."""
    rng = np.random.default_rng(seed)
    K_q, B_q, hessian = (size * rng.normal(size=(12, 12)) for _ in range(3))
    hessian *= load
    service = msgspec.structs.replace(ROBOT.joint_service, k_p_max=2000.0, k_d_max=50.0)
    limited = requiring(
        msgspec.structs.replace(with_law(ROBOT, split=split), joint_service=service)
    )
    z, pitch = rng.uniform(0.4, 1.3), rng.uniform(-1.0, 2.0)
    local = GainSplit(limited).split(
        lambda: JointGains(K_q, B_q), z, pitch, rng.normal(size=(12, 6)), hessian
    )
    assert np.isfinite([*local.D, *local.D_B, *local.margins]).all()
    for gains, limit in ((local.D, 2000.0), (local.D_B, 50.0)):
        assert gains.min() >= 0.0
        assert gains.max() <= limit


def test_the_papers_split_is_the_diagonal(stand: Stand) -> None:
    bare = msgspec.structs.replace(with_law(ROBOT, split="diagonal"), gain_schedule=None)
    local, (K_q, B_q), service = stand.split(GainSplit(bare)), stand.gains(), bare.joint_service
    share = ROBOT.law.local_damping_fraction
    assert local.source is SplitSource.DIAGONAL
    np.testing.assert_array_equal(local.D, np.clip(np.diagonal(K_q), 0.0, service.k_p_max))
    damping = np.clip(share * np.diagonal(B_q), 0.0, service.k_d_max)
    np.testing.assert_allclose(local.D_B, damping)
    assert local.D_B.max() > 1.0


def test_a_certified_split_without_its_schedule_is_refused() -> None:
    mass = msgspec.structs.replace(ROBOT.mass, payload=5.0)
    for changed, found in (
        (msgspec.structs.replace(ROBOT, gain_schedule=None), "the gain schedule is missing"),
        (msgspec.structs.replace(ROBOT, mass=mass), "mass.payload = 20.4, not 5.0"),
    ):
        with pytest.raises(ConfigError, match="xrl gains") as caught:
            GainSplit(changed)
        assert found in caught.value.found
