"""Tables of `deploy/robot.toml` as typed structs; `robot_config` combines them."""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal

from shared.toml_file import Range, Section

Mass = Annotated[float, Range(0.0, 200.0, "kg")]
PayloadPlace = Annotated[float, Range(-0.3, 0.3, "m")]
Place = Annotated[float, Range(-1.0, 1.0, "m")]
Length = Annotated[float, Range(0.005, 2.0, "m")]
Share = Annotated[float, Range(0.0, 1.0, "1")]
Rate = Annotated[float, Range(1.0, 8000.0, "Hz")]
Milliseconds = Annotated[float, Range(0.1, 10_000.0, "ms")]
Seconds = Annotated[float, Range(0.001, 60.0, "s")]
Angle = Annotated[float, Range(-2 * math.pi, 2 * math.pi, "rad")]


class MassConfig(Section, frozen=True):
    """Masses, paper Table I."""

    module: Annotated[float, Range(0.1, 50.0, "kg")]
    battery: Mass
    payload: Mass
    payload_max: Mass
    payload_com: tuple[PayloadPlace, PayloadPlace, PayloadPlace] = (0.0, 0.0, 0.0)


class GeometryConfig(Section, frozen=True):
    """Lengths, mostly from paper Table I."""

    l1: Length
    l2: Length
    w_hip: Length
    w_base: Length
    l_foot: Length
    w_foot: Length
    foot_height: Length
    harness_point: tuple[Place, Place, Place]
    torso_size: tuple[Length, Length, Length]


class JointConfig(Section, frozen=True):
    """Motors, gear and differential of every module."""

    gear_ratio: Annotated[float, Range(1.0, 200.0, "1")]
    armature: Annotated[float, Range(0.001, 5.0, "kg m^2")]
    encoder_counts_per_turn: Annotated[int, Range(64, 1 << 24, "counts")]
    tau_module_max: Annotated[float, Range(1.0, 1000.0, "N m")]


class LimitConfig(Section, frozen=True):
    """Range of one kind of module; `why` gives the reason."""

    phi: tuple[Angle, Angle]
    theta: tuple[Angle, Angle]
    why: str


class LimitsConfig(Section, frozen=True):
    """Joint ranges."""

    ankle: LimitConfig
    knee: LimitConfig
    hip: LimitConfig


class ModuleConfig(Section, frozen=True):
    """One module: its bus and two CAN nodes, or its ODrive on USB."""

    name: str
    bus: str
    node_ids: tuple[Annotated[int, Range(0, 62, "1")], Annotated[int, Range(0, 62, "1")]]
    motor_signs: tuple[Literal[-1, 1], Literal[-1, 1]] = (1, 1)
    """-1: this motor counts backwards."""
    serial_number: str = ""
    """USB serial number, 12 hexadecimal digits; only "odrive_usb" needs it."""


LinearStiffness = Annotated[float, Range(0.0, 1e5, "N/m")]
AngularStiffness = Annotated[float, Range(0.0, 1e5, "N m/rad")]
LinearDamping = Annotated[float, Range(0.0, 1e5, "N s/m")]
AngularDamping = Annotated[float, Range(0.0, 1e5, "N m s/rad")]
Stiffness6 = tuple[
    LinearStiffness, LinearStiffness, LinearStiffness,
    AngularStiffness, AngularStiffness, AngularStiffness,
]  # fmt: skip
Damping6 = tuple[
    LinearDamping, LinearDamping, LinearDamping, AngularDamping, AngularDamping, AngularDamping
]
Selection = Literal[0, 1]
ShiftLength = Annotated[float, Range(0.0, 0.1, "m")]
ShiftAngle = Annotated[float, Range(0.0, 0.3, "rad")]
StanceLength = Annotated[float, Range(0.0, 0.3, "m")]
StanceAngle = Annotated[float, Range(0.0, 0.8, "rad")]
Stance6 = tuple[StanceLength, StanceLength, StanceLength, StanceAngle, StanceAngle, StanceAngle]


