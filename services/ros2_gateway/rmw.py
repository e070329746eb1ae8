"""ROS 2 names as rmw_zenoh maps them: keys, liveliness tokens, attachments. Pure.

The contract is the design page of rmw_zenoh, as of the distribution Jazzy:

    key         <domain>/<topic>/<DDS type>/<type hash>
    node        @ros2_lv/<domain>/<session>/0/0/NN/%/<namespace>/<node>
    endpoint    @ros2_lv/<domain>/<session>/0/<number>/<kind>/%/<namespace>/<node>
                /<topic>/<DDS type>/<type hash>/<QoS>
    attachment  sequence number, time (int64, little endian), length of the GID, GID

In tokens, each / in a name is written as %.
"""

from __future__ import annotations

import argparse
import hashlib
import struct
from typing import Final, Literal, NamedTuple, TypeAlias

ADMIN_SPACE: Final = "@ros2_lv"
GID_SIZE: Final = 16
DOMAIN_MAX: Final = 232
"""Largest ROS_DOMAIN_ID."""
Kind: TypeAlias = Literal["MP", "MS"]
"""Message publisher or message subscription."""


class Qos(NamedTuple):
    """Quality of service that an endpoint announces."""

    reliable: bool = True
    transient_local: bool = False
    """True if a new subscription receives the newest messages."""
    depth: int = 10
    """Maximum number of stored messages."""

    def encode(self) -> str:
        """Return the text for a token, in which rmw's default values are empty."""
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"


class RosTopic(NamedTuple):
    """A topic of ROS 2."""

    name: str
    """Full name, such as `/joint_states`."""
    type: str
    """Such as `sensor_msgs/msg/JointState`."""
    qos: Qos = Qos()


class RosNode(NamedTuple):
    """A node of ROS 2."""

    domain: int
    """ROS_DOMAIN_ID."""
    session: str
    """Zenoh's id of its session."""
    namespace: str
    """`/`, or a namespace such as `/legs`."""
    name: str


def domain(text: str) -> int:
    """Parse a domain of a command line; raise ArgumentTypeError unless it is 0 to 232."""
    if not (text.strip().isdecimal() and int(text) <= DOMAIN_MAX):
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: must be a number from 0 to {DOMAIN_MAX}")
    return int(text)


def dds_type(name: str) -> str:
    """Return `sensor_msgs::msg::dds_::JointState_` for `sensor_msgs/msg/JointState`."""
    package, folder, kind = name.split("/")
    return f"{package}::{folder}::dds_::{kind}_"


def topic_key(domain: int, topic: RosTopic, type_hash: str) -> str:
    """Return the key on which a topic's messages are published."""
    return f"{domain}/{topic.name.strip('/')}/{dds_type(topic.type)}/{type_hash}"


def node_token(node: RosNode) -> str:
    """Return the key of a node's liveliness token."""
    place = f"{ADMIN_SPACE}/{node.domain}/{node.session}/0/0/NN"
    return f"{place}/%/{_mangled(node.namespace)}/{node.name}"


def endpoint_token(node: RosNode, number: int, kind: Kind, topic: RosTopic, type_hash: str) -> str:
    """Return the key of the liveliness token of a node's publisher or subscription.

    `number` identifies the endpoint within its session.
    """
    place = f"{ADMIN_SPACE}/{node.domain}/{node.session}/0/{number}/{kind}"
    names = f"%/{_mangled(node.namespace)}/{node.name}/{_mangled(topic.name)}"
    return f"{place}/{names}/{dds_type(topic.type)}/{type_hash}/{topic.qos.encode()}"


def gid_of(token: str) -> bytes:
    """Return the 16 bytes that identify an endpoint, from its token."""
    return hashlib.blake2b(token.encode(), digest_size=GID_SIZE).digest()


def attachment(number: int, unix_ns: int, gid: bytes) -> bytes:
    """Return a message's attachment: its number, time and sender."""
    return struct.pack(f"<qqB{GID_SIZE}s", number, unix_ns, GID_SIZE, gid)


class SeenEndpoint(NamedTuple):
    """A node or an endpoint, as read from its token."""

    kind: str
    """NN (node), MP or MS (publisher or subscription), SS or SC (service or client)."""
    node: str
    """Full name of the node."""
    topic: str = ""
    type: str = ""
    """DDS name of the topic's type."""
    type_hash: str = ""


def read_token(key: str) -> SeenEndpoint | None:
    """Parse a liveliness token; return None if it is not one."""
    parts = key.split("/")
    if len(parts) not in (9, 13) or parts[0] != ADMIN_SPACE:
        return None
    kind, namespace, name = parts[5], _unmangled(parts[7]), parts[8]
    node = f"{namespace.rstrip('/')}/{name}"
    if len(parts) == 9:
        return SeenEndpoint(kind, node)
    return SeenEndpoint(kind, node, _unmangled(parts[9]), parts[10], parts[11])


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _unmangled(name: str) -> str:
    return name.replace("%", "/")
