"""Message types of ROS 2: made, encoded in CDR and hashed by rosbags. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from shared.extras import late

if TYPE_CHECKING:
    from rosbags import typesys
else:
    typesys = late("rosbags.typesys")


class RosTypes:
    """The types of one of `shared.config.checks.ROS2_DISTRIBUTIONS`."""

    def __init__(self, distribution: str) -> None:
        self._store = typesys.get_typestore(typesys.Stores[f"ROS2_{distribution.upper()}"])

    def hash(self, type_name: str) -> str:
        """Return the hash of a type's description, such as `RIHS01_a13e...`."""
        return self._store.hash_rihs01(type_name)

    def make(self, type_name: str, /, **fields: Any) -> Any:
        """Return a message; `fields` are all of its fields."""
        return self._store.types[type_name](**fields)

    def encode(self, type_name: str, message: Any) -> bytes:
        """Return a message in CDR, little endian, with its header of four bytes."""
        return bytes(self._store.serialize_cdr(message, type_name))

    def decode(self, type_name: str, payload: bytes) -> Any | None:
        """Return the message of a payload from the network; None if it is none of this type."""
        try:
            return self._store.deserialize_cdr(payload, type_name)
        except Exception:  # noqa: BLE001 - whatever a stranger's bytes bring about
            return None

    def definition(self, type_name: str) -> str:
        """Return a type and those it is made of in ROS 2's message language."""
        text, _ = self._store.generate_msgdef(type_name, ros_version=2)
        return text
