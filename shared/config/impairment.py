"""Seeded model of a bad network: delay, jitter, loss, partitions. Pure.

Terms are those of tc-netem, where it has them. Lockstep's modelled network and the network proxy on
the wire use the same class, so both behave alike (docs/networks.md). In lockstep it acts on
messages; on the wire it acts on Zenoh's batches, so messages that are sent together travel, or are
lost, together.
"""

from __future__ import annotations

import math
import random
from decimal import Decimal
from typing import Annotated, Final, Literal

from shared.clock import NS_PER_MS, NS_PER_S
from shared.toml_file import Range, Section

Share = Annotated[float, Range(0.0, 1.0, "(1 is 100 %)")]
Ms = Annotated[float, Range(0.0, 60_000.0, "ms")]
Distribution = Literal["uniform", "normal", "pareto"]

HELD: Final = 1 << 62
"""Release time, ns, of messages that wait for the end of a partition."""
ROUNDING: Final = 1e-9
"""Relative tolerance of shares: 1 - 0.9 is not quite 0.1."""
QUEUE_MAX: Final = 1000
"""Maximum number of messages that wait for a slow line; further ones are lost, as in netem."""


class Impairment(Section, frozen=True, kw_only=True):
    """Impairment of one direction of a link; by default none."""

    delay_ms: Ms = 0.0
    jitter_ms: Ms = 0.0
    """uniform: the delay varies by +- jitter; normal, pareto: jitter is its standard deviation. A
    negative delay counts as zero."""
    distribution: Distribution = "uniform"
    loss: Share = 0.0
    """Probability that a message is lost."""
    burst: Annotated[float, Range(1.0, 10_000.0, "messages")] = 1.0
    """Mean number of consecutive losses (a Gilbert chain); 1: independent losses."""
    duplicate: Share = 0.0
    """Probability that a message is duplicated; each copy has its own delay."""
    reorder: Share = 0.0
    """Probability that a message has no delay and so overtakes those before it."""
    rate: Annotated[float, Range(0.0, 1e10, "bytes/s")] = 0.0
    """Capacity of the line; 0: unlimited."""
    ordered: bool = False
    """True: as on a stream (TCP), a late message delays those behind it, and a partition holds all
    messages until its end; but a lost message is not sent again. False: messages behave like
    datagrams, and a partition loses them."""
    partition: bool = False
    """Nothing passes."""

    def describe(self) -> str:
        """Return the impairment in `--inject`'s syntax, `delay=30ms loss=20%`, or `nothing`."""
        words = [
            f"{name}={_digits(value, places)}{unit}"
            for name, value, standard, places, unit in (
                ("delay", self.delay_ms, 0.0, 0, "ms"),
                ("jitter", self.jitter_ms, 0.0, 0, "ms"),
                ("loss", self.loss, 0.0, 2, "%"),
                ("burst", self.burst, 1.0, 0, ""),
                ("duplicate", self.duplicate, 0.0, 2, "%"),
                ("reorder", self.reorder, 0.0, 2, "%"),
                ("rate", self.rate, 0.0, 0, ""),
            )
            if value != standard
        ]
        if self.distribution != "uniform":
            words.append(f"distribution={self.distribution}")
        words += [name for name in ("ordered", "partition") if getattr(self, name)]
        return " ".join(words) or "nothing"

    def fault(self) -> str:
        """Return a contradiction or a setting without effect, with its remedy; empty if none."""
        late = self.delay_ms or self.jitter_ms
        alone = Impairment(partition=self.partition, ordered=self.ordered).describe()
        if self.partition and self.describe() != alone:
            return f"{self.describe()}; nothing passes in a partition: remove all but ordered"
        if self.ordered and self.reorder:
            return "ordered with reorder; messages on a stream cannot overtake: remove one of them"
        if self.burst > 1.0 and not 0.0 < self.loss < 1.0:
            return f"burst {self.burst:g} with a loss of {self.loss:g}; give a loss between 0 and 1"
        least = self.loss / (1.0 - self.loss) * (1.0 - ROUNDING) if self.loss < 1.0 else 1.0
        if 1.0 < self.burst < least:
            found = (
                f"loss {_digits(self.loss, 2)}% in bursts of {self.burst:g} leaves less than one"
            )
            return f"{found} message between bursts; give a burst of {math.ceil(least)} or more"
        if self.reorder and not late:
            return "reorder without a delay that messages could overtake; give a delay"
        if self.distribution != "uniform" and not self.jitter_ms:
            return f"distribution {self.distribution} without jitter; give a jitter"
        if self.ordered and not (late or self.rate or self.partition):
            return (
                "ordered, but nothing is delayed or held back; give a delay, a rate or a partition"
            )
        return ""


