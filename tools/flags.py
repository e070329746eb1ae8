"""Typed fields that declare a verb's flags, and the parser and checks made from them.

    class HzFlags(RunDirFlags):
        topic: Annotated[tuple[str, ...], positional("TOPIC")] = ()
        \"\"\"such as 'joint/*/state' (default: all)\"\"\"
        for_s: Annotated[Seconds | None, option("--for")] = None
        \"\"\"stop after S seconds\"\"\"

A field's type determines how its flag is parsed: `bool` is a switch, a `Literal` is a choice, a
tuple's flag may be repeated, and a number has a `Range` with its unit. The string below a field is
its help, also for completion and the reference page. `check` holds rules that involve several
fields.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import functools
import inspect
import itertools
import math
import textwrap
import types
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from shared import places
from shared.joints import MODULES
from shared.run_directory import check_own, default_run_dir, own_directory
from shared.toml_file import Range

F = TypeVar("F", bound="Flags")

FINITE_MAX: Final = 1e12
_OUR_PACKAGES: Final = ("shared", "services", "tools", "tests")

Number = Annotated[float, Range(-FINITE_MAX, FINITE_MAX, "")]
Seconds = Annotated[float, Range(0.0, FINITE_MAX, "s")]
Duration = Annotated[float, Range(1e-3, FINITE_MAX, "s")]
Count = Annotated[int, Range(1, 1_000_000, "")]
Natural = Annotated[int, Range(0, 2**63 - 1, "")]
"""Seed, or number of a case."""
Rate = Annotated[float, Range(1e-3, 1e4, "Hz")]
Degrees = Annotated[int, Range(-360, 360, "degrees")]


@dataclass_transform(kw_only_default=True, frozen_default=True)
class Flags:
    """Base of all declarations: each subclass is a frozen dataclass with keyword arguments only."""

    def __init_subclass__(cls) -> None:  # noqa: D105 - the class says it
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)

    def check(self) -> None:
        """Raise an `XrlError` if flags contradict each other; its message says what is valid.

        An override calls `super().check()` first.
        """


class Arg(NamedTuple):
    """Properties of a flag that its field's type does not give."""

    names: tuple[str, ...] = ()
    """Names of the flag; if empty, `--` and the field's name."""
    metavar: str = ""
    choices: tuple[str, ...] = ()
    """Valid values, if they come from a table and not from a `Literal`."""
    parse: Callable[[str], Any] | None = None
    """Parser of one value; its argparse.ArgumentTypeError says what is valid."""
    is_positional: bool = False
    is_one: bool = False
    """True if one argument contains the whole tuple."""
    exclusive: str = ""
    """Name of a group of flags that exclude each other."""
    one_of: str = ""
    """Name of a group of flags of which exactly one is required."""
    group: str = ""
    """Heading in the help; further lines describe the group."""
    help: str = ""
    """Computed help, which replaces the string below the field."""


def option(*names: str, **more: Any) -> Arg:
    """Return a flag whose names differ from the field's."""
    return Arg(names, **more)


def positional(metavar: str, **more: Any) -> Arg:
    """Return an argument without a flag."""
    return Arg(metavar=metavar, is_positional=True, **more)


Folder = Annotated[Path, Arg(metavar="DIR")]
Module = Annotated[str, Arg(choices=MODULES, metavar="MODULE")]
RUN_HELP: Final = "record of a run, finished or not; or its directory, for all files of a split run"
Run = Annotated[Path, positional("RUN", help=RUN_HELP)]


def parsed(parse: Callable[[str], Any], metavar: str, **more: Any) -> Arg:
    """Return a flag whose value a function parses."""
    return Arg(metavar=metavar, parse=parse, **more)


def names_of(known: Collection[str] = ()) -> Callable[[str], tuple[str, ...]]:
    """Return a parser of distinct names, separated by commas; an empty `known` allows any name."""

    def parse(text: str) -> tuple[str, ...]:
        names = tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
        for name in names:
            if known and name not in known:
                raise argparse.ArgumentTypeError(
                    f"{name[:40]!r}: must be one of {', '.join(known)}"
                )
        return names

    return parse


