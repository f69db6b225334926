"""Constraints, and what they leave to a deviation: rows r and rooms b with "r . S <= b keeps the constraint".

- A safe polyhedron {a . (x - o) <= b} asks a . S <= b - a . (p - o) for every face.
- A safe ball or ellipsoid is replaced by a polygon (a box in three dimensions or more) inscribed in it.
- An obstacle is kept off by one direction a piece, which the certificate names: S must not bring the state beyond the
  supporting half-space of the obstacle in that direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flint import arb, arb_mat

from certbound.checker.balls import cholesky, identity, is_positive_definite, matrix, quadratic
from certbound.checker.reading import Record, entries, number, numbers, whole, wholes
from certbound.checker.report import Budget
from certbound.checker.statement.tapes import read_tape
from certbound.checker.words import shortened
from certbound.errors import CertificateError
from certbound.problem.model import Tape

POLYGON = 24

Row = list[arb]
_ZERO = arb(0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Region:
    """A set in some coordinates: polyhedral (``faces``, ``bounds``), or round (``radius`` or ``shape``).

    ``center`` is a list of numbers or a tape over t; a polyhedron is {faces (x - center) <= bounds}.
    """

    kind: str
    coordinates: tuple[int, ...]
    center: list[float] | Tape
    faces: list[list[float]]
    bounds: list[float]
    radius: float = 0.0
    shape: arb_mat | None = None

    @property
    def round(self) -> bool:
        """Whether it is a ball or an ellipsoid."""
        return self.kind in ("ball", "ellipsoid")

    def face(self, number: int) -> Row:
        """The direction of a face."""
        return [_ZERO if x == 0.0 else arb(x) for x in self.faces[number]]

    def lift(self, row: Sequence[arb], dimension: int) -> Row:
        """A direction of the region's coordinates as one of the whole state."""
        full = [_ZERO] * dimension
        for place, value in zip(self.coordinates, row):
            full[place] = value
        return full

    def image(self, dimension: int, budget: Budget) -> tuple[arb_mat, arb]:
        """W over all states and a bound with the region equal to {|W (x - center)| <= bound} (round ones).

        Of an ellipsoid {y^T shape^-1 y <= 1} it is the inverse of the Cholesky factor of its shape.
        """
        k = len(self.coordinates)
        budget.hold(k * (k + dimension // 4))
        budget.balls(2 * k * (k + dimension // 4))
        square, bound = identity(k), arb(self.radius)
        if self.shape is not None:
            budget.products(k, k, k)
            square, bound = cholesky(self.shape, budget).inv(), arb(1)
        rows = [self.lift([square[i, j] for j in range(k)], dimension) for i in range(k)]
        return matrix(rows), bound

    def support(self, row: Sequence[arb], budget: Budget) -> arb:
        """Upper bound of row . y over the region moved to the origin (round ones)."""
        budget.products(len(row), len(row) if self.shape is not None else 6)
        if self.shape is None:
            square = sum((x * x for x in row), arb(0))
            return arb(self.radius) * square.upper().sqrt()
        flat = arb_mat(1, len(row), list(row))
        return quadratic(flat, self.shape, flat).upper().sqrt()

    def inscribed(self, budget: Budget) -> list[tuple[Row, arb]]:
        """Rows a and bounds b of a polyhedron {a . y <= b} inside the round region at the origin."""
        k = len(self.coordinates)
        budget.hold(2 * k * k)
        budget.products(k, k, 8 if self.shape is None else 3 * k)
        if k == 1:
            unit, scale = [[arb(1)], [arb(-1)]], arb(1)
        elif k == 2:
            turns = [arb(2 * i) / POLYGON for i in range(POLYGON)]
            unit, scale = [[x.cos_pi(), x.sin_pi()] for x in turns], (arb(1) / POLYGON).cos_pi()
        else:
            unit = [[arb(s if j == i else 0) for j in range(k)] for i in range(k) for s in (1, -1)]
            scale = 1 / arb(k).sqrt()
        if self.shape is None:
            return [(row, scale * arb(self.radius)) for row in unit]
        factor = cholesky(self.shape, budget).inv()
        return [((arb_mat(1, k, row) * factor).entries(), scale) for row in unit]


@dataclass(frozen=True, eq=False, kw_only=True)
class Constraint:
    """Inside or outside of a region, while it is asked."""

    inside: bool
    region: Region
    during: tuple[float, float] | None
    label: str

    @classmethod
    def of_domain(cls, ranges: list[tuple[float | None, float | None]]) -> Constraint:
        """Staying in the model's domain."""
        faces, bounds = _sides([low for low, _ in ranges], [high for _, high in ranges])
        region = Region(
            kind="box", coordinates=tuple(range(len(ranges))), center=[0.0] * len(ranges), faces=faces, bounds=bounds
        )
        return cls(inside=True, region=region, during=None, label="the model's domain")

    @property
    def separated(self) -> bool:
        """Whether the certificate names a direction for every piece."""
        return not self.inside and self.region.kind != "halfspace"

    def read_separation(self, value: object, path: str, count: int, budget: Budget) -> list[tuple[Row, arb]]:
        """Per piece a row a and an upper bound of a . y over the obstacle moved to the origin."""
        region = self.region
        budget.hold(2 * count)
        if region.round:
            rows = numbers(value, path, count, len(region.coordinates))
            budget.hold(count * len(region.coordinates))
            exact = []
            for row in rows:
                budget.check()
                turned = [arb(x) for x in row]
                exact.append((turned, region.support(turned, budget)))
            return exact
        faces: dict[int, tuple[Row, arb]] = {}
        found = []
        for k, item in enumerate(entries(value, path, count, count)):
            budget.check()
            place = f"{path}[{k}]"
            if isinstance(item, list):
                found.append(self._mixed(item, place, budget))
                continue
            face = whole(item, place, 0, len(region.bounds) - 1)
            if face not in faces:
                faces[face] = region.face(face), arb(region.bounds[face])
            found.append(faces[face])
        return found

    def _mixed(self, value: object, path: str, budget: Budget) -> tuple[Row, arb]:
        """A combination of all faces by weights that are not negative."""
        region, faces = self.region, len(self.region.bounds)
        budget.hold(len(region.coordinates))
        budget.balls(faces * (2 + len(region.coordinates)))
        weights = [arb(number(x, path, least=0.0)) for x in entries(value, path, faces, faces)]
        row = [
            sum((w * face[i] for w, face in zip(weights, region.faces) if face[i]), arb(0))
            for i in range(len(region.coordinates))
        ]
        return row, sum((w * b for w, b in zip(weights, region.bounds)), arb(0)).upper()


def _sides(low: list[float | None], high: list[float | None]) -> tuple[list[list[float]], list[float]]:
    faces, bounds = [], []
    for ends, sign in ((high, 1.0), (low, -1.0)):
        for i, end in enumerate(ends):
            if end is not None:
                faces.append([sign if j == i else 0.0 for j in range(len(ends))])
                bounds.append(sign * end)
    return faces, bounds


def read_constraint(
    value: object, path: str, dimension: int, horizon: float, budget: Budget,
    kinds: tuple[str, ...] = ("inside", "outside"),
) -> Constraint:  # fmt: skip
    """One constraint of a certificate, or its target."""
    record = Record(value, path, ("kind", "region", "during", "label"))
    if record["kind"] not in kinds:
        raise CertificateError(f"`{path}.kind` must be " + " or ".join(f'"{kind}"' for kind in kinds) + ".")
    during = None
    if record["during"] is not None:
        first, last = numbers(record["during"], record.at("during"), 2)
        if not 0 <= first <= last <= horizon:
            raise CertificateError(f"`{path}.during` must lie within the horizon and rise.")
        during = (first, last)
    region = _region(record["region"], record.at("region"), dimension, budget)
    return Constraint(
        inside=record["kind"] != "outside", region=region, during=during,
        label=shortened(record.text("label")),
    )  # fmt: skip


_KINDS = {
    "box": ("low", "high", "center", "coordinates"),
    "ball": ("center", "radius", "coordinates"),
    "ellipsoid": ("center", "shape", "coordinates"),
    "halfspace": ("normal", "bound"),
    "polytope": ("A", "b"),
}


def _region(value: object, path: str, dimension: int, budget: Budget) -> Region:
    kind = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in _KINDS:
        raise CertificateError(f"`{path}.kind` must be one of {', '.join(_KINDS)}.")
    record = Record(value, path, ("kind", *_KINDS[kind]), ("center", "coordinates") if kind == "polytope" else ())
    coordinates = tuple(range(dimension))
    if record["coordinates"] is not None:
        coordinates = tuple(wholes(record["coordinates"], record.at("coordinates"), 0, dimension - 1))
        if not coordinates or len(set(coordinates)) != len(coordinates):
            raise CertificateError(f"`{path}.coordinates` must be different states.")
    k = len(coordinates)
    center = _center(record["center"], record.at("center"), k)
    if kind in ("halfspace", "polytope"):
        if kind == "halfspace":
            faces, bounds = [record.array("normal", k)], [record.number("bound")]
        else:
            faces, bounds = record.array("A", None, k), record.array("b", None)
        if len(faces) != len(bounds) or not faces:
            raise CertificateError(f"`{path}` must have as many rows of A as entries of b.")
        if not all(any(face) for face in faces):
            raise CertificateError(f"`{path}` must not have a face without direction.")
        return Region(kind=kind, coordinates=coordinates, center=center, faces=faces, bounds=bounds)
    if kind == "box":
        ends = [[None if x is None else number(x, path) for x in entries(record[name], path, k, k)]
                for name in ("low", "high")]
        if any(a is not None and b is not None and a > b for a, b in zip(*ends)):
            raise CertificateError(f"`{path}.low` must not exceed `high`.")
        budget.hold(k * k // 4 + 1)
        faces, bounds = _sides(ends[0], ends[1])
        return Region(kind=kind, coordinates=coordinates, center=center, faces=faces, bounds=bounds)
    if kind == "ball":
        radius = record.number("radius", least=0.0)
        return Region(kind=kind, coordinates=coordinates, center=center, faces=[], bounds=[], radius=radius)
    shape = matrix(record.symmetric("shape", k))
    if not is_positive_definite(shape, budget):
        raise CertificateError(f"`{path}.shape` must be positive definite.")
    return Region(kind=kind, coordinates=coordinates, center=center, faces=[], bounds=[], shape=shape)


def _center(value: object, path: str, k: int) -> list[float] | Tape:
    """Null (the origin), numbers, or a tape over t."""
    if value is None:
        return [0.0] * k
    if not isinstance(value, dict):
        result: list[float] = numbers(value, path, k)
        return result
    return read_tape(value, path, ("t",), (k,))
