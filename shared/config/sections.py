"""The tables of `deploy/robot.toml` as typed structs; `robot_config` puts them together."""

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
    """The largest `payload` that the file may name."""
    payload_com: tuple[PayloadPlace, PayloadPlace, PayloadPlace] = (0.0, 0.0, 0.0)
    """Centre of the payload, m, torso axes, from the torso's origin."""


class GeometryConfig(Section, frozen=True):
    """Lengths, paper Table I."""

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
    """The 2-DOF module: motors, gear and differential."""

    gear_ratio: Annotated[float, Range(1.0, 200.0, "1")]
    armature: Annotated[float, Range(0.001, 5.0, "kg m^2")]
    encoder_counts_per_turn: Annotated[int, Range(64, 1 << 24, "counts")]
    tau_module_max: Annotated[float, Range(1.0, 1000.0, "N m")]


class LimitConfig(Section, frozen=True):
    """Joint range of one kind of module, and why it is so."""

    phi: tuple[Angle, Angle]
    theta: tuple[Angle, Angle]
    why: str


class LimitsConfig(Section, frozen=True):
    """Joint ranges by kind."""

    ankle: LimitConfig
    knee: LimitConfig
    hip: LimitConfig


class ModuleConfig(Section, frozen=True):
    """One module: which bus and which two CAN nodes, or which ODrive on USB."""

    name: str
    bus: str
    node_ids: tuple[Annotated[int, Range(0, 62, "1")], Annotated[int, Range(0, 62, "1")]]
    motor_signs: tuple[Literal[-1, 1], Literal[-1, 1]] = (1, 1)
    """-1: that motor counts down where the differential's equations have it count up."""
    serial_number: str = ""
    """12 hexadecimal digits, as USB shows them: for the driver over USB, and for what `xrl drive`
    and `xrl doctor` read or write there."""


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
    """Gains and choices of the law (docs/law.md)."""

    K_p: Stiffness6
    B_p: Damping6
    K_0: Annotated[float, Range(0.0, 1e4, "N m/rad")]
    B_0: Annotated[float, Range(0.0, 1e3, "N m s/rad")]
    S: tuple[Selection, Selection, Selection, Selection, Selection, Selection]
    damping_lambda: Annotated[float, Range(1e-6, 0.5, "m")]
    jacobian: Literal["load_sharing", "average"]
    split: Literal["certified", "diagonal"]
    local_damping_fraction: Annotated[float, Range(0.0, 1.0, "1")]
    load_sharing_moment_arms: tuple[Share, Share, Annotated[float, Range(0.001, 0.5, "m")]]
    recentre_s: Seconds
    lead_easing: Annotated[float, Range(0.0, 0.95, "1")]
    push_integral_s: Annotated[float, Range(0.1, 100.0, "s")] = 1.0
    """Time in which a force of K_p times the error grows against a push from the side."""
    push_integral_max: Annotated[float, Range(0.0, 200.0, "N")] = 0.0
    """Most of that force; HOLD drops it, and must stand the step."""
    shift_max: tuple[ShiftLength, ShiftLength, ShiftAngle, ShiftAngle] = (0.0, 0.0, 0.0, 0.0)
    stance_max: Stance6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
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
    """What local gains must hold alone (docs/law.md#gain-split and docs/law.md#certificate)."""

    K_required: RequiredStiffness6
    onboard_fraction: Share
    k_q_fraction_max: Annotated[float, Range(0.1, 10.0, "1")]
    margin_min: Share
    onboard_margin_min: Share


class RobustnessConfig(Section, frozen=True):
    """Errors that the loop must be stable with (the dynamic certificate)."""

    stiffness: tuple[Annotated[float, Range(500.0, 1e6, "N m/rad")], ...]
    """Stiffnesses of the drivetrain between motor and joint that the loop must be stable with; 1e6
    is rigid."""
    damping_s: Annotated[float, Range(0.0, 0.1, "s")]
    """Damping of the drivetrain, N m s/rad per N m/rad."""
    torque_lag_ms: Annotated[float, Range(0.05, 20.0, "ms")]
    """First-order lag of the drives' torque."""
    delay_ms: Annotated[float, Range(1.0, 100.0, "ms")]
    """From a state's sample to the first use of its command."""
    delay_margin: Annotated[float, Range(1.0, 10.0, "1")]
    gain_margin: Annotated[float, Range(1.0, 10.0, "1")]
    drift_max: Annotated[float, Range(0.0, 10.0, "1/s")]
    """A motion without oscillation along a led direction may grow at this rate: with the encoder
    at the motor, the weight's feedforward follows the motor and not the joint."""
    hands: tuple[
        tuple[
            Annotated[float, Range(0.0, 1e5, "N/m")],
            Annotated[float, Range(0.0, 1e4, "N s/m")],
            Annotated[float, Range(0.0, 1e4, "N m/rad")],
            Annotated[float, Range(0.0, 1e3, "N m s/rad")],
        ],
        ...,
    ]
    """(k_z, b_z, k_pitch, b_pitch) of hands at the harness, the lightest first."""