def numbers(count: int, like: str) -> Callable[[str], tuple[float, ...]]:
    """Return a parser of `count` numbers separated by commas or spaces; `like` describes them."""

    def parse(text: str) -> tuple[float, ...]:
        words = text.replace(",", " ").split()
        if len(words) != count:
            raise argparse.ArgumentTypeError(f"expected {count} numbers ({like}), got {len(words)}")
        found = []
        for word in words:
            try:
                found.append(float(word))
            except ValueError:
                found.append(math.nan)
            if not abs(found[-1]) <= FINITE_MAX:
                raise argparse.ArgumentTypeError(
                    f"{word[:40]!r}: not a valid number; expected {like}"
                )
        return tuple(found)

    return parse


class _Field(NamedTuple):
    name: str
    kind: Any
    """Type of one value, without None, annotations and the enclosing tuple."""
    limits: Range | None
    arg: Arg
    help: str
    is_repeated: bool
    is_required: bool
    default: Any


def fields_of(declaration: type[Flags]) -> Iterator[_Field]:
    """Yield the fields, a class's own before those of its bases."""
    hints = get_type_hints(declaration, include_extras=True)
    docs = field_docs(declaration)
    by_name = {field.name: field for field in dataclasses.fields(declaration)}  # type: ignore[arg-type]
    names = [
        name for owner in declaration.__mro__ for name in vars(owner).get("__annotations__", ())
    ]
    for name in dict.fromkeys(names):
        field = by_name[name]
        kind, limits, arg, is_repeated = _taken_apart(hints[name])
        is_repeated = is_repeated and not arg.is_one
        is_required = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        text = arg.help or docs.get(name, "")
        if _shows_default(field.default, text):
            text += f" (default: {_in_words(field.default)})"
        yield _Field(name, kind, limits, arg, text, is_repeated, is_required, field.default)


def field_docs(struct: type) -> dict[str, str]:
    """Return the docstring below each field, base classes included, as one line."""
    docs: dict[str, str] = {}
    for owner in reversed(struct.__mro__):
        if owner.__module__.partition(".")[0] in _OUR_PACKAGES:
            docs |= _own_docs(owner)
    return docs


@functools.cache
def _own_docs(struct: type) -> dict[str, str]:
    tree = ast.parse(textwrap.dedent(inspect.getsource(struct)))
    (body,) = (node.body for node in tree.body if isinstance(node, ast.ClassDef))
    docs = {}
    for field, below in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign):
            target: ast.expr = field.target
        elif isinstance(field, ast.Assign):  # a member of an enumeration
            target = field.targets[0]
        else:
            continue
        if isinstance(target, ast.Name) and isinstance(below, ast.Expr):
            docs[target.id] = " ".join(ast.literal_eval(below.value).split())
    return docs


def _taken_apart(hint: Any) -> tuple[Any, Range | None, Arg, bool]:
    limits, arg, is_repeated = None, Arg(), False
    while True:
        origin, parts = get_origin(hint), get_args(hint)
        if origin is Annotated:
            hint = parts[0]
            for note in parts[1:]:
                limits = note if isinstance(note, Range) else limits
                arg = note if isinstance(note, Arg) else arg
        elif origin in (Union, types.UnionType):
            (hint,) = (part for part in parts if part is not type(None))
        elif origin is tuple and len(parts) == 2 and parts[1] is Ellipsis:
            hint, is_repeated = parts[0], True
        else:
            return hint, limits, arg, is_repeated


def _shows_default(default: object, text: str) -> bool:
    is_nothing = default is dataclasses.MISSING or default is None or default in (False, "", ())
    return "(default" not in text and (not is_nothing or type(default) in (int, float))


