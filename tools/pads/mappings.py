"""What a pad's axes and buttons mean: as somebody gives it in SDL's text form, or by the table.

    GUID,NAME,lefty:a1,righty:a3~,lefttrigger:b6,a:b0,...,platform:Linux,

a0 is the first axis and b0 the first button, as SDL counts them on Linux; ~ is an axis that falls
where others rise. Such lines stand in the environment, as SDL itself looks for them, or in the
user's own file, which `xrl lead --calibrate` writes. Well-known pads go by vendor and product.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from shared.exceptions import FleetError, XrlError
from shared.places import in_home
from tools.pads.controls import (
    BUTTONS,
    EV_ABS,
    EV_KEY,
    STICKS,
    TRIGGERS,
    PadControl,
    PadDevice,
    PadMapping,
    codes_of,
    counted,
    identity_of,
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


def given_lines() -> Iterator[GivenLine]:
    """Yield the lines of the environment, of the file that it names, and of the user's file."""
    yield from _lines(TEXT_VARIABLE, os.environ.get(TEXT_VARIABLE, ""))
    named = os.environ.get(FILE_VARIABLE, "")
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


_Y, _Z, _RX, _RY, _RZ, _GAS, _BRAKE = 0x01, 0x02, 0x03, 0x04, 0x05, 0x09, 0x0A
_SOUTH, _EAST, _C, _NORTH, _WEST, _Z_BUTTON = 0x130, 0x131, 0x132, 0x133, 0x134, 0x135
_TL, _TR, _TL2, _TR2, _SELECT, _START = 0x136, 0x137, 0x138, 0x139, 0x13A, 0x13B
_KEY_BACK: Final = 0x9E


class Layout(NamedTuple):
    """One layout of a well-known pad.

    The kernel's gamepad protocol (Documentation/input/gamepad.rst) names the codes, and drivers
    deviate from it: one pad has another layout by Bluetooth than by cable, and another with another
    driver. So a product has all layouts that its drivers give it, and the one whose codes are there
    is taken.
    """

    mapping: PadMapping
    lacks: frozenset[int] = frozenset()
    """Buttons that only another layout of the product has."""

    def fits(self, device: PadDevice) -> bool:
        """Return True if a pad has every control of it, and nothing that tells against it."""
        has = {kind: codes_of(device, kind) for kind in (EV_ABS, EV_KEY)}
        present = all(control.code in has[control.kind] for control in self.mapping.values())
        return present and not self.lacks & has[EV_KEY]


def _axes(righty: int, lefttrigger: int, righttrigger: int) -> dict[str, PadControl]:
    codes = {
        "lefty": _Y, "righty": righty, "lefttrigger": lefttrigger, "righttrigger": righttrigger,
    }  # fmt: skip
    return {name: PadControl(EV_ABS, code) for name, code in codes.items()}


def _buttons(
    face: tuple[int, int, int, int] = (_SOUTH, _EAST, _NORTH, _WEST),
    others: tuple[int, int, int, int] = (_TL, _TR, _SELECT, _START),
) -> dict[str, PadControl]:
    codes = zip(BUTTONS, (*face, *others), strict=True)
    return {name: PadControl(EV_KEY, code) for name, code in codes}


_STANDARD: Final = _axes(_RY, lefttrigger=_Z, righttrigger=_RZ)
_PEDALS: Final = _axes(_RZ, lefttrigger=_BRAKE, righttrigger=_GAS)
_PLACES: Final = (_SOUTH, _EAST, _WEST, _NORTH)
"""Face buttons of drivers whose codes say where a button is; Xbox drivers go by its letter."""
_UNNAMED: Final = frozenset({_C, _Z_BUTTON})
"""Buttons of a driver that counts codes up without knowing the pad."""

