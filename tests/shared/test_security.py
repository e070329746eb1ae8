"""Who gets onto the bus under mtls, what each may put and receive there, and why a link fails."""

from __future__ import annotations

import datetime as dt
import fnmatch
import os
import shutil
import socket
import stat
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest
import zenoh

from shared.bus import credentials, topics
from shared.bus.credentials import Credentials, read_credentials
from shared.bus.messages import Estop
from shared.bus.security import access_control, services_here, token_key
from shared.bus.session import open_session
from shared.bus.tls_probe import own_fault, refusal
from shared.bus.topics import PRINCIPALS, all_keys
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import BusError, ConfigError
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from shared.run_directory import live_dir
from tests.certified import (
    certified,
    give,
    identity,
    install_all,
    opened,
    signer_of,
    stranger,
    with_keys,
)
from tests.shared.test_links import TALK
from tests.waiting import comes_true
from tools.keys import certificates
from tools.keys.authority import Authority

ROBOT = config_file.load(DEFAULT_CONFIG)
TRIES_S = 8.0
LOOPBACK = ("127.0.0.1",)
LEG = ("ankle_left", "knee_left", "hip_left")

READ_ALL = ("recorder", "operator", "viewer")


def own_topics(name: str, column: int) -> list[str]:
    """Return what `TALK` has somebody put (0) or take (1); a module, of its own keys."""
    found = [topic.name for topic, columns in TALK.items() if name in columns[column]]
    return [text.replace("*", name) for text in found] if name in MODULES else found


PUTS = {name: own_topics(name, 0) for name in PRINCIPALS}
READS = {name: ["*"] if name in READ_ALL else own_topics(name, 1) for name in PRINCIPALS}


