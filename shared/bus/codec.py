"""Encodes and decodes messages; refuses numbers that are not finite (docs/networks.md)."""

from __future__ import annotations

from typing import Generic, TypeVar

import msgspec

from shared.bus.messages import Message
from shared.exceptions import NonFiniteError

M = TypeVar("M", bound=Message)

_ENCODER = msgspec.json.Encoder()


def encode(message: Message) -> bytes:
    """Return the JSON of a message.

    Raises NonFiniteError for a number that is NaN or infinite: msgspec writes it as null, which no
    message's type allows, since it has no optional field.
    """
    payload = _ENCODER.encode(message)
    if b"null" in payload:  # or the word in a text: its own type tells
        try:
            msgspec.json.decode(payload, type=type(message))
        except msgspec.ValidationError:
            raise NonFiniteError(
                f"{type(message).__name__} {message.seq}: a number is not finite; not sent"
            ) from None
    return payload


class Decoder(Generic[M]):
    """Decodes one type of message; what does not fit is counted, not raised."""

    def __init__(self, message_type: type[M]) -> None:
        self._decoder = msgspec.json.Decoder(message_type)
        self.refused = 0

    def decode(self, payload: bytes) -> M | None:
        """Return the message, or None if the payload is malformed, which is counted.

        null, NaN and infinities fail the type check: null is no float, JSON has no literal for the
        others.
        """
        try:
            return self._decoder.decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError):
            self.refused += 1
            return None