XPAD: Final = Layout({**_STANDARD, **_buttons()}, lacks=_UNNAMED)
"""xpad, xone and xpadneo."""
PEDALS: Final = Layout({**_PEDALS, **_buttons()})
"""HID with a right stick of Z and RZ and triggers of gas and brake: Bluetooth, Android."""
PEDALS_BACK: Final = Layout({**_PEDALS, **_buttons(others=(_TL, _TR, _KEY_BACK, _START))})
PEDALS_NINTENDO: Final = Layout({**_PEDALS, **_buttons((_EAST, _SOUTH, _WEST, _NORTH))})
"""The same, with the letters where Nintendo has them."""
XBOX_COUNTED: Final = Layout(
    {**_STANDARD, **_buttons((_SOUTH, _EAST, _C, _NORTH), (_WEST, _Z_BUTTON, _TL, _TR))},
    lacks=frozenset({_SELECT, _START}),
)
"""The first Bluetooth firmware of the Xbox One pad, without a driver of its own."""
PLAYSTATION: Final = Layout({**_STANDARD, **_buttons(_PLACES)}, lacks=_UNNAMED)
"""hid-playstation and hid-sony."""
SONY_COUNTED: Final = Layout(
    {
        **_axes(_RZ, lefttrigger=_RX, righttrigger=_RY),
        **_buttons((_EAST, _C, _SOUTH, _NORTH), (_WEST, _Z_BUTTON, _TL2, _TR2)),
    }
)
"""The same pads without that driver."""
NINTENDO: Final = Layout(
    {
        "lefty": PadControl(EV_ABS, _Y), "righty": PadControl(EV_ABS, _RY),
        "lefttrigger": PadControl(EV_KEY, _TL2), "righttrigger": PadControl(EV_KEY, _TR2),
        **_buttons(_PLACES),
    },
    lacks=frozenset({_C}),
)  # fmt: skip
"""hid-nintendo; its triggers are buttons."""

_SONY: Final = (PLAYSTATION, SONY_COUNTED)
LAYOUTS: Final[dict[tuple[int, int], tuple[Layout, ...]]] = {
    (0x045E, 0x028E): (XPAD,),  # Xbox 360 by cable; xpadneo gives its pads this number too
    (0x045E, 0x02D1): (XPAD,),  # Xbox One by cable
    (0x045E, 0x02DD): (XPAD,),
    (0x045E, 0x02EA): (XPAD,),  # Xbox One S by cable
    (0x045E, 0x0B12): (XPAD,),  # Xbox Series by cable
    (0x045E, 0x02E0): (XBOX_COUNTED, XPAD),  # Xbox One S by Bluetooth
    (0x045E, 0x02FD): (PEDALS_BACK, XPAD),
    (0x045E, 0x0B20): (PEDALS, XPAD),
    (0x045E, 0x0B13): (PEDALS, XPAD),  # Xbox Series by Bluetooth
    (0x054C, 0x05C4): _SONY,  # DualShock 4
    (0x054C, 0x09CC): _SONY,
    (0x054C, 0x0CE6): _SONY,  # DualSense
    (0x054C, 0x0DF2): _SONY,  # DualSense Edge
    (0x057E, 0x2009): (NINTENDO,),  # Switch Pro
    (0x2DC8, 0x3106): (XPAD,),  # 8BitDo Ultimate, its receiver
    (0x2DC8, 0x310A): (XPAD,),  # 8BitDo Ultimate 2C
    (0x2DC8, 0x3012): (PEDALS,),  # 8BitDo Ultimate by Bluetooth
    (0x2DC8, 0x6006): (PEDALS_NINTENDO,),  # 8BitDo Pro 2
    (0x046D, 0xC21D): (XPAD,),  # Logitech F310, switch at X
    (0x046D, 0xC21F): (XPAD,),  # Logitech F710, switch at X
    (0x18D1, 0x9400): (PEDALS,),  # Stadia
}


def known_mapping(device: PadDevice) -> PadMapping | None:
    """Return what a well-known pad's controls mean; None if it is not one, or is unlike it."""
    for layout in LAYOUTS.get((device.info.vendor, device.info.product), ()):
        if layout.fits(device):
            return layout.mapping
    return None


def mapping_of(device: PadDevice) -> PadMapping:
    """Return what a pad's controls mean: as the user gives it, else as the table knows it."""
    mapping = mapping_or_none(device)
    if mapping is None:
        raise FleetError(
            f"{identity_of(device)}: what its axes mean is not known; "
            "`xrl lead --calibrate` asks for each, or set SDL_GAMECONTROLLERCONFIG"
        )
    return mapping


def mapping_or_none(device: PadDevice) -> PadMapping | None:
    """Return the same; None if nobody knows."""
    given = (mapping_from(line, device) for line in given_lines())
    return next((mapping for mapping in given if mapping is not None), known_mapping(device))
