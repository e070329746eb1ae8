"""Page of the robot file: every key with type, unit, range and default."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Annotated, Any, Final, Literal, get_args, get_origin, get_type_hints

import msgspec

from shared.config import files as config_file
from shared.config.gain_schedule import inputs_of
from shared.config.robot_config import RobotConfig
from shared.places import DEFAULT_CONFIG
from shared.toml_file import Range
from tools.dev.reference.markdown import cell_docs, one_line, summary, table

_INTRODUCTION: Final = """\
# The robot file

`deploy/robot.toml` describes the whole robot; `--config FILE` selects another file. Its comments
give the reasons for many values.

The unit `1` marks a plain number. *Default* is the value of a missing key; a key without a default
is required. *Shipped* is the value in `deploy/robot.toml`; long values are omitted. Of similar
tables, such as `[stand.ankle]` and `[stand.knee]`, only the first is shown.

The gain schedule beside the file depends on these keys, so run `xrl gains` after you change one:
{inputs}.
For `law.lead_easing` this is necessary only above the value for which the schedule was made.
"""
_LONGEST: Final = 60
"""Maximum characters of a shipped value in a cell."""
_NOT_IN_THE_FILE: Final = "gain_schedule"
"""Read from the file beside it (`shared.config.gain_schedule`)."""


def page() -> Iterator[str]:
    """Yield the page in Markdown."""
    shipped = _Shipped(DEFAULT_CONFIG.read_text(encoding="utf-8"))
    yield _INTRODUCTION.format(inputs=_schedule_inputs())
    yield "## Top level\n"
    yield from _table(RobotConfig, "", shipped)
    yield from _sections(RobotConfig, "", shipped)


def _schedule_inputs() -> str:
    """Return the keys on which the gain schedule depends; a whole table as `[table]`."""
    config = config_file.load(DEFAULT_CONFIG)
    keys: dict[str, list[str]] = {}
    aside = msgspec.structs.replace(config.mass, payload_com=(0.1, 0.0, 0.0))
    # also include the key that the schedule omits while it is zero
    for key in inputs_of(msgspec.structs.replace(config, mass=aside)):
        section, _, name = key.partition(".")
        keys.setdefault(section, []).append(name)
    shown = []
    for section, names in keys.items():
        whole = {field.name for field in msgspec.structs.fields(getattr(config, section))}
        named = [f"`{section}.{name}`" for name in names]
        shown += [f"`[{section}]`"] if whole.issubset(names) else named
    return ", ".join(shown)


class _Shipped:
    """Values and comments of the shipped file, by full key."""

    def __init__(self, text: str) -> None:
        self.values: dict[str, str] = {}
        self.comments: dict[str, str] = {}
        above: list[str] = []
        table = ""
        for line in _joined(text.splitlines()):
            if re.match(r"#\s*[\w.]+\s*=", line):
                continue  # a key that is commented out
            if line.startswith("#"):
                above.append(line.lstrip("# "))
                continue
            header = re.match(r"\[+([\w.]+)\]+\s*(?:#\s*(.*))?$", line)
            entry = re.match(r'([\w.]+)\s*=\s*((?:"[^"]*"|[^"#])*?)\s*(?:#\s*(.*))?$', line)
            if header:
                table = header[1] + "."
                self._comment(header[1], above, header[2])
            elif entry:
                key = table + entry[1]
                self.values.setdefault(key, entry[2])
                self._comment(key, above, entry[3])
            above = []

    def _comment(self, key: str, above: list[str], beside: str | None) -> None:
        text = " ".join([*above, beside or ""]).strip()
        if text:
            self.comments.setdefault(key, one_line(text))


def _joined(lines: list[str]) -> Iterator[str]:
    """Yield the lines, with an array over several lines on one."""
    pending = ""
    for line in lines:
        pending = f"{pending} {line.strip()}".strip() if pending else line.strip()
        code = pending.partition("#")[0]
        if not pending.startswith("#") and "=" in code and code.count("[") > code.count("]"):
            continue
        yield pending
        pending = ""


def _section(hint: Any) -> type[msgspec.Struct] | None:
    """Return the struct of a table, of an array of tables or of a table of tables."""
    for part in (hint, *get_args(hint)):
        if isinstance(part, type) and issubclass(part, msgspec.Struct):
            return part
    return None


def _sections(whole: type[msgspec.Struct], prefix: str, shipped: _Shipped) -> Iterator[str]:
    hints = get_type_hints(whole, include_extras=True)
    for name, hint in hints.items():
        section = _section(hint)
        is_shown = list(hints.values()).index(hint) < list(hints).index(name)  # by a sibling
        if section is None or name == _NOT_IN_THE_FILE or is_shown:
            continue
        yield f"## [{prefix}{name}]\n"
        yield summary(section) + "\n"
        yield from _table(section, f"{prefix}{name}.", shipped)
        yield from _sections(section, f"{prefix}{name}.", shipped)


def _table(section: type[msgspec.Struct], prefix: str, shipped: _Shipped) -> Iterator[str]:
    docs = cell_docs(section)
    fields = {field.name: field for field in msgspec.structs.fields(section)}
    rows: list[tuple[str, ...]] = []
    for name, hint in get_type_hints(section, include_extras=True).items():
        key, doc = prefix + name, docs.get(name, "")
        if name == _NOT_IN_THE_FILE:
            continue
        if _section(hint) is not None:
            if doc:
                rows.append((f"`{name}`", "table", "", "", "", "", doc))
            continue
        value = shipped.values.get(key, "")
        value = f"`{value}`" if value and len(value) <= _LONGEST else ""
        meaning = doc or shipped.comments.get(key, "")
        rows.append((f"`{name}`", *_described(hint), _default(fields[name]), value, meaning))
    if rows:
        yield from table("key | type | unit | range | default | shipped | meaning", rows)
        yield ""


def _default(field: msgspec.structs.FieldInfo) -> str:
    if field.required:
        return ""
    value = field.default_factory() if field.default is msgspec.NODEFAULT else field.default
    if isinstance(value, tuple):
        return f"`[{', '.join(map(repr, value))}]`"
    return f"`{value!r}`" if not isinstance(value, bool) else f"`{str(value).lower()}`"


def _described(hint: Any) -> tuple[str, str, str]:
    """Return type, unit and range of a key."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        limits = next(meta for meta in args[1:] if isinstance(meta, Range))
        return args[0].__name__, limits.unit, f"{limits.low:g}..{limits.high:g}"
    if origin is Literal:
        texts = (f'"{value}"' if isinstance(value, str) else value for value in args)
        return " or ".join(f"`{text}`" for text in texts), "", ""
    if origin is tuple:
        return _array(args)
    if origin is dict:
        return f"table of {_described(args[1])[0]}", "", ""
    return getattr(hint, "__name__", str(hint)), "", ""


def _array(args: tuple[Any, ...]) -> tuple[str, str, str]:
    if args[-1] is Ellipsis:
        kind, unit, limits = _described(args[0])
        return f"{kind}[]", unit, limits
    parts = [_described(part) for part in args]
    kind = parts[0][0]
    units, ranges = (list(dict.fromkeys(part[i] for part in parts)) for i in (1, 2))
    return f"{kind}[{len(parts)}]", ", ".join(units), "; ".join(ranges)