class LawConfig(Section, frozen=True):
    """Gains and choices of the law (docs/law.md); order x, y, z, roll, pitch, yaw."""

    K_p: Stiffness6
    B_p: Damping6
    K_0: Annotated[float, Range(0.0, 1e4, "N m/rad")]
    B_0: Annotated[float, Range(0.0, 1e3, "N m s/rad")]
    S: tuple[Selection, Selection, Selection, Selection, Selection, Selection]
    damping_lambda: Annotated[float, Range(1e-6, 0.5, "m")]
    jacobian: Literal["load_sharing", "average"]
    split: Literal["certified", "diagonal"]
    local_damping_fraction: Annotated[float, Range(0.0, 1.0, "1")]
    """For "diagonal" only: fraction of diag(B_q) that joint services apply."""
    load_sharing_moment_arms: tuple[Share, Share, Annotated[float, Range(0.001, 0.5, "m")]]
    recentre_s: Seconds
    lead_easing: Annotated[float, Range(0.0, 0.95, "1")]
    """alpha: fraction of the hand's force that the planner adds (docs/law.md#harness)."""
    push_integral_s: Annotated[float, Range(0.1, 100.0, "s")] = 1.0
    """Integration time of the force against a lasting sideways push (docs/law.md#gain-split)."""
    push_integral_max: Annotated[float, Range(0.0, 200.0, "N")] = 0.0
    """Maximum of this force, which HOLD drops."""
    shift_max: tuple[ShiftLength, ShiftLength, ShiftAngle, ShiftAngle] = (0.0, 0.0, 0.0, 0.0)
    stance_max: Stance6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Maximum displacement of the right foot, relative to the left, from [geometry]: x, y, z,
    rotation vector; 0: not checked. Beyond it the planner does not lead (MISPLACED)."""
    load_correction: tuple[
        Annotated[float, Range(0.0, 50.0, "kg")], Annotated[float, Range(0.0, 100.0, "N m")]
    ] = (0.0, 0.0)


RequiredLinear = Annotated[float, Range(1.0, 1e5, "N/m")]
RequiredAngular = Annotated[float, Range(1.0, 1e5, "N m/rad")]
RequiredStiffness6 = tuple[
    RequiredLinear, RequiredLinear, RequiredLinear,
    RequiredAngular, RequiredAngular, RequiredAngular,
]  # fmt: skip


class CertificateConfig(Section, frozen=True):
    """Requirements on the local gains alone (docs/law.md#certificate)."""

    K_required: RequiredStiffness6
    """Stiffness that the local gains alone must reach at every node of the schedule, with and
    without full assist; order as in [law]."""
    onboard_fraction: Share
    k_q_fraction_max: Annotated[float, Range(0.1, 10.0, "1")]
    margin_min: Share
    onboard_margin_min: Share


class RobustnessConfig(Section, frozen=True):
    """Model errors under which the loop must be stable (docs/law.md#flexible-joints)."""

    stiffness: tuple[Annotated[float, Range(500.0, 1e6, "N m/rad")], ...]
    """Drivetrain stiffnesses between motor and joint; 1e6 is rigid."""
    damping_s: Annotated[float, Range(0.0, 0.1, "s")]
    """Damping of a drivetrain, divided by its stiffness."""
    torque_lag_ms: Annotated[float, Range(0.05, 20.0, "ms")]
    """First-order lag of the drives' torque."""
    delay_ms: Annotated[float, Range(1.0, 100.0, "ms")]
    delay_margin: Annotated[float, Range(1.0, 10.0, "1")]
    gain_margin: Annotated[float, Range(1.0, 10.0, "1")]
    drift_max: Annotated[float, Range(0.0, 10.0, "1/s")]
    """Maximum growth rate of a drift along a led direction."""
    # the weight's feedforward follows the encoder on the motor, not the joint, so the robot drifts
    hands: tuple[
        tuple[
            Annotated[float, Range(0.0, 1e5, "N/m")],
            Annotated[float, Range(0.0, 1e4, "N s/m")],
            Annotated[float, Range(0.0, 1e4, "N m/rad")],
            Annotated[float, Range(0.0, 1e3, "N m s/rad")],
        ],
        ...,
    ]
    """(k_z, b_z, k_pitch, b_pitch) of each hand at the harness."""


class AssistConfig(Section, frozen=True):
    """Assist force on the operator."""

    force_max: Annotated[float, Range(0.0, 500.0, "N")]
    rate_max: Annotated[float, Range(1.0, 5000.0, "N/s")]
    integral_max: Annotated[float, Range(0.0, 100.0, "N")]
    integral_s: Annotated[float, Range(0.5, 60.0, "s")]
    stale_ms: Annotated[float, Range(50.0, 10000.0, "ms")] = 500.0
    fade_s: Annotated[float, Range(0.5, 60.0, "s")] = 5.0


OpenForce = Annotated[float, Range(10.0, 100.0, "N")]
OpenMoment = Annotated[float, Range(2.0, 50.0, "N m")]
StillTime = Annotated[float, Range(0.1, 5.0, "s")]


class WearerThresholds(Section, frozen=True):
    """All park thresholds for one person, as `xrl log wearer` measures them."""

    open_n: OpenForce
    open_back_nm: OpenMoment
    still_s: StillTime


class ParkConfig(Section, frozen=True):
    """A person may rest on a robot that stands still in a working pose (docs/law.md#park)."""

    enabled: bool = False
    open_n: OpenForce = 22.0
    open_back_nm: OpenMoment = 6.0
    still_s: StillTime = 1.0


LocalStiffness = Annotated[float, Range(0.0, 1e4, "N m/rad")]
LocalDamping = Annotated[float, Range(0.0, 1e3, "N m s/rad")]


class StandGains(Section, frozen=True):
    """Local gains of HOLD at power-up, (phi, theta)."""

    k_p: tuple[LocalStiffness, LocalStiffness]
    k_d: tuple[LocalDamping, LocalDamping]


class StandConfig(Section, frozen=True):
    """Stand gains by kind."""

    ankle: StandGains
    knee: StandGains
    hip: StandGains


class AxisGains(Section, frozen=True):
    """Local gains of one axis."""

    k_p: LocalStiffness
    k_d: LocalDamping


class JointServiceConfig(Section, frozen=True):
    """Timing and limits of the joint service (docs/architecture.md#age-rule)."""

    driver: Literal["odrive_can", "odrive_usb"]
    loop: Literal["onboard", "service"]
    """With "service" drives get torques only, and a module goes limp with its service
    (docs/drives.md#the-drives-own-loop)."""
    rate_hz: Rate
    state_rate_hz: Rate
    max_command_age_ms: Milliseconds
    command_aging_max_ms: Milliseconds
    coupled_ramp_ms: Milliseconds
    engage_after_ms: Milliseconds
    engage_after_max_ms: Milliseconds
    dropout_forget_s: Seconds
    blend_ms: Milliseconds
    damp_fade_s: Seconds
    damp_k_d: LocalDamping
    damp_knee_stop: Angle
    hold_stiffens_theta: tuple[Literal["ankle", "knee", "hip"], ...]
    """In HOLD the gains of every phi, and of theta in these modules, rise to the stand gains."""
    damp_sinks: tuple[Literal["ankle", "knee", "hip"], ...]
    """In DAMP the theta of these modules sinks, and every phi holds."""
    torque_rate_max: Annotated[float, Range(100.0, 1e6, "N m/s")]
    soft_stop_k_p: LocalStiffness
    k_p_max: LocalStiffness
    k_d_max: LocalDamping
    v_max: Annotated[float, Range(0.1, 100.0, "rad/s")]
    pendant_ms: Annotated[float, Range(20.0, 10_000.0, "ms")] = 500.0
    fallen_k_d: LocalDamping = 20.0
    limp_leg_hip_theta: AxisGains = AxisGains(k_p=2700.0, k_d=42.0)
    """Gains of the hips' theta while a knee is limp and its leg stands as a strut; optional."""
    stiffen_ms: Milliseconds = 300.0
    """Rise time of the gains in HOLD and beside a limp module."""
    # at 300 ms (shipped: 100 ms) a led robot fell under a sideways lean 10 N smaller


class EnvelopeConfig(Section, frozen=True):
    """Limits on accepted commands, in addition to the gain schedule's bounds."""

    tau_ff_margin: Annotated[float, Range(0.0, 200.0, "N m")] = 20.0
    q_ref_distance: Annotated[float, Range(0.01, 2.0, "rad")] = 0.2
    q_ref_astray: Annotated[float, Range(0.001, 2.0, "rad")] = 0.04
    """Maximum motion of an ankle's reference that its rate does not explain, within half a second
    (docs/results.md#wrong-planners)."""
    spring_torque: Annotated[float, Range(1.0, 1e3, "N m")] = 40.0
    hold_torque: Annotated[float, Range(1.0, 1e4, "N m")] = 300.0
    tau_coupled: Annotated[float, Range(1.0, 1e3, "N m")] = 60.0
    coupled_work: Annotated[float, Range(0.01, 1e3, "J")] = 1.0
    """Maximum of coupled torque times deflection, if the torque points away from the reference."""
    # the law reaches 0.1 J on plants pushed as hard as soles and motors withstand, 0.6 J in a fall
    coupled_energy: Annotated[float, Range(0.01, 1e3, "J")] = 10.0
    """Maximum work of the coupled torque on moving joints within about 0.3 s
    (docs/results.md#wrong-planners)."""
    dtau_ff: Annotated[float, Range(1.0, 1e5, "N m/s")] = 300.0
    v_ref: Annotated[float, Range(0.1, 100.0, "rad/s")] = 6.0
    """Maximum rate of a reference; caps the larger bounds of nearly straight knees."""
    torque_step: Annotated[float, Range(0.0, 100.0, "N m")] = 1.0
    torque_rate: Annotated[float, Range(1.0, 1e5, "N m/s")] = 1000.0


class TripLimit(Section, frozen=True):
    """Limit of one trip."""

    limit: Annotated[float, Range(0.0, 1e4, "(unit of the trip)")]
    """Value beyond which it trips."""
    after_ms: Annotated[float, Range(0.0, 1e4, "ms")] = 0.0
    """Time beyond the limit before it trips."""


class TripsConfig(Section, frozen=True):
    """Limits beyond which the robot holds and is not led; `xrl faults` lists them."""

    shaking: TripLimit = TripLimit(limit=15.0)
    torque_limit: TripLimit = TripLimit(limit=1.0, after_ms=1000.0)
    speed: TripLimit = TripLimit(limit=8.0, after_ms=20.0)
    legs: TripLimit = TripLimit(limit=0.1, after_ms=50.0)
    reach: TripLimit = TripLimit(limit=0.02, after_ms=50.0)
    tracking: TripLimit = TripLimit(limit=0.15, after_ms=50.0)
    unloaded: TripLimit = TripLimit(limit=20.0, after_ms=60.0)
    sinking: TripLimit = TripLimit(limit=0.8, after_ms=100.0)
    turning: TripLimit = TripLimit(limit=2.5, after_ms=100.0)
    harness: TripLimit = TripLimit(limit=150.0, after_ms=200.0)
    sagging: TripLimit = TripLimit(limit=10.0, after_ms=10.0)
    unattended: TripLimit = TripLimit(limit=0.03, after_ms=20.0)
    edge: TripLimit = TripLimit(limit=0.8, after_ms=200.0)
    tipping: TripLimit = TripLimit(limit=0.95, after_ms=20.0)
    balance: TripLimit = TripLimit(limit=0.045, after_ms=20.0)


Celsius = Annotated[float, Range(-40.0, 200.0, "C")]


class HeatConfig(Section, frozen=True):
    """Thermal model of motors and output stages (docs/law.md#heat)."""

    estimate: bool = False
    """False: no temperatures are estimated."""
    ambient: Celsius = 40.0
    winding_max: Celsius = 95.0
    """Set it below the insulation class by the estimate's error, and 5 C below the
    `temp_limit_lower` of a motor thermistor. Standing up against a clinging hand adds 2 C."""
    stage_max: Celsius = 90.0
    """Output stages; set it below the drives' `temp_limit_lower`."""
    resistance: Annotated[float, Range(0.001, 10.0, "ohm")] = 0.1
    winding_capacity: Annotated[float, Range(1.0, 1e4, "J/K")] = 100.0
    winding_to_housing: Annotated[float, Range(0.01, 20.0, "K/W")] = 0.5
    housing_capacity: Annotated[float, Range(1.0, 1e5, "J/K")] = 1500.0
    housing_to_air: Annotated[float, Range(0.01, 50.0, "K/W")] = 1.2
    stage_per_square_ampere: Annotated[float, Range(0.0, 1.0, "K/A^2")] = 0.054
    """Temperature rise of an output stage per squared current."""
    stage_s: Annotated[float, Range(1.0, 1e4, "s")] = 200.0
    """Time constant of the output stages."""
    ease_s: Annotated[float, Range(5.0, 600.0, "s")] = 60.0
    stand_s: Annotated[float, Range(5.0, 600.0, "s")] = 30.0


class PlannerConfig(Section, frozen=True):
    """Planner timing."""

    rate_hz: Rate
    state_stale_ms: Milliseconds


class HarnessConfig(Section, frozen=True):
    """Six-axis harness sensor: a Stewart platform of six load cells."""

    bus: str
    rate_hz: Rate
    base_radius: Length
    platform_radius: Length
    height: Length
    leg_force_max: Annotated[float, Range(1.0, 1e5, "N")]
    low_pass_hz: Annotated[float, Range(0.1, 500.0, "Hz")]
    stale_ms: Milliseconds
    tare_s: Seconds
    overload_force: Annotated[float, Range(10.0, 1e4, "N")]
    overload_moment: Annotated[float, Range(1.0, 1e3, "N m")]
    overload_after_ms: Milliseconds
    overload_release_s: Seconds


class ImuConfig(Section, frozen=True):
    """IMU on the torso, for sloping floors (docs/law.md#slopes)."""

    fitted: bool = False
    """False: the floor counts as level."""
    bus: str = "imu"
    rate_hz: Rate = 100.0
    """Rate of samples and cycles."""
    mounting: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the sensor: R = Rz(yaw) Rx(roll) Ry(pitch)."""
    stale_ms: Milliseconds = 100.0
    levelling_s: Annotated[float, Range(0.05, 60.0, "s")] = 1.0


class Ros2Config(Section, frozen=True):
    """Gateway to ROS 2, with its topics' rates; 0: not published (docs/ros2.md)."""

    router: str = "tcp/localhost:7447"
    """Zenoh router of the ROS 2 network (`rmw_zenohd`)."""
    distribution: str = "jazzy"
    """jazzy, kilted or lyrical"""
    namespace: str = ""
    """Namespace of the topics and prefix of the frame names, such as `legs`."""
    joint_states_hz: Annotated[float, Range(0.0, 250.0, "Hz")] = 50.0
    """`joint_states`"""
    tf_hz: Annotated[float, Range(0.0, 250.0, "Hz")] = 30.0
    """`/tf`"""
    wrench_hz: Annotated[float, Range(0.0, 250.0, "Hz")] = 50.0
    """`harness/wrench`"""
    diagnostics_hz: Annotated[float, Range(0.0, 10.0, "Hz")] = 1.0
    """`/diagnostics`"""
    clock_hz: Annotated[float, Range(0.0, 250.0, "Hz")] = 50.0
    """`/clock`, of a simulated robot only"""


SupplyVoltage = Annotated[float, Range(0.0, 100.0, "V")]


class SupplyConfig(Section, frozen=True):
    """Voltage thresholds of the drives' supply; 0: off (docs/drives.md)."""

    low_v: SupplyVoltage = 0.0
    sit_v: SupplyVoltage = 0.0
    """Below it a led robot goes down to its lowest pose, if its supply was once above `low_v`. Set
    it well above the drives' `config.dc_bus_undervoltage_trip_level` and the battery's cut-off."""


LOST_S: Final = 0.1
"""Silence after which a drive without a watchdog is lost, s. In DAMP a knee holds if any module on
its host was silent for this time, even with a watchdog (`services.joint.neighbours`)."""


class DriveConfig(Section, frozen=True):
    """ODrive settings that the joint service relies on (docs/drives.md)."""

    torque_constant: Annotated[float, Range(0.001, 5.0, "N m/A")]
    current_lim: Annotated[float, Range(1.0, 200.0, "A")]
    vel_limit: Annotated[float, Range(0.1, 500.0, "turn/s")]
    dc_max_negative_current: Annotated[float, Range(-200.0, -0.001, "A")]
    watchdog_timeout: Annotated[float, Range(0.0, 10.0, "s")]
    encoder_period_ms: Annotated[int, Range(1, 100, "ms")]
    heartbeat_period_ms: Annotated[int, Range(1, 10_000, "ms")]
    zero_mark_turns: Annotated[float, Range(0.0, 4096.0, "turns")]
    encoder_bandwidth: Annotated[float, Range(100.0, 3999.0, "rad/s")] = 2000.0
    """Bandwidth of the drives' position and velocity estimates; from 4000 rad/s on, firmware 0.5.6
    disables the axis (UNSTABLE_GAIN)."""

    @property
    def lost_after_s(self) -> float:
        """Silence after which a drive is lost, s.

        With a watchdog this is its timeout: until then a silent drive holds its last torque and may
        answer again, while FAULT ends only with a restart.
        """
        return self.watchdog_timeout or LOST_S


class CanConfig(Section, frozen=True):
    """CAN bus `[can.NAME]`, in python-can's terms."""

    interface: str
    channel: str


class BusSecurityConfig(Section, frozen=True):
    """Access to the bus (docs/security.md)."""

    mode: Literal["local", "mtls", "open"] = "local"
    """local: this user's UNIX sockets; mtls: TLS with certificates on both sides; open: TCP for
    anyone who reaches a port."""
    keys: str = "~/.config/xrl/{robot}/keys"
    """For `mtls`: this host's certificates and keys, packed by `xrl keys pack`."""
    allow: tuple[str, ...] = ()
    """For `mtls`: IP addresses of further hosts that may link, such as laptops."""


class BusConfig(Section, frozen=True):
    """The Zenoh bus: fixed endpoints, no scouting."""

    lease_ms: Annotated[int, Range(100, 60_000, "ms")]
    endpoints: dict[str, str]
    security: BusSecurityConfig = BusSecurityConfig()


class RecorderConfig(Section, frozen=True):
    """MCAP file parameters (docs/logs.md)."""

    chunk_kib: Annotated[int, Range(1, 65_536, "KiB")]
    flush_ms: Milliseconds
    fsync_s: Seconds
    split_s: Annotated[float, Range(0.0, 86_400.0, "s")] = 0.0
    split_mib: Annotated[int, Range(0, 1 << 20, "MiB")] = 1024
    free_min_mib: Annotated[int, Range(0, 1 << 20, "MiB")] = 256


class OperatorConfig(Section, frozen=True):
    """The simulated hand: a clipped spring-damper (docs/simulator.md#reference-scenario)."""

    k_z: Annotated[float, Range(0.0, 1e5, "N/m")]
    b_z: Annotated[float, Range(0.0, 1e4, "N s/m")]
    force_max: Annotated[float, Range(0.0, 1e4, "N")]
    k_pitch: Annotated[float, Range(0.0, 1e5, "N m/rad")]
    b_pitch: Annotated[float, Range(0.0, 1e4, "N m s/rad")]
    moment_max: Annotated[float, Range(0.0, 1e4, "N m")]
    k_y: Annotated[float, Range(0.0, 1e5, "N/m")] = 1500.0
    b_y: Annotated[float, Range(0.0, 1e4, "N s/m")] = 150.0
    soft_n: Annotated[float, Range(0.0, 1e4, "N")] = 0.0
    """Maximum spring force along z of a softening harness; 0: linear."""


class SimulationConfig(Section, frozen=True):
    """The simulated world."""

    timestep: Annotated[float, Range(1e-5, 0.005, "s")]
    stand_height: Length
    hoist_s: Seconds
    encoder_rate_hz: Rate
    truth_rate_hz: Rate
    harness_noise: Annotated[float, Range(0.0, 100.0, "N")]
    late_slip_ms: Milliseconds
    operator: OperatorConfig
    can_dialect: Literal["0.5", "0.6"] = "0.5"
    """Firmware version whose CANSimple the emulated drives use."""
