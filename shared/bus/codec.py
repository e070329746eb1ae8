"""Encode and decode messages; refuse numbers that are not finite (docs/networks.md)."""

from __future__ import annotations

from typing import Generic, TypeVar

import msgspec

from shared.bus.messages import Message
from shared.exceptions import EncodeError, NonFiniteError

M = TypeVar("M", bound=Message)


def _plain(value: object) -> object:
    """Return the Python number of a NumPy scalar, which msgspec does not encode on its own."""
    return value.item()  # type: ignore[attr-defined]  # raises what `encode` reports


_ENCODER = msgspec.json.Encoder(enc_hook=_plain)
_UNENCODABLE = (AttributeError, TypeError, ValueError, OverflowError, RecursionError)


def encode(message: Message) -> bytes:
    """Return the JSON of a message.

    Raises:
        NonFiniteError: a number is NaN or infinite. msgspec writes it as null, which no message
            type allows.
        EncodeError: a value has no JSON form, or an integer has more than 64 bits.
    """
    try:
        payload = _ENCODER.encode(message)
    except _UNENCODABLE as error:
        raise EncodeError(f"{_where(message)}; not sent") from error
    if b"null" in payload:  # may also be the word in a text: the type decides
        try:
            msgspec.json.decode(payload, type=type(message))
        except msgspec.ValidationError:
            raise NonFiniteError(
                f"{type(message).__name__} {message.seq}: a number is not finite; not sent"
            ) from None
    return payload


def _where(message: Message) -> str:
    """Return the field of a message that cannot be encoded, with its type."""
    for name in message.__struct_fields__:
        value = getattr(message, name)
        try:
            _ENCODER.encode(value)
        except _UNENCODABLE as error:
            return f"{type(message).__name__}.{name}: {type(value).__name__}: {error}"
    return type(message).__name__


class Decoder(Generic[M]):
    """Decoder of one type of message; it counts malformed payloads instead of raising."""

    def __init__(self, message_type: type[M]) -> None:
        self._decoder = msgspec.json.Decoder(message_type)
        self.refused = 0

    def decode(self, payload: bytes) -> M | None:
        """Return the message, or count the payload and return None if it is malformed.

        null, NaN and infinities are malformed: null is not a float, and JSON has no literal for the
        others.
        """
        try:
            return self._decoder.decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError):
            self.refused += 1
            return None