class AssistConfig(Section, frozen=True):
    """Assist force on the operator."""

    force_max: Annotated[float, Range(0.0, 500.0, "N")]
    rate_max: Annotated[float, Range(1.0, 5000.0, "N/s")]
    integral_max: Annotated[float, Range(0.0, 100.0, "N")]
    integral_s: Annotated[float, Range(0.5, 60.0, "s")]
    stale_ms: Annotated[float, Range(50.0, 10000.0, "ms")] = 500.0
    fade_s: Annotated[float, Range(0.5, 60.0, "s")] = 5.0


class WearerThresholds(Section, frozen=True):
    """What differs between the persons who wear a robot; `xrl log wearer` measures it."""

    open_n: Annotated[float, Range(10.0, 100.0, "N")] = 22.0
    """Net pull up that opens it; the peak of a led squat."""
    open_back_nm: Annotated[float, Range(2.0, 50.0, "N m")] = 6.0
    """Moment backwards that opens it."""
    still_s: Annotated[float, Range(0.1, 5.0, "s")] = 1.0
    """Time for which it must be still before it parks."""


class ParkConfig(WearerThresholds, frozen=True):
    """Lets a person rest on a robot that stands still, crouched (docs/law.md#park)."""

    enabled: bool = False


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
    damp_sinks: tuple[Literal["ankle", "knee", "hip"], ...]
    torque_rate_max: Annotated[float, Range(100.0, 1e6, "N m/s")]
    soft_stop_k_p: LocalStiffness
    k_p_max: LocalStiffness
    k_d_max: LocalDamping
    v_max: Annotated[float, Range(0.1, 100.0, "rad/s")]
    pendant_ms: Annotated[float, Range(20.0, 10_000.0, "ms")] = 500.0
    """Silence of a pendant that is an emergency stop, once the pendant was there."""
    fallen_k_d: LocalDamping = 20.0
    """Damping of all twelve axes once the robot has fallen; nothing else is left then."""
    limp_leg_hip_theta: AxisGains = AxisGains(k_p=2700.0, k_d=42.0)
    """Gains of each hip's theta while a knee is limp: its leg stands as a strut on them."""
    stiffen_ms: Milliseconds = 300.0
    """In HOLD, and beside a limp module: the rise of the gains. Within 300 ms, leaned on from the
    side while led, it fell from 10 N less on."""


class EnvelopeConfig(Section, frozen=True):
    """Envelope of accepted commands, beyond `GainSchedule.bounds`."""

    tau_ff_margin: Annotated[float, Range(0.0, 200.0, "N m")] = 20.0
    """Feedforward beyond the bounds of straight stands: leans, slopes and other stances."""
    q_ref_distance: Annotated[float, Range(0.01, 2.0, "rad")] = 0.2
    """Largest distance of the reference from the joint."""
    q_ref_astray: Annotated[float, Range(0.001, 2.0, "rad")] = 0.04
    """Farthest an ankle's reference may go another way than its rate says, within half a second.
    The law's goes 0.3 mrad while a person leads, and 20 while the height has a reference of its
    own."""
    spring_torque: Annotated[float, Range(1.0, 1e3, "N m")] = 40.0
    """Largest k_p times that distance."""
    hold_torque: Annotated[float, Range(1.0, 1e4, "N m")] = 300.0
    """Most torque that HOLD's stiffening adds; an axis farther from its reference holds its
    position."""
    tau_coupled: Annotated[float, Range(1.0, 1e3, "N m")] = 60.0
    """Largest coupled torque."""
    coupled_work: Annotated[float, Range(0.01, 1e3, "J")] = 1.0
    """Work of the coupled torque against the joint's way to its reference. The law's is 0.1 J on
    drawn plants pushed as hard as soles and motors bear, and 0.6 J in a fall."""
    coupled_energy: Annotated[float, Range(0.01, 1e3, "J")] = 10.0
    """Work of the coupled torque on a module's moving joints, within some 0.3 s. The law's is 2 J
    on drawn plants pushed with 75 % of what soles and motors bear, and 6 J when a hand of 150 N
    leads up."""
    dtau_ff: Annotated[float, Range(1.0, 1e5, "N m/s")] = 300.0
    """Largest rate of the feedforward."""
    v_ref: Annotated[float, Range(0.1, 100.0, "rad/s")] = 6.0
    """Largest rate of the reference where a pose's own bound is larger: straight knees turn ever
    faster."""
    torque_step: Annotated[float, Range(0.0, 100.0, "N m")] = 1.0
    """Torque step from one command to the next, plus `torque_rate` times the time between them."""
    torque_rate: Annotated[float, Range(1.0, 1e5, "N m/s")] = 1000.0
    """Rate of the torque between two commands; see `torque_step`."""