def _in_words(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def add_flags(parser: argparse.ArgumentParser, declaration: type[Flags]) -> None:
    """Add every field of a declaration to a parser."""
    groups: dict[str, Any] = {"": parser}
    exclusive: dict[str, Any] = {}
    for field in fields_of(declaration):
        arg = field.arg
        if arg.group not in groups:
            groups[arg.group] = parser.add_argument_group(*arg.group.split("\n", 1))
        where = groups[arg.group]
        if word := arg.exclusive or arg.one_of:
            if word not in exclusive:
                needed = bool(arg.one_of)
                exclusive[word] = where.add_mutually_exclusive_group(required=needed)
            where = exclusive[word]
        names = [field.name] if arg.is_positional else list(arg.names or [_flag(field.name)])
        where.add_argument(*names, **_argument(field))


def _flag(name: str) -> str:
    return f"--{name.strip('_').replace('_', '-')}"


def _argument(field: _Field) -> dict[str, Any]:
    arg, kind = field.arg, field.kind
    found: dict[str, Any] = {
        "help": field.help.replace("%", "%%"),
        "default": argparse.SUPPRESS,  # the declaration's own default applies
    }
    if not arg.is_positional:
        found |= {"dest": field.name, "required": field.is_required}
    if kind is bool:
        return found | {"action": "store_true"}
    if arg.choices or get_origin(kind) is Literal:
        found["choices"] = arg.choices or get_args(kind)
    else:
        found["type"] = arg.parse or _reader(kind, field.limits)
    metavar = arg.metavar or (_unit(field) if "choices" not in found else "")
    if metavar:
        found["metavar"] = metavar
    if field.is_repeated and arg.is_positional:
        found["nargs"] = "+" if field.is_required else "*"
    elif field.is_repeated:
        found["action"] = "append"
    elif arg.is_positional and not field.is_required:
        found |= {"nargs": "?", "default": None}  # argparse would parse SUPPRESS as a value
    return found


def _unit(field: _Field) -> str:
    if field.kind is Path:
        return "FILE"
    if field.limits is not None:
        return field.limits.unit.replace(" ", "").upper() or "N"
    return field.name.upper()


def _reader(kind: Any, limits: Range | None) -> Callable[[str], Any]:
    if kind is int or kind is float:
        if limits is None:
            raise TypeError("a number needs a Range")
        return functools.partial(_number, kind, limits)
    reader: Callable[[str], Any] = kind
    return reader


def _number(kind: type[int] | type[float], limits: Range, text: str) -> float:
    try:
        number = kind(text.strip()) if "_" not in text else math.nan
    except ValueError:
        number = math.nan
    if not limits.low <= number <= limits.high:
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: must be {_right(kind, limits)}")
    return number


def _right(kind: type, limits: Range) -> str:
    thing = "a whole number" if kind is int else "a number"
    unit = f" {limits.unit}".rstrip()
    if kind is float and limits.high >= FINITE_MAX:
        least = "" if limits.low <= -FINITE_MAX else f" of at least {limits.low:g}{unit}"
        return f"{thing}{least or unit}"
    return f"{thing} from {limits.low:.12g} to {limits.high:.12g}{unit}"


def read_flags(declaration: type[F], found: argparse.Namespace) -> F:
    """Return the given flags, checked, with the declaration's defaults for the rest.

    Raises:
        XrlError: flags contradict each other, or a default cannot be determined.
    """
    given = {
        field.name: tuple(value) if field.is_repeated else value
        for field in fields_of(declaration)
        if (value := getattr(found, field.name, None)) is not None
    }
    flags = declaration(**given)
    flags.check()
    return flags


def _own_run_dir() -> Path:
    path = default_run_dir()
    check_own(path, alone=False)
    return path


class RunDirFlags(Flags):
    """Fleet that a verb acts on."""

    run_dir: Annotated[Path, parsed(own_directory, "DIR")] = dataclasses.field(
        default_factory=_own_run_dir
    )
    """the fleet's run directory, with its logs (default: $XRL_RUN_DIR, else /tmp/xrl-UID)"""


class ConfigFlags(Flags):
    """Robot file of a verb."""

    config: Annotated[Path, parsed(places.config_argument, "FILE", help=places.HELP)] = (
        dataclasses.field(default_factory=places.robot_file)
    )


def _robot_file_of(before: str) -> Arg:
    """Return the flag for a robot file, with `before` ahead of the usual defaults.

    The field is None if the flag is not given; the verb then calls `places.robot_file` itself.
    """
    text = places.HELP.replace("(default: ", f"(default: {before}, else ")
    return Arg(metavar="FILE", help=text)


class FleetRobotFlags(RunDirFlags):
    """Fleet and robot file; by default the robot file of the running fleet, if there is one."""

    config: Annotated[Path | None, _robot_file_of("the fleet's")] = None


class MotionFlags(FleetRobotFlags):
    """Flags of a verb that shows its motions, and moves the robot once they are confirmed."""

    yes: bool = False
    """do not ask for confirmation"""
    dry_run: bool = False
    """show the motions, move nothing"""
