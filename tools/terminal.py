"""Tables and styled text for a terminal, a pipe or a file.

Text from a log, the bus or another host is data: only `marked` templates are parsed for Rich's
markup, and control characters are shown escaped (`tools.guarded_streams`). Tables for a pipe or a
file are as wide as they need to be, without frames and colours. On a terminal, cells that do not
fit are folded.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

import rich.console
from rich.console import ConsoleOptions, RenderableType
from rich.live import Live
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from tools.guarded_streams import cleaned, is_clean

WIDE: Final = 10_000
"""Width of a pipe or a file, columns."""
_FOLDED_MIN: Final = 8
"""Minimum width of a folded text column, characters."""

_HOLE: Final = "\0"
_FIELD: Final = re.compile(r"\{(?:![rs])?(?::[^{}]*)?\}")


def marked(template: str, *values: object) -> Text:
    """Return the template with the values filled in; only the template is parsed as markup."""
    whole = Text()
    given = zip(_FIELD.findall(template), values, strict=True)
    frame = Text.from_markup(_FIELD.sub(_HOLE, template), emoji=False)
    for part in frame.split(_HOLE, include_separator=True, allow_blank=True):
        if not part.plain.endswith(_HOLE):
            whole.append_text(part)
            continue
        field, value = next(given)
        filling = value.copy() if isinstance(value, Text) else Text(cleaned(field.format(value)))
        for span in part.spans:
            if span.end == len(part):
                filling.stylize_before(span.style)
        part.right_crop(1)
        whole.append_text(part)
        whole.append_text(filling)
    next(given, None)  # raises if there are too many values
    return whole


class Console(rich.console.Console):
    """Rich's console, which prints plain strings as they are, without parsing markup."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"markup": False, "emoji": False, **options})
        if not self.is_terminal and "width" not in options:
            self.width = WIDE

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a plain string as text, with its control characters escaped."""
        return super().render_str(cleaned(text), **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Yield the segments of a renderable, with whole tables and escaped control characters."""
        segments = super().render(renderable, options)
        if isinstance(renderable, Table):
            self._let_fit(renderable, options or self.options)
            if not self.is_terminal:  # one long cell would pad every row with blanks
                lines = Segment.split_lines(super().render(renderable, options))
                texts = ["".join(part.text for part in line).rstrip() for line in lines]
                segments = [Segment(f"{text}\n") for text in texts]
        for segment in segments:
            if segment.control or is_clean(segment.text):
                yield segment
            else:
                yield Segment(cleaned(segment.text), segment.style)

    def on_broken_pipe(self) -> None:
        """Raise, so that the command line handles it: Rich itself would exit with 1."""
        raise BrokenPipeError

    def _let_fit(self, table: Table, options: ConsoleOptions) -> None:
        """Fold cells that would be cut off; remove the frame for a pipe or a file."""
        if not self.is_terminal:
            table.box, table.pad_edge = None, False
        wide = options.update(max_width=WIDE)
        if Measurement.get(self, wide, table).maximum <= options.max_width:
            return
        text = [column for column in table.columns if column.justify == "left"]
        for column in text:
            column.no_wrap, column.min_width, column.width = False, None, _FOLDED_MIN
        crowded = Measurement.get(self, wide, table).maximum > options.max_width
        for column in text:
            column.width = None
        for column in table.columns:
            column.overflow = "fold"
            column.no_wrap = column.no_wrap and not crowded


@contextlib.contextmanager
def renewed(
    console: Console, *, transient: bool = False
) -> Iterator[Callable[[RenderableType], None]]:
    """Yield a function that shows the newest renderable, in place on a terminal, else appended."""
    if not console.is_terminal:

        def show(shown: RenderableType) -> None:
            console.print(shown)
            console.file.flush()

        yield show
        return
    with Live(console=console, auto_refresh=False, transient=transient) as live:
        yield lambda shown: live.update(shown, refresh=True)