def _digits(value: float, places: int) -> str:
    """Return a number times 10**places as text that parses back to the same number."""
    return f"{Decimal(repr(value)).scaleb(places).normalize():f}"


class Impairer:
    """Seeded release times of the messages of one direction."""

    def __init__(self, what: Impairment, seed: str) -> None:
        self.what = what
        self.passed = self.lost = 0
        """Numbers of messages that were or will be released, and of messages that were lost. A
        duplicated message counts once.
        """
        self._random = random.Random(seed)
        self._in_burst = False
        self._line_free_ns = 0
        self._last_ns = 0

    def passes(self, now_ns: int, size: int) -> tuple[int, ...]:
        """Accept a message of `size` bytes; return its release times, ns: none, one or two.

        `now_ns` is a time of any monotonic clock.
        """
        what = self.what
        if (what.partition and not what.ordered) or (what.loss and self._is_lost()):
            self.lost += 1
            return ()
        if what.rate and self._line_free_ns - now_ns > QUEUE_MAX * size * NS_PER_S / what.rate:
            self.lost += 1
            return ()
        twice = what.duplicate and self._random.random() < what.duplicate
        self.passed += 1
        release_ns = self._release_ns(now_ns, size)
        return (release_ns, self._release_ns(now_ns, size)) if twice else (release_ns,)

    def delays(self, now_ns: int) -> int:
        """Return the release time, ns, of a link's own traffic.

        This traffic opens links, declares keys and keeps links alive. It stays in order and is
        never lost. It has the mean delay; in a partition its release time is `HELD`.
        """
        if self.what.partition:
            return HELD
        release_ns = now_ns + round(self.what.delay_ms * NS_PER_MS)
        self._last_ns = max(self._last_ns, release_ns)
        return self._last_ns

    def drop(self) -> None:
        """Count a passed message as lost, because its link ended before the release."""
        self.passed -= 1
        self.lost += 1

    def _release_ns(self, now_ns: int, size: int) -> int:
        what = self.what
        if what.partition:
            return HELD
        if what.rate:
            self._line_free_ns = max(now_ns, self._line_free_ns) + round(
                size * NS_PER_S / what.rate
            )
            now_ns = self._line_free_ns
        if what.reorder and self._random.random() < what.reorder:
            return now_ns
        delay_ms = what.delay_ms
        if what.jitter_ms:
            delay_ms = max(0.0, delay_ms + what.jitter_ms * self._spread())
        release_ns = now_ns + round(delay_ms * NS_PER_MS)
        if what.ordered:
            release_ns = self._last_ns = max(release_ns, self._last_ns)
        return release_ns

    def _spread(self) -> float:
        """Return a draw: uniform in -1..1, or with mean 0 and standard deviation 1."""
        if self.what.distribution == "normal":
            return self._random.gauss(0.0, 1.0)
        if self.what.distribution == "pareto":
            return (self._random.paretovariate(3.0) - 1.5) / math.sqrt(0.75)
        return self._random.uniform(-1.0, 1.0)

    def _is_lost(self) -> bool:
        """Return whether the next message is lost; bursts follow a chain of two states."""
        what = self.what
        if what.burst <= 1.0:
            return self._random.random() < what.loss
        leaves = 1.0 / what.burst
        enters = what.loss * leaves / (1.0 - what.loss)
        turns = self._random.random() < (leaves if self._in_burst else enters)
        self._in_burst ^= turns
        return self._in_burst


class Direction:
    """One direction of a link, and its present impairment.

    Several impairments may be requested at once; one is active: the newest partition, or without a
    partition the newest impairment. When it ends, the next by this rule is active. The owner of
    the queue keeps a stream in order during this change.
    """

    def __init__(self, name: str, seed: int) -> None:
        self.name = name
        self.active: Impairer | None = None
        """Active impairment; None: everything passes at once."""
        self._seed = f"{seed} {name}"
        self._asked: dict[int, Impairer] = {}

    def begin(self, number: int, what: Impairment) -> None:
        """Add an impairment; `end` removes it by its number."""
        self._asked[number] = Impairer(what, f"{self._seed} {number}")
        self._choose()

    def end(self, number: int) -> Impairer | None:
        """End an impairment and return it with its counts; None if it is unknown."""
        ended = self._asked.pop(number, None)
        self._choose()
        return ended

    def requested(self, number: int) -> Impairer | None:
        """Return the impairment with a number, active or not; None if it is over."""
        return self._asked.get(number)

    def passes(self, now_ns: int, size: int) -> tuple[int, ...]:
        """Accept a message; return its release times, ns, as `Impairer.passes` does."""
        return (now_ns,) if self.active is None else self.active.passes(now_ns, size)

    def _choose(self) -> None:
        asked = self._asked.values()
        cut = [impairer for impairer in asked if impairer.what.partition]
        self.active = next(reversed(cut or [*asked]), None)