class Bus:
    """A certified robot in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        fitted = msgspec.structs.replace(ROBOT, imu=msgspec.structs.replace(ROBOT.imu, fitted=True))
        self.folder = folder
        self.robot, self.authority = certified(fitted, folder, allow=LOOPBACK)
        self.keys = folder / "keys"

    def endpoint(self, service: str) -> str:
        return self.robot.bus.endpoints[service]


@pytest.fixture(scope="module")
def bus() -> Iterator[Bus]:
    folder = Path(tempfile.mkdtemp(prefix="xrl-t-", dir="/tmp"))
    yield Bus(folder)
    shutil.rmtree(folder)


def settles(step: Callable[[], Collection[object]], expected: Collection[object]) -> bool:
    """Return True if what is heard becomes all that is expected, and stays so."""
    assert comes_true(lambda: set(expected) <= set(step()), TRIES_S)
    time.sleep(0.2)  # what is not to come would have come by now
    step()
    time.sleep(0.1)
    return set(step()) == set(expected)


def fits(key: str, patterns: list[str]) -> bool:
    topic = key.removeprefix(f"xrl/{ROBOT.name}/")
    return any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns)


def linked(session: zenoh.Session) -> bool:
    return len(list(session.info.peers_zid())) > 0


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", PRINCIPALS)
def test_a_peer_is_heard_on_its_own_keys_and_on_no_other(bus: Bus, name: str) -> None:
    keys = [*all_keys(ROBOT.name), f"xrl/{ROBOT.name}/something/else", f"xrl/other/{name}"]
    with (
        open_session(bus.robot, "recorder", bus.folder) as recorder,
        stranger([bus.endpoint("recorder")], identity(bus.keys, name)) as peer,
    ):
        ear = recorder.stream([f"xrl/{ROBOT.name}/**"])
        assert comes_true(lambda: linked(peer))
        heard: set[str] = set()

        def put_all() -> set[str]:
            for key in keys:
                peer.put(key, b"{}", attachment=key.encode())
            heard.update(key for key, _, _ in iter(ear.take, None))
            return heard

        assert settles(put_all, {key for key in keys if fits(key, PUTS[name])})


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", PRINCIPALS)
def test_a_peer_receives_what_its_row_of_the_table_says(bus: Bus, name: str) -> None:
    sender = "planner" if name != "planner" else "knee_left"
    keys = [key for key in all_keys(ROBOT.name) if fits(key, PUTS[sender])]
    with (
        open_session(bus.robot, sender, bus.folder) as session,
        stranger([bus.endpoint(sender)], identity(bus.keys, name)) as peer,
    ):
        heard: set[str] = set()
        ears = [
            peer.declare_subscriber(key, lambda sample: heard.add(str(sample.key_expr)))
            for key in (*keys, "**")
        ]
        assert comes_true(lambda: linked(peer))
        publishers = [session.raw_publisher(key, patient=False) for key in keys]

        def put_all() -> set[str]:
            for publisher in publishers:
                publisher.put(b"{}")
            return heard

        assert settles(put_all, {key for key in keys if fits(key, READS[name])})
        assert len(ears) == len(keys) + 1


def test_services_show_themselves_by_their_own_name_only(bus: Bus) -> None:
    with (
        open_session(bus.robot, "recorder", bus.folder) as recorder,
        stranger([bus.endpoint("recorder")], identity(bus.keys, "viewer")) as peer,
    ):
        tokens = [
            peer.liveliness().declare_token(token_key(ROBOT.name, name))
            for name in ("planner", "a-tool")
        ]
        tools = recorder.linked_tools()
        assert comes_true(lambda: linked(peer))
        time.sleep(0.5)
        assert recorder.alive() == {"recorder"}
        assert tools.names() == ("a-tool",)
        assert len(tokens) == 2


def _foreign(bus: Bus, folder: Path) -> dict[str, Any]:
    """Return the identity of somebody with an authority of his own, who knows ours by sight."""
    _, other = certified(bus.robot, folder, bus.robot.bus.endpoints)
    install_all(other, folder)
    return identity(folder, "planner", bus.keys / credentials.AUTHORITY)


def _issued(bus: Bus, folder: Path, from_day: int) -> dict[str, Any]:
    give(signer_of(bus.authority), folder, "planner", from_day=from_day, days=10)
    return identity(folder, "planner", bus.keys / credentials.AUTHORITY)


def _none(bus: Bus, _folder: Path) -> dict[str, Any]:
    authority = str(bus.keys / credentials.AUTHORITY)
    return {"root_ca_certificate": authority, "verify_name_on_connect": False}


ENEMIES: dict[str, Callable[[Bus, Path], dict[str, Any]]] = {
    "none": _none,
    "foreign": _foreign,
    "expired": lambda bus, folder: _issued(bus, folder, -30),
    "not yet valid": lambda bus, folder: _issued(bus, folder, 30),
}


@pytest.mark.parametrize("kind", ENEMIES)
def test_without_a_valid_certificate_there_is_no_link(bus: Bus, tmp_path: Path, kind: str) -> None:
    with (
        open_session(bus.robot, "recorder", bus.folder),
        stranger([bus.endpoint("recorder")], identity(bus.keys, "planner")) as friend,
        stranger([bus.endpoint("recorder")], ENEMIES[kind](bus, tmp_path / "s")) as enemy,
    ):
        assert comes_true(lambda: linked(friend)), "the same try with a valid one"
        time.sleep(0.5)
        assert not linked(enemy)


def test_a_revoked_certificate_links_and_is_not_heard(bus: Bus, tmp_path: Path) -> None:
    robot, authority = certified(bus.robot, tmp_path, bus.robot.bus.endpoints, LOOPBACK)
    old = tmp_path / "old"
    shutil.copytree(tmp_path / "keys", old)
    authority.revoke(robot, ["planner"], days=10)
    install_all(authority, tmp_path / "keys")
    assert authority.names.generations["planner"] == 2
    with (
        open_session(robot, "recorder", tmp_path) as recorder,
        stranger([robot.bus.endpoints["recorder"]], identity(old, "planner")) as lost,
        stranger([robot.bus.endpoints["recorder"]], identity(tmp_path / "keys", "planner")) as now,
    ):
        ear = recorder.stream([f"xrl/{ROBOT.name}/**"])
        assert comes_true(lambda: linked(lost) and linked(now))
        heard: set[bytes] = set()
        key = f"xrl/{ROBOT.name}/planner/status"

        def put_both() -> set[bytes]:
            for session, word in ((lost, b"lost"), (now, b"now")):
                session.put(key, word, attachment=key.encode())
            heard.update(payload for _, payload, _ in iter(ear.take, None))
            return heard

        assert settles(put_both, {b"now"})


def test_a_service_is_dialled_only_where_its_certificate_says(bus: Bus, tmp_path: Path) -> None:
    """A peer with another host's certificate, at the planner's place, is not believed."""
    robot, authority = certified(bus.robot, tmp_path, bus.robot.bus.endpoints, LOOPBACK)
    other = tmp_path / "other"
    shutil.copytree(tmp_path / "keys", other)
    give(signer_of(authority), other, "knee_left", host="10.9.9.9")
    install_all(authority, tmp_path / "body", "planner")
    with (
        open_session(with_keys(robot, other), "knee_left", tmp_path),
        open_session(robot, "knee_right", tmp_path),
        open_session(with_keys(robot, tmp_path / "body"), "planner", tmp_path) as planner,
    ):
        assert comes_true(lambda: "knee_right" in planner.alive())
        time.sleep(0.5)
        assert "knee_left" not in planner.alive()


def alone(robot: RobotConfig, folder: Path) -> tuple[RobotConfig, Authority]:
    """Return the robot with all of its services on this host, and no laptop allowed."""
    return certified(robot, folder, robot.bus.endpoints)


def listens(endpoint: str) -> bool:
    host, port = endpoint.removeprefix("tls/").split(":")
    with socket.socket() as probe:
        return probe.connect_ex((host, int(port))) == 0


def test_services_of_one_host_are_linked_without_a_port(bus: Bus, tmp_path: Path) -> None:
    robot, _ = alone(bus.robot, tmp_path)
    with (
        open_session(robot, "knee_left", bus.folder),
        open_session(robot, "planner", bus.folder) as planner,
        open_session(robot, "status", bus.folder) as tool,
    ):
        for session in (planner, tool):
            assert comes_true(lambda s=session: s.alive() == {"planner", "knee_left"})  # type: ignore[misc]
        assert not any(listens(robot.bus.endpoints[name]) for name in ("planner", "knee_left"))


def test_a_service_listens_at_its_port_where_another_host_may_link_to_it(
    bus: Bus, tmp_path: Path
) -> None:
    robot, authority = alone(bus.robot, tmp_path)
    install_all(authority, tmp_path / "leg", *LEG)
    leg = with_keys(robot, tmp_path / "leg")
    assert services_here(leg) == set(LEG)
    elsewhere = robot.bus.endpoints | {"planner": "tls/192.0.2.1:7447"}
    far = msgspec.structs.replace(robot.bus, endpoints=elsewhere)
    assert services_here(msgspec.structs.replace(robot, bus=far)) == {*robot.services} - {"planner"}
    with open_session(leg, "knee_left", bus.folder):
        assert listens(robot.bus.endpoints["knee_left"])


@pytest.mark.parametrize("services", [(), LEG], ids=["by port", "by socket"])
@pytest.mark.parametrize(("key", "heard"), [("viewer", False), ("operator", True)])
def test_a_viewer_cannot_stop_the_robot_and_an_operator_can(
    bus: Bus, tmp_path: Path, key: str, heard: bool, services: tuple[str, ...]
) -> None:
    """By its certificate; by socket, on a host of the robot, by the keys that this host has."""
    install_all(bus.authority, tmp_path / "keys", *services, key)
    host = with_keys(bus.robot, tmp_path / "keys")
    with (
        open_session(host if services else bus.robot, "knee_left", bus.folder) as knee,
        open_session(host, "estop", bus.folder) as tool,
    ):
        stops = knee.latest(topics.ESTOP, Estop)
        call = tool.publisher(topics.ESTOP, Estop)

        def stopped() -> bool:
            call.put(Estop(t_ns=1, seq=1, source="tool"))
            return stops.take() is not None

        assert comes_true(lambda: "knee_left" in tool.alive())
        assert comes_true(stopped, TRIES_S if heard else 0.5) is heard


def _remove(name: str) -> Callable[[Path], None]:
    return lambda keys: (keys / name).unlink()


def _rename(keys: Path) -> None:
    text = (keys / "names.toml").read_text().replace(f'"{ROBOT.name}"', '"somebody"')
    (keys / "names.toml").write_text(text)


def _unknown(keys: Path) -> None:
    with (keys / "names.toml").open("a") as file:
        file.write("cook = 1\n")


SPOILT: dict[str, tuple[Callable[[Path], object], str]] = {
    "no folder": (shutil.rmtree, "no keys for `mtls` here"),
    "no names": (_remove("names.toml"), "names.toml is missing"),
    "another robot's": (_rename, "keys of robot 'somebody'"),
    "an unknown name": (_unknown, "generations.cook: not a valid name"),
    "no names in it": (lambda keys: (keys / "names.toml").write_text("x ="), "names.toml"),
    "no certificate": (_remove("planner.pem"), "planner.pem: missing"),
    "no key": (_remove("planner.key"), "planner.key: missing"),
    "no authority": (_remove("authority.pem"), "authority.pem: missing"),
    "a key that others can read": (lambda keys: (keys / "planner.key").chmod(0o640), "chmod 600"),
    "a key that is none": (lambda keys: (keys / "planner.key").write_bytes(b"x"), "planner"),
}


@pytest.mark.parametrize("fault", SPOILT)
def test_a_service_whose_keys_are_not_right_does_not_start_and_says_why(
    bus: Bus, tmp_path: Path, fault: str
) -> None:
    keys = tmp_path / "keys"
    install_all(bus.authority, keys)
    spoil, words = SPOILT[fault]
    spoil(keys)
    with (
        pytest.raises(BusError, match=words),
        open_session(with_keys(bus.robot, keys), "planner", tmp_path),
    ):
        pass


def _file_with(tmp_path: Path, robot: RobotConfig) -> Path:
    path = tmp_path / "robot.toml"
    path.write_text(config_file.to_toml(robot), encoding="utf-8")
    return path


PORT = {**ROBOT.bus.endpoints, "planner": "tcp/127.0.0.1:7447"}


def secured(endpoint: str | None = None, **changes: object) -> RobotConfig:
    """Return the robot with keys of `[bus.security]` changed, and the planner's endpoint."""
    security = msgspec.structs.replace(ROBOT.bus.security, **changes)
    endpoints = ROBOT.bus.endpoints | ({} if endpoint is None else {"planner": endpoint})
    bus = msgspec.structs.replace(ROBOT.bus, endpoints=endpoints, security=security)
    return msgspec.structs.replace(ROBOT, bus=bus)


