"""Two runs side by side: what is weaker, slower, lost or changed."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tests.yardstick.measure import Run

WEAKER = 1.1
"""Ratio of bounds beyond which one is weaker than another."""
SLOWER, _MOMENT = 1.5, 1.0
"""Ratio of seconds beyond which a run is slower, and the difference that it takes at least."""
DECIDED = ("SAFE", "UNSAFE", "UNSAFE_NOMINAL")
LOSSES = ("weaker", "lost")
"""Words that begin what makes a run worse than another."""


def differences(new: Run, old: Run) -> list[str]:
    """What differs between two runs of a problem, in words; those that begin with one of `LOSSES` are losses."""
    found = [f"asked for {new.limit:g} s, not {old.limit:g}"] if new.limit != old.limit else []
    found += [*_of_bounds("above", new.upper, old.upper, 1.0), *_of_bounds("below", new.lower, old.lower, -1.0)]
    if new.status != old.status:
        word = "lost status" if old.status in DECIDED else "status"
        found.append(f"{word}: {old.status} -> {new.status}")
    if old.certificate and not new.certificate:
        found.append(f"lost certificate ({old.certificate} bytes)")
    elif new.certificate and not old.certificate:
        found.append(f"certificate gained ({new.certificate} bytes)")
    if new.seconds > SLOWER * old.seconds and new.seconds > old.seconds + _MOMENT:
        found.append(f"slower: {old.seconds:.1f} -> {new.seconds:.1f} s")
    elif old.seconds > SLOWER * new.seconds and old.seconds > new.seconds + _MOMENT:
        found.append(f"faster: {old.seconds:.1f} -> {new.seconds:.1f} s")
    return found


def _of_bounds(side: str, new: float | None, old: float | None, sign: float) -> list[str]:
    """``sign`` is 1 where a larger bound is weaker."""
    nothing = sign * math.inf
    here, there = (nothing if one is None else one for one in (new, old))
    change = sign * (here - there) if here != there else 0.0
    word = "weaker" if change > math.log10(WEAKER) else "tighter" if change < -math.log10(WEAKER) else ""
    return [f"{word} {side}: {probability(old)} -> {probability(new)}"] if word else []


def worse(found: Sequence[str]) -> bool:
    """Whether one of the `differences` is a loss."""
    return any(one.startswith(LOSSES) for one in found)


def probability(log10: float | None) -> str:
    """A probability of which log10 is known; a dash for none."""
    if log10 is None:
        return "-"
    power = math.floor(log10) if log10 < -4 else 0
    return f"{10 ** (log10 - power):.4g}" + (f"e{power}" if power else "")


def line(name: str, kind: str, run: Run) -> str:
    """One run in one line."""
    size = f"{run.certificate / 1000:.0f} kB" if run.certificate else "none"
    return (
        f"{name:18s} {run.status:14s} [{probability(run.lower)}, {probability(run.upper)}]  {run.seconds:.1f} s  "
        f"{run.engine}  certificate {size}  ({kind})"
    )
