"""What a bad network does to messages: delay, jitter, loss, partitions; seeded. Pure.

The words are those of tc-netem. One object decides for the modelled network of lockstep and
for the injector on the wire, so that both mean the same (design sections 6 and 7).
"""

from __future__ import annotations

import math
import random
from typing import Annotated, Final, Literal

from shared.clock import NS_PER_MS, NS_PER_S
from shared.toml_file import Range, Section

Share = Annotated[float, Range(0.0, 1.0, "")]
Ms = Annotated[float, Range(0.0, 60_000.0, "ms")]
Distribution = Literal["uniform", "normal", "pareto"]

HELD: Final = 1 << 62
"""Release time, ns, of what waits for the end of a partition."""
QUEUE_MAX: Final = 1000
"""Messages that wait for a slow line; what comes on top is lost, as in netem."""


class Impairment(Section, frozen=True, kw_only=True):
    """What one direction of a link does to what passes it; by default nothing."""

    delay_ms: Ms = 0.0
    jitter_ms: Ms = 0.0
    """uniform: delay +- jitter; normal, pareto: the standard deviation. Never before its time."""
    distribution: Distribution = "uniform"
    loss: Share = 0.0
    """Probability that a message never comes."""
    burst: Annotated[float, Range(1.0, 10_000.0, "messages")] = 1.0
    """Mean length of a row of losses (a Gilbert chain); 1: each by itself."""
    duplicate: Share = 0.0
    """Probability that a message comes twice, each with a delay of its own."""
    reorder: Share = 0.0
    """Probability that a message has no delay and so overtakes those before it."""
    rate: Annotated[float, Range(0.0, 1e10, "bytes/s")] = 0.0
    """Bytes a second that the line carries; 0: any."""
    ordered: bool = False
    """A late message holds up those behind it, and a partition holds them all back until its
    end, as on a stream (TCP). Without it: overtaken and lost, as datagrams are."""
    partition: bool = False
    """Nothing passes."""

    def in_words(self) -> str:
        """Return what is done, as `xrl inject` takes it: `delay=30 jitter=10`; `nothing`."""
        words = [
            f"{name}={value:g}"
            for name, value, standard in (
                ("delay", self.delay_ms, 0.0),
                ("jitter", self.jitter_ms, 0.0),
                ("loss", self.loss, 0.0),
                ("burst", self.burst, 1.0),
                ("duplicate", self.duplicate, 0.0),
                ("reorder", self.reorder, 0.0),
                ("rate", self.rate, 0.0),
            )
            if value != standard
        ]
        if self.distribution != "uniform":
            words.append(f"distribution={self.distribution}")
        words += [name for name in ("ordered", "partition") if getattr(self, name)]
        return " ".join(words) or "nothing"

    def fault(self) -> str:
        """Return what does not go together, `; ` and what would be right; empty if all does."""
        if self.ordered and self.reorder:
            return "ordered, and reorder; on a stream nothing overtakes: leave one out"
        if self.burst > 1.0 and not 0.0 < self.loss < 1.0:
            return f"burst {self.burst:g}, and a loss of {self.loss:g}; give a loss between 0 and 1"
        if self.burst > 1.0 and self.loss > self.burst * (1.0 - self.loss):
            shortest = self.loss / (1.0 - self.loss)
            return f"burst {self.burst:g}, and a loss of {self.loss:g}; bursts of {shortest:.3g} on"
        return ""


class Impairer:
    """Decides when each message of one direction comes out, and how often."""

    def __init__(self, what: Impairment, seed: str) -> None:
        """Begin; the same seed decides the same."""
        self.what = what
        self.passed = self.lost = 0
        """Messages that came out, or will; and those that never do."""
        self._random = random.Random(seed)
        self._in_burst = False
        self._line_free_ns = 0
        self._last_ns = 0

    def passes(self, now_ns: int, size: int) -> tuple[int, ...]:
        """Take a message in; return when it comes out, ns: never, once or twice.

        Args:
            now_ns: any monotonic clock; it must not go back.
            size: bytes of the message, for `rate`.
        """
        what = self.what
        if (what.partition and not what.ordered) or (what.loss and self._is_lost()):
            self.lost += 1
            return ()
        if what.rate and self._line_free_ns - now_ns > QUEUE_MAX * size * NS_PER_S / what.rate:
            self.lost += 1
            return ()
        copies = 2 if what.duplicate and self._random.random() < what.duplicate else 1
        self.passed += 1
        return tuple(self._release_ns(now_ns, size) for _ in range(copies))

    def delays(self, now_ns: int) -> int:
        """Return when what must not be lost comes out, ns: in order, after the mean delay.

        For what a link says for itself: opening, declaring, keeping alive. `HELD` in a
        partition.
        """
        if self.what.partition:
            return HELD
        release_ns = now_ns + round(self.what.delay_ms * NS_PER_MS)
        self._last_ns = max(self._last_ns, release_ns)
        return self._last_ns

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
        """Return a draw: uniform in -1..1, else of mean 0 and standard deviation 1."""
        if self.what.distribution == "normal":
            return self._random.gauss(0.0, 1.0)
        if self.what.distribution == "pareto":
            return (self._random.paretovariate(3.0) - 1.5) / math.sqrt(0.75)
        return self._random.uniform(-1.0, 1.0)

    def _is_lost(self) -> bool:
        """Return whether the next message is lost; with bursts a chain of two states."""
        what = self.what
        if what.burst <= 1.0:
            return self._random.random() < what.loss
        leaves = 1.0 / what.burst
        enters = what.loss * leaves / (1.0 - what.loss)
        turns = self._random.random() < (leaves if self._in_burst else enters)
        self._in_burst ^= turns
        return self._in_burst


class Direction:
    """One direction of a link, and what is done to it at the moment.

    Several impairments may be asked for at once: the one that began last is in force, and
    when it ends the one before it is again.
    """

    def __init__(self, name: str, seed: int) -> None:
        """Begin unimpaired.

        Args:
            name: of `shared.links`.
            seed: of all that will be decided here.
        """
        self.name = name
        self._seed = f"{seed} {name}"
        self._asked: dict[int, Impairer] = {}

    @property
    def in_force(self) -> Impairer | None:
        """What decides now; None: everything passes at once."""
        return next(reversed(self._asked.values()), None)

    def begin(self, number: int, what: Impairment) -> None:
        """Put an impairment in force; `number` tells it from all others, for `end`."""
        self._asked[number] = Impairer(what, f"{self._seed} {number}")

    def end(self, number: int) -> Impairer | None:
        """End an impairment and return it with its counts; None if it is not there."""
        return self._asked.pop(number, None)

    def asked(self, number: int) -> Impairer | None:
        """Return what was asked for under a number, in force or not; None if it is over."""
        return self._asked.get(number)

    def passes(self, now_ns: int, size: int) -> tuple[int, ...]:
        """Take a message in; return when it comes out, ns. As `Impairer.passes`."""
        impairer = self.in_force
        return (now_ns,) if impairer is None else impairer.passes(now_ns, size)
