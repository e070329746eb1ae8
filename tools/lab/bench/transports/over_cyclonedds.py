"""Cyclone DDS: best effort, keep last 1, over UDP on the loopback interface."""

import os
import zlib
from dataclasses import dataclass
from pathlib import Path

from tools.lab.bench.transports.base import Put, Take

os.environ["CYCLONEDDS_URI"] = (
    "<CycloneDDS><Domain><General><Interfaces>"
    '<NetworkInterface name="lo" multicast="false"/></Interfaces></General>'
    "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>'
)

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import sequence, uint8
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

_DOMAINS = 200
_QOS = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1))


@dataclass
class DdsPayload(IdlStruct, typename="xrl.Payload"):  # type: ignore[misc, call-arg]  # no types
    """Bytes, as DDS knows them."""

    data: sequence[uint8]


class OverCycloneDds:
    """A participant in a domain of the folder's own."""

    def __init__(self, folder: Path) -> None:
        """Join the domain."""
        self._participant = DomainParticipant(zlib.crc32(str(folder).encode()) % _DOMAINS)
        self._ends: list[object] = []

    def publisher(self, key: str) -> Put:
        """See `Transport.publisher`."""
        end = DataWriter(self._participant, self._topic(key), qos=_QOS)
        return lambda payload: end.write(DdsPayload(data=payload))

    def latest(self, key: str) -> Take:
        """See `Transport.latest`."""
        end = DataReader(self._participant, self._topic(key), qos=_QOS)

        def take() -> bytes | None:
            found = [sample for sample in end.take() if sample.sample_info.valid_data]
            return bytes(found[-1].data) if found else None

        return take

    def close(self) -> None:
        """Leave: the participant ends with the process."""

    def _topic(self, key: str) -> Topic:
        topic = Topic(self._participant, key.replace("/", "_"), DdsPayload, qos=_QOS)
        self._ends.append(topic)
        return topic


def open_transport(_process: str, folder: Path) -> OverCycloneDds:
    """Join the domain of a folder."""
    return OverCycloneDds(folder)
