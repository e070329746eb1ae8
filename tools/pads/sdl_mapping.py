"""Mappings in SDL's text form, for pads that are not in the table.

    GUID,NAME,lefty:a1,righty:a3~,lefttrigger:b6,a:b0,...,platform:Linux,

a0 is the first axis and b0 the first button, as SDL counts them on Linux; ~ is an axis that falls
where others rise. They stand in the environment, as SDL itself looks for them, or in the user's own
file, which `xrl lead --calibrate` writes.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from shared.exceptions import FleetError, XrlError
from shared.user import in_home
from tools.pads.controls import (
    BUTTONS,
    EV_ABS,
    EV_KEY,
    STICKS,
    TRIGGERS,
    PadControl,
    PadDevice,
    PadMapping,
    counted,
)

TEXT_VARIABLE: Final = "SDL_GAMECONTROLLERCONFIG"
FILE_VARIABLE: Final = "SDL_GAMECONTROLLERCONFIG_FILE"
OWN_FILE: Final = "~/.config/xrl/gamepads.txt"

_CONTROL: Final = re.compile(r"(a|b)(\d{1,3})(~?)")
_GUID: Final = re.compile(r"[0-9a-f]{32}")
_CRC: Final = slice(4, 8)
"""Digits of the GUID that newer versions of SDL fill with a sum of the name."""
_COMPARED: Final = 28
"""Digits of the GUID that are the device's; the last four are SDL's own driver."""


class GivenLine(NamedTuple):
    """A mapping that somebody gives."""

    where: str
    text: str


def own_file() -> Path | None:
    """Return the user's file of mappings, there or not; None for a user without a home."""
    try:
        return in_home(OWN_FILE)
    except XrlError:
        return None


def given_lines(environment: Mapping[str, str] = os.environ) -> Iterator[GivenLine]:
    """Yield the lines of the environment, of the file that it names, and of the user's file."""
    yield from _lines(TEXT_VARIABLE, environment.get(TEXT_VARIABLE, ""))
    named = environment.get(FILE_VARIABLE, "")
    if named:
        yield from _lines(named, _content(Path(named), FILE_VARIABLE))
    own = own_file()
    if own is not None and own.exists():
        yield from _lines(str(own), _content(own, "`xrl lead --calibrate` writes it"))


def _content(file: Path, why: str) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        text = error.strerror if isinstance(error, OSError) else "not UTF-8"
        raise FleetError(f"{file}: cannot be read: {text} ({why})") from None


def _lines(where: str, text: str) -> Iterator[GivenLine]:
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield GivenLine(f"{where}: line {number}", line.strip())


def guid_of(device: PadDevice) -> str:
    """Return the GUID that SDL gives a device, without a sum of its name."""
    info = device.info
    if info.vendor or info.product:
        words = (info.bustype, 0, info.vendor, 0, info.product, 0, info.version, 0)
        return struct.pack("<8H", *words).hex()
    return struct.pack("<2H12s", info.bustype, 0, device.name.encode()[:11]).hex()


def mapping_from(line: GivenLine, device: PadDevice) -> PadMapping | None:
    """Return what a line says about a device; None if it is about another one."""
    if not line_is_of(line.text, device):
        return None
    _, _, rest = line.text.partition(",")
    fields = dict(field.split(":", 1) for field in rest.split(",") if ":" in field)
    if fields.get("platform", "Linux") != "Linux":
        return None
    found: dict[str, PadControl] = {}
    for name in (*STICKS, *TRIGGERS, *BUTTONS):
        control = _control(fields.get(name, ""), device)
        if control is not None and (control.kind == EV_KEY or name not in BUTTONS):
            found[name] = control
    wrong = [name for name in STICKS if name not in found or found[name].kind != EV_ABS]
    wrong += [name for name in TRIGGERS if name not in found]
    if wrong:
        name = wrong[0]
        raise FleetError(
            f"{line.where}: {name}: {fields.get(name, 'missing')}: "
            f"{'a whole axis' if name in STICKS else 'a whole axis or a button'} that "
            f"{device.name} has is right, such as {name}:a1"
        )
    return found


def line_is_of(text: str, device: PadDevice) -> bool:
    """Return True if a line's GUID is a device's."""
    guid = text.partition(",")[0].strip().lower()
    return bool(_GUID.fullmatch(guid)) and _comparable(guid) == _comparable(guid_of(device))


def _comparable(guid: str) -> str:
    return guid[: _CRC.start] + guid[_CRC.stop : _COMPARED]


def _control(text: str, device: PadDevice) -> PadControl | None:
    """Return a control by SDL's count; None if there is none, or if it is half an axis or a hat."""
    parts = _CONTROL.fullmatch(text)
    if parts is None:
        return None
    kind = EV_ABS if parts[1] == "a" else EV_KEY
    codes, number = counted(device, kind), int(parts[2])
    return PadControl(kind, codes[number], bool(parts[3])) if number < len(codes) else None


def line_for(device: PadDevice, mapping: PadMapping) -> str:
    """Return a mapping in SDL's form."""
    words = [guid_of(device), device.name.replace(",", " ")]
    for name, control in mapping.items():
        letter = "a" if control.kind == EV_ABS else "b"
        number = counted(device, control.kind).index(control.code)
        words.append(f"{name}:{letter}{number}{'~' if control.inverted else ''}")
    return ",".join([*words, "platform:Linux", ""])
