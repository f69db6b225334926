"""Starts that are unions of sets: every member counts, and what is said of one is said of the worst of them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, ClassVar, NoReturn

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.sets.forms import Region


@dataclass(frozen=True, eq=False)
class StartUnion:
    """An initial set that is a union: the start may lie in any of the members.

    Whatever wants one set (a hull, a middle, a form) is refused, as the hull of a union holds starts that nobody asked
    about: verdicts and certificates take the members one by one.

    Parameters
    ----------
    members : tuple of Region
        Bounded sets of one dimension that do not move, two or more; the members may overlap.
    """

    members: tuple[Region, ...]

    random: ClassVar[bool] = False
    spread: ClassVar[bool] = False
    is_point: ClassVar[bool] = False

    @property
    def dimension(self) -> int:
        """Number of states."""
        return self.members[0].dimension

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Random points, shape (count, dimension): a member by lot, uniform in it."""
        chosen = rng.integers(0, len(self.members), count)
        points = np.empty((count, self.dimension))
        for number, member in enumerate(self.members):
            mine = chosen == number
            points[mine] = member.sample(rng, int(mine.sum()))
        return points

    def data(self, kinds: Collection[str]) -> dict[str, Any]:
        """What files say of it."""
        return {"kind": "union", "members": [member.data(kinds) for member in self.members]}

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("_") or name == "members":
            raise AttributeError(name)
        raise InfeasibleError(
            f"`initial` must be one set here, got a union of {len(self.members)}; take its members one by one, "
            "problem.replace(initial=problem.initial.members[0])."
        )
