"""What the axes and buttons of well-known pads mean, by vendor and product.

The kernel's gamepad protocol (Documentation/input/gamepad.rst) names the codes, and drivers deviate
from it: one pad has another layout by Bluetooth than by cable, and another with another driver. So
a product has all layouts that its drivers give it, and the one whose codes are there is taken.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from tools.pads.controls import BUTTONS, EV_ABS, EV_KEY, PadControl, PadDevice, PadMapping, codes_of

_Y, _Z, _RX, _RY, _RZ, _GAS, _BRAKE = 0x01, 0x02, 0x03, 0x04, 0x05, 0x09, 0x0A
_SOUTH, _EAST, _C, _NORTH, _WEST, _Z_BUTTON = 0x130, 0x131, 0x132, 0x133, 0x134, 0x135
_TL, _TR, _TL2, _TR2, _SELECT, _START = 0x136, 0x137, 0x138, 0x139, 0x13A, 0x13B
_KEY_BACK: Final = 0x9E


class Layout(NamedTuple):
    """One layout."""

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