class TripLimit(Section, frozen=True):
    """Limit of one trip."""

    limit: Annotated[float, Range(0.0, 1e4, "the trip's own unit")]
    """Value beyond which it trips."""
    after_ms: Annotated[float, Range(0.0, 1e4, "ms")] = 0.0
    """Time beyond the limit, without a break, before it trips."""


class TripsConfig(Section, frozen=True):
    """Trips: limits that take the robot out of being led (docs/reference/faults.md)."""

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
    """What motors and output stages are, to estimate how warm they get (docs/results.md)."""

    estimate: bool = False
    """False: nothing is known of them, nothing estimated, and the robot stands up for no heat."""
    ambient: Celsius = 40.0
    """Air at the robot on the hottest day."""
    winding_max: Celsius = 95.0
    """No winding is to be warmer: below the insulation's class by what the estimate may be off, and
    5 C below the `temp_limit_lower` of a motor's thermistor: to stand up against a hand that clings
    adds 2 C."""
    stage_max: Celsius = 90.0
    """No output stage is to be warmer: below the drives' `temp_limit_lower`."""
    resistance: Annotated[float, Range(0.001, 10.0, "ohm")] = 0.1
    """Resistance of a phase at 25 C; the drive's calibration finds it (`phase_resistance`)."""
    winding_capacity: Annotated[float, Range(1.0, 1e4, "J/K")] = 100.0
    winding_to_housing: Annotated[float, Range(0.01, 20.0, "K/W")] = 0.5
    housing_capacity: Annotated[float, Range(1.0, 1e5, "J/K")] = 1500.0
    housing_to_air: Annotated[float, Range(0.01, 50.0, "K/W")] = 1.2
    stage_per_square_ampere: Annotated[float, Range(0.0, 1.0, "K/A^2")] = 0.054
    """Rise of an output stage with the square of its current."""
    stage_s: Annotated[float, Range(1.0, 1e4, "s")] = 200.0
    """Time constant of the output stages."""
    ease_s: Annotated[float, Range(5.0, 600.0, "s")] = 60.0
    """Seconds left at this load below which the assist goes, and the person is told."""
    stand_s: Annotated[float, Range(5.0, 600.0, "s")] = 30.0
    """Seconds left below which the robot moves to where it stays cooler by itself."""


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
    """IMU on the torso, for floors that slope (docs/law.md#slopes)."""

    fitted: bool = False
    """True if the robot has one; without it the floor is taken as level."""
    bus: str = "imu"
    rate_hz: Rate = 100.0
    """Rate of the sensor's samples and of the service's cycles."""
    mounting: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the sensor on the torso, rad: R = Rz(yaw) Rx(roll) Ry(pitch)."""
    stale_ms: Milliseconds = 100.0
    """Age beyond which a sample is ignored; the slope stays."""
    levelling_s: Annotated[float, Range(0.05, 60.0, "s")] = 1.0
    """Time constant of the slope."""


class Ros2Config(Section, frozen=True):
    """Gateway to ROS 2, a process of its own that publishes what the robot does (docs/ros2.md)."""

    router: str = "tcp/localhost:7447"
    """Endpoint of the Zenoh router of the ROS 2 network (`rmw_zenohd`)."""
    distribution: str = "jazzy"
    """Distribution of that network: jazzy, kilted or lyrical."""
    namespace: str = ""
    """Namespace of the topics, and what the names of the frames begin with; such as `legs`."""
    joint_states_hz: Annotated[float, Range(0.0, 250.0, "Hz")] = 50.0
    """Rate of `joint_states`; 0: not published."""
    tf_hz: Annotated[float, Range(0.0, 250.0, "Hz")] = 30.0
    """Rate of `/tf`; 0: not published."""
    wrench_hz: Annotated[float, Range(0.0, 250.0, "Hz")] = 50.0
    """Rate of `harness/wrench`; 0: not published."""
    diagnostics_hz: Annotated[float, Range(0.0, 10.0, "Hz")] = 1.0
    """Rate of `/diagnostics`; 0: not published."""
    clock_hz: Annotated[float, Range(0.0, 250.0, "Hz")] = 50.0
    """Rate of `/clock`, of a simulated robot only; 0: not published."""


SupplyVoltage = Annotated[float, Range(0.0, 100.0, "V")]


class SupplyConfig(Section, frozen=True):
    """Levels of the drives' supply; 0: never (docs/drives.md)."""

    low_v: SupplyVoltage = 0.0
    """Below it the person is told."""
    sit_v: SupplyVoltage = 0.0
    """Below it a robot that is led goes down by itself, if its supply was once above `low_v`: well
    above `config.dc_bus_undervoltage_trip_level` of the drives, and above what the battery's own
    electronics switch off at."""


