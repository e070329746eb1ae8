"""ROS 2's types by another implementation: ros2_pyterfaces on Cyclone DDS's own CDR.

It reads annotations as objects: this file does not postpone them.
"""

from dataclasses import dataclass, field
from typing import Any, Final

from ros2_pyterfaces.cyclone import all_msgs
from ros2_pyterfaces.cyclone.geometry_msgs.msg import TransformStamped
from ros2_pyterfaces.cyclone.idl import IdlStruct, types


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs/msg/TFMessage"):
    """The package tf2_msgs is not in it."""

    transforms: types.sequence[TransformStamped] = field(default_factory=list)


TYPES: Final[dict[str, Any]] = {
    kind.get_type_name(): kind
    for kind in (*vars(all_msgs).values(), TFMessage)
    if isinstance(kind, type) and issubclass(kind, IdlStruct) and kind is not IdlStruct
}


def read(type_name: str, payload: bytes) -> Any:
    """Decode a message, and make sure that the other implementation would send the same bytes."""
    message = TYPES[type_name].deserialize(payload)
    assert message.serialize() == payload
    return message