NO_ADDRESS = "an IP address without a port"


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        (secured("tcp/127.0.0.1:7447"), 'mode = "open": anyone'),
        (secured("tls/10.0.0.1:7447"), 'mode = "mtls"'),
        (secured("tcp/10.0.0.1:7447", mode="mtls"), "tls/"),
        (secured("unixsock-stream/{run}/planner.zenoh", mode="mtls"), 'mode = "local"'),
        (secured("tls/10.0.0.1:7447", mode="open"), 'mode = "mtls"'),
        (secured(keys="keys"), "must start with / or ~"),
        *((secured(allow=(text,)), NO_ADDRESS)
          for text in ("laptop.local", "10.0.0.1:22", "", "10.0.0.0/8")),
    ],
)  # fmt: skip
def test_an_endpoint_path_or_address_that_the_mode_does_not_take_is_refused(
    tmp_path: Path, robot: RobotConfig, words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        config_file.load(_file_with(tmp_path, robot))


def test_a_port_opened_in_so_many_words_is_taken_and_a_log_of_one_is_read(tmp_path: Path) -> None:
    assert config_file.load(_file_with(tmp_path, opened(ROBOT, PORT))).bus.security.mode == "open"
    silent = secured(PORT["planner"])
    assert config_file.parse(config_file.to_toml(silent), "log").bus.endpoints == PORT


def test_a_service_starts_though_another_hosts_name_is_not_known(bus: Bus, tmp_path: Path) -> None:
    endpoints = bus.robot.bus.endpoints | {"imu": "tls/no-such-host.invalid:7447"}
    other = msgspec.structs.replace(bus.robot.bus, endpoints=endpoints)
    with open_session(msgspec.structs.replace(bus.robot, bus=other), "planner", tmp_path):
        pass


@pytest.mark.parametrize("umask", [0o000, 0o022])
def test_a_local_socket_is_its_users_alone_whatever_the_umask(short_dir: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        with open_session(ROBOT, "planner", short_dir):
            mode = stat.S_IMODE((live_dir(short_dir) / "planner.zenoh").stat().st_mode)
            assert mode & 0o077 == 0
            (short_dir / "after").touch()
            assert stat.S_IMODE((short_dir / "after").stat().st_mode) == 0o666 & ~umask
    finally:
        os.umask(before)


@pytest.mark.parametrize("own", PRINCIPALS)
def test_whatever_no_rule_allows_is_denied_and_no_rule_names_an_unknown_peer(own: str) -> None:
    control = access_control("lab", own, {"planner": 3, "operator": 1})
    assert control["enabled"]
    assert control["default_permission"] == "deny"
    assert all(rule["permission"] == "allow" for rule in control["rules"])
    named = [name for subject in control["subjects"] for name in subject["cert_common_names"]]
    assert named == ["planner.3", "operator.1"]
    assert all(subject["cert_common_names"] for subject in control["subjects"])


def test_every_topic_has_a_writer_and_a_host_without_the_operators_key_only_looks(
    bus: Bus, tmp_path: Path
) -> None:
    for topic in topics.TOPICS:
        names = {*topic.writers, *topic.readers} - {"*", "network_proxy"}
        assert topic.writers, topic.name
        assert names <= set(PRINCIPALS), topic.name
    assert credentials.read_credentials(bus.robot, "status").name == "operator"
    install_all(bus.authority, tmp_path / "keys", "viewer")
    looks = with_keys(bus.robot, tmp_path / "keys")
    assert credentials.read_credentials(looks, "estop").name == "viewer"


@pytest.mark.parametrize("own", PRINCIPALS)
def test_nothing_is_sent_to_a_peer_but_what_it_may_receive(own: str) -> None:
    """Not even before it has told its subscriptions: until then Zenoh sends a peer everything."""
    control = access_control(ROBOT.name, own, dict.fromkeys(PRINCIPALS, 1))
    rules = {rule["id"]: rule for rule in control["rules"]}
    for policy in control["policies"]:
        (peer,) = policy["subjects"]
        sent = {
            key
            for rule in map(rules.__getitem__, policy["rules"])
            if "egress" in rule["flows"] and "put" in rule["messages"]
            for key in rule["key_exprs"]
        }
        keys = all_keys(ROBOT.name)
        assert sent == {key for key in keys if fits(key, PUTS[own]) and fits(key, READS[peer])}


class Pair(NamedTuple):
    """The keys of two hosts: one has the planner, the other the left knee."""

    robot: RobotConfig
    authority: Authority
    folder: Path

    @property
    def knee(self) -> str:
        return self.robot.bus.endpoints["knee_left"]

    def host(self, name: str) -> RobotConfig:
        return with_keys(self.robot, self.folder / name)

    def own(self, name: str) -> Credentials:
        return read_credentials(self.host(name), name)

    def replace(self, name: str, *, foreign: bool = False, **when: int | str) -> None:
        """Give a host another certificate."""
        stranger = certificates.make_authority("xrl", dt.datetime.now(dt.UTC))
        signer = stranger if foreign else signer_of(self.authority)
        give(signer, self.folder / name, name, **when)  # type: ignore[arg-type]


@pytest.fixture
def pair(robot: RobotConfig, short_dir: Path) -> Pair:
    own, authority = certified(robot, short_dir)
    for name in ("planner", "knee_left"):
        install_all(authority, short_dir / name, name)
    return Pair(own, authority, short_dir)


OUR_TIME = "by its clock, our certificate has expired or is not valid yet"
FAULTS: dict[str, tuple[Callable[[Pair], None], str]] = {
    "none": (lambda _: None, ""),
    "its clock, or ours": (
        lambda p: p.replace("knee_left", from_day=10),
        "its certificate is not valid yet (this host's clock: 20",
    ),
    "its certificate is old": (
        lambda p: p.replace("knee_left", from_day=-40, days=20),
        "its certificate has expired (this host's clock",
    ),
    "its authority": (
        lambda p: p.replace("knee_left", foreign=True),
        "its certificate was signed by another authority",
    ),
    "its host": (lambda p: p.replace("knee_left", host="10.1.1.1"), "belongs to another host"),
    "our certificate is old": (lambda p: p.replace("planner", from_day=-40, days=20), OUR_TIME),
    "our clock, or its": (lambda p: p.replace("planner", from_day=10), OUR_TIME),
    "our authority": (lambda p: p.replace("planner", foreign=True), "our certificate"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_why_a_link_does_not_come_is_told_truly(pair: Pair, fault: str) -> None:
    spoil, words = FAULTS[fault]
    spoil(pair)
    with open_session(pair.host("knee_left"), "knee_left", pair.folder):
        why = refusal(pair.own("planner"), pair.knee)
    assert words in why
    assert bool(words) is bool(why)
    assert refusal(pair.own("planner"), pair.knee) == "Connection refused"


@pytest.mark.parametrize(
    ("when", "words"),
    [
        ({}, ""),
        ({"from_day": 10}, "is not valid yet (this host's clock"),
        ({"from_day": -40, "days": 20}, "has expired"),
        ({"foreign": True}, "was signed by another authority"),
    ],
)
def test_a_certificate_that_this_host_does_not_believe_is_told(
    pair: Pair, when: dict[str, int], words: str, caplog: pytest.LogCaptureFixture
) -> None:
    pair.replace("planner", **when)  # type: ignore[arg-type]
    found = own_fault(pair.own("planner"))
    assert found.startswith(words)
    assert bool(words) is bool(found)
    with open_session(pair.host("planner"), "planner", pair.folder):
        assert ("no link over TLS" in caplog.text) is bool(words)