LOST_S: Final = 0.1
"""Silence after which a drive without a watchdog is lost, s. In DAMP a knee holds beside any module
of its host that has been silent for that time, whatever the watchdog
(`services.joint.neighbours`)."""


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
    encoder_bandwidth: Annotated[float, Range(100.0, 8000.0, "rad/s")] = 2000.0
    """Bandwidth of the drives' estimate of position and velocity."""

    @property
    def lost_after_s(self) -> float:
        """Silence after which a drive is lost, s.

        Not before its own watchdog has fired: until then a silent drive holds its last torque and
        comes back as if nothing had been, while a FAULT is for good.
        """
        return self.watchdog_timeout or LOST_S


class CanConfig(Section, frozen=True):
    """A CAN bus as python-can takes it."""

    interface: str
    channel: str


class BusSecurityConfig(Section, frozen=True):
    """Who may link to the bus (docs/security.md)."""

    mode: Literal["local", "mtls", "open"] = "local"
    """UNIX sockets of this user; TLS by certificates on both sides; anyone who reaches a port."""
    keys: str = "~/.config/xrl/{robot}/keys"
    """Folder of this host's certificates and keys, for `mtls`: `xrl keys pack` fills it."""
    allow: tuple[str, ...] = ()
    """Under `mtls`: who may begin a link beside the hosts of the endpoints, such as laptops."""


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
    """Time after which the next file begins; 0: never."""
    split_mib: Annotated[int, Range(0, 1 << 20, "MiB")] = 1024
    """Size at which the next file begins; 0: never."""
    free_min_mib: Annotated[int, Range(0, 1 << 20, "MiB")] = 256
    """Recording stops while less of the disk is free; 0: only when it is full."""


class OperatorConfig(Section, frozen=True):
    """The simulated operator's hand: a clipped spring-damper (docs/simulator.md)."""

    k_z: Annotated[float, Range(0.0, 1e5, "N/m")]
    b_z: Annotated[float, Range(0.0, 1e4, "N s/m")]
    force_max: Annotated[float, Range(0.0, 1e4, "N")]
    k_pitch: Annotated[float, Range(0.0, 1e5, "N m/rad")]
    b_pitch: Annotated[float, Range(0.0, 1e4, "N m s/rad")]
    moment_max: Annotated[float, Range(0.0, 1e4, "N m")]
    k_y: Annotated[float, Range(0.0, 1e5, "N/m")] = 1500.0
    """Sideways, where a scenario holds the harness point (`side`)."""
    b_y: Annotated[float, Range(0.0, 1e4, "N s/m")] = 150.0
    soft_n: Annotated[float, Range(0.0, 1e4, "N")] = 0.0
    """N; a harness that softens as it is stretched gives no more along z. 0: it is linear."""


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
    """Firmware whose CANSimple the emulated drives speak; the services find out by themselves."""
