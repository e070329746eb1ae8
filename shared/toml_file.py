"""Read TOML files into typed structs, with every number inside its `Range`.

Text is UTF-8. A byte order mark, which Windows editors write, is skipped, because TOML and JSON do
not allow one. Invalid content is refused with an error that names the file, the key, the value and
the right value (`shared.exceptions.ConfigError`).
"""

from __future__ import annotations

import codecs
import functools
import re
import stat
import tomllib
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec

from shared.exceptions import ConfigError

_OTHERS: Final = (
    ("UTF-32", codecs.BOM_UTF32_LE),  # before UTF-16, because its mark begins with UTF-16's
    ("UTF-32", codecs.BOM_UTF32_BE),
    ("UTF-16", codecs.BOM_UTF16_LE),
    ("UTF-16", codecs.BOM_UTF16_BE),
)


def decoded(content: bytes) -> str:
    """Return the text of a file's content.

    Raises UnicodeError, with the encoding or the bad byte, if it is not UTF-8.
    """
    for name, mark in _OTHERS:
        if content.startswith(mark):
            raise UnicodeError(f"is {name}; save it as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise UnicodeError(
            f"is not UTF-8 text: byte 0x{content[error.start]:02x} in line {line}; save it as UTF-8"
        ) from None


def read_text(path: Path) -> str:
    """Return a file's text; raise OSError if it cannot be read, UnicodeError if it is not UTF-8."""
    return decoded(path.read_bytes())


S = TypeVar("S", bound=msgspec.Struct)


class Range(NamedTuple):
    """Range of a number, with its unit."""

    low: float
    high: float
    unit: str


SIZE_MAX: Final = 1 << 24


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Table of a file; unknown keys are refused."""


def read_toml(path: Path, into: type[S]) -> S:
    """Read a TOML file into a struct, with every number inside its `Range`.

    Raises ConfigError if the file cannot be read or is invalid.
    """
    file = str(path)
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):  # reading a pipe would block forever
            raise ConfigError(file, "(file)", "not a regular file", "give the path of a TOML file")
        if found.st_size > SIZE_MAX:
            raise ConfigError(
                file, "(file)", f"larger than {SIZE_MAX >> 20} MiB", "give a TOML file"
            )
        text = read_text(path)
    except FileNotFoundError:
        raise ConfigError(file, "(file)", "not found", "give the path of a TOML file") from None
    except OSError as error:
        wrong = f"cannot be read: {error.strerror or error}"
        raise ConfigError(file, "(file)", wrong, "give the path of a readable TOML file") from None
    except UnicodeError as error:
        wrong = f"cannot be read: {error}".partition("; ")[0]
        raise ConfigError(file, "(file)", wrong, "give a TOML file in UTF-8") from None
    return parse_toml(text, file, into)


def parse_toml(text: str, file: str, into: type[S]) -> S:
    """Read TOML text into a struct, as `read_toml` does; `file` names it in errors."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(file, "(syntax)", str(error), "must be TOML 1.0") from None
    except RecursionError:
        raise ConfigError(file, "(syntax)", "nested too deeply", "use only a few levels") from None
    try:
        config = msgspec.convert(raw, into)
    except msgspec.ValidationError as error:
        raise _as_config_error(file, raw, into, str(error)) from None
    check_ranges(file, config)
    return config


def _as_config_error(file: str, raw: dict[str, Any], into: Any, message: str) -> ConfigError:
    """Turn msgspec's "Expected `float`, got `str` - at `$.mass.module`" into a ConfigError."""
    reason, _, place = message.partition(" - at `")
    path = place.rstrip("`").removeprefix("$").removeprefix(".")
    key, found, hint = _follow(path, raw, into)
    unknown = re.search(r"unknown field `(.*)`", reason)
    if unknown:
        full = f"{key}.{unknown[1]}".lstrip(".")
        return ConfigError(file, full, "unknown key", "remove it, or correct its spelling")
    missing = re.search(r"missing required field `(.*)`", reason)
    if missing:
        full = f"{key}.{missing[1]}".lstrip(".")
        return ConfigError(file, full, "missing", "this key is required")
    if get_origin(hint) is Literal:
        reason = f"must be one of {', '.join(map(str, get_args(hint)))}"
    return ConfigError(file, key or "(file)", f"{found!r} is not valid", reason)


def _follow(path: str, raw: Any, hint: Any) -> tuple[str, Any, Any]:
    """Return the full key, the value and the type hint at a msgspec path.

    msgspec writes `[...]` for an entry of a free table; this is the first entry that does not fit.
    """
    key, value = "", raw
    for name, index in re.findall(r"([A-Za-z_]\w*)|\[(\d+|\.\.\.)\]", path):
        if name:
            hint = _hints_of(hint)[name]
            key, value = f"{key}.{name}".lstrip("."), value[name]
        elif index == "...":
            hint = get_args(hint)[1]
            entry, value = next(
                (row for row in value.items() if not _fits(row[1], hint)), ("?", value)
            )
            key = f"{key}.{entry}"
        else:
            items = get_args(hint)
            hint = items[0] if items[-1] is Ellipsis else items[int(index)]
            key, value = f"{key}[{index}]", value[int(index)]
        if get_origin(hint) is Annotated:
            hint = get_args(hint)[0]
    return key, value, hint


@functools.cache
def _hints_of(kind: type) -> dict[str, Any]:
    """Return the type of each field; evaluating the annotations takes milliseconds."""
    return get_type_hints(kind, include_extras=True)


def _fits(value: Any, hint: Any) -> bool:
    try:
        msgspec.convert(value, hint)
    except msgspec.ValidationError:
        return False
    return True


def check_ranges(file: str, config: msgspec.Struct) -> None:
    """Raise ConfigError if a number of a struct is outside the `Range` of its type hint."""
    _check_ranges(file, "", config, type(config))


def _check_ranges(file: str, key: str, value: Any, hint: Any) -> None:
    """Walk a struct by its type hints and check each number against its `Range`."""
    origin = get_origin(hint)
    if origin is Annotated:
        for note in hint.__metadata__:
            if isinstance(note, Range) and not note.low <= value <= note.high:
                allowed = f"must be from {note.low:g} to {note.high:g} {note.unit}"
                raise ConfigError(file, key, f"{value!r} is out of range", allowed)
        return
    if origin in (Union, UnionType):
        if value is not None:
            _check_ranges(file, key, value, next(one for one in get_args(hint) if one is not None))
    elif isinstance(value, msgspec.Struct):
        hints = _hints_of(type(value))
        for name in value.__struct_fields__:
            _check_ranges(file, f"{key}.{name}".lstrip("."), getattr(value, name), hints[name])
    elif origin is tuple:
        hints_of_items = get_args(hint)
        repeated = len(hints_of_items) == 2 and hints_of_items[1] is Ellipsis
        for index, item in enumerate(value):
            item_hint = hints_of_items[0 if repeated else index]
            _check_ranges(file, f"{key}[{index}]", item, item_hint)
    elif origin is dict:
        for name, item in value.items():
            _check_ranges(file, f"{key}.{name}", item, get_args(hint)[1])
