"""The shape of a problem file: which keys exist, and what may stand there.

Wherever a number is wanted, an expression in the parameters may stand instead. Unknown keys are errors that
name the nearest known one. What the values mean is decided in ``reading``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, ValidationError, model_validator

from certbound.checks import nearest
from certbound.problem.noise import LAWS


def _no_boolean(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError(f"must be a number or an expression, got {str(value).lower()}")
    return value


def _no_text(value: Any) -> Any:
    if isinstance(value, str):
        raise ValueError(f"must be a number, got the text {value!r}; parameters are numbers without quotes")
    return _no_boolean(value)


Number = Annotated[float | str, BeforeValidator(_no_boolean)]
Vector = list[Number]
Matrix = list[list[Number]]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Place = dict[str, Number] | Vector
Intervals = dict[str, Pair] | list[Pair]


class _Table(BaseModel):
    """A table without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    title: ClassVar[str] = "the problem file"
    more_keys: ClassVar[Callable[[], Iterable[str]]] = tuple

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            raise ValueError(f"{cls.title} must be a table of keys, got {value!r}")
        known = [*cls.model_fields, *cls.more_keys()]
        for key in value:
            if key not in known:
                raise ValueError(f"unknown key {key!r} in {cls.title}{_hint(str(key), known, value.get('law'))}")
        return value


def _hint(key: str, known: list[str], law: Any = None) -> str:
    """The nearest key of a table, or how a law is named or sized, or the tables in which this one stands."""
    if "law" in known and law in LAWS and LAWS[law].levels:
        return f"; write {' or '.join(f'{level} = 0.1' for level in LAWS[law].levels)} for the size of {law!r} noise."
    if key in LAWS and "law" in known:
        levels = [f"{level} = 0.1" for level in LAWS[key].levels][:1]
        return "; write " + " and ".join([f'law = "{key}"', *levels]) + "."
    near, tables = nearest(key, known), [_Table]
    for table in tables:
        tables += table.__subclasses__()
    homes = dict.fromkeys(table.title for table in tables if key in table.model_fields and "[" in table.title)
    return near if "did you mean" in near or not homes else f"; it belongs into {' or '.join(homes)}."


class BallTable(_Table):
    """A ball: centre by name or for all states."""

    title: ClassVar[str] = "ball"
    center: Place
    radius: Number


class EllipsoidTable(_Table):
    """An ellipsoid {(x - center)' shape^-1 (x - center) <= 1}."""

    title: ClassVar[str] = "ellipsoid"
    center: Place
    shape: Matrix


class HalfSpaceTable(_Table):
    """A half-space {normal.x <= bound}."""

    title: ClassVar[str] = "halfspace"
    normal: Place
    bound: Number


class PolytopeTable(_Table):
    """A polytope {A x <= b}."""

    title: ClassVar[str] = "polytope"
    A: Matrix
    b: Vector


class PolygonTable(_Table):
    """A convex polygon by its corners, in two states: rows of two, or a list for each state."""

    title: ClassVar[str] = "polygon"
    vertices: dict[str, Vector] | Matrix


class DomainTable(_Table):
    """Where the model is meant."""

    title: ClassVar[str] = "[domain]"
    box: Intervals
    leaving: Literal["unsafe", "ends"] = "unsafe"


class _Choice(_Table):
    """A table with exactly one of some keys."""

    choices: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="after")
    def _one_choice(self) -> Any:
        given = [name for name in self.choices if getattr(self, name) is not None]
        if len(given) != 1:
            choices = ", ".join(self.choices)
            raise ValueError(f"{self.title} needs exactly one of {choices}; got {given or 'none'}")
        return self

    @property
    def chosen(self) -> str:
        """The key that is given."""
        return next(name for name in self.choices if getattr(self, name) is not None)


class GaussianTable(_Choice):
    """A random start: by its covariance, or by the standard deviations of states that are independent."""

    title: ClassVar[str] = "gaussian"
    choices: ClassVar[tuple[str, ...]] = ("std", "covariance")
    mean: Vector
    covariance: Matrix | None = None
    std: Number | Vector | None = None


class Start(_Choice):
    """Where the state starts."""

    title: ClassVar[str] = "[initial]"
    choices: ClassVar[tuple[str, ...]] = ("point", "box", "ball", "ellipsoid", "gaussian")
    point: Place | None = None
    box: Intervals | None = None
    ball: BallTable | None = None
    ellipsoid: EllipsoidTable | None = None
    gaussian: GaussianTable | None = None


_ONE, _SEVERAL = "[one]", "[several]"  # brackets: `explain` leaves them out
Starts = Annotated[
    Annotated[Start, Tag(_ONE)] | Annotated[list[Start], Field(min_length=1), Tag(_SEVERAL)],
    Discriminator(lambda value: _SEVERAL if isinstance(value, list) else _ONE),
]


class _Shapes(_Choice):
    """One region; ``center`` moves a box."""

    choices: ClassVar[tuple[str, ...]] = ("box", "ball", "ellipsoid", "halfspace", "polytope", "polygon")
    box: Intervals | None = None
    ball: BallTable | None = None
    ellipsoid: EllipsoidTable | None = None
    halfspace: HalfSpaceTable | None = None
    polytope: PolytopeTable | None = None
    polygon: PolygonTable | None = None
    center: Place | None = None

    @model_validator(mode="after")
    def _center_of_box(self) -> Any:
        if self.center is not None and self.box is None:
            raise ValueError("`center` beside the region moves a box; a ball has one of its own")
        return self


class Part(_Shapes):
    """One of the sets whose intersection is meant."""

    title: ClassVar[str] = "a part of all"


class Constraint(_Shapes):
    """One region to stay in, to avoid or to reach, or the intersection of several."""

    title: ClassVar[str] = "[[stay]], [[avoid]] or [[reach]]"
    choices: ClassVar[tuple[str, ...]] = (*_Shapes.choices, "all")
    all: Annotated[list[Part], Field(min_length=1)] | None = None
    during: Pair | None = None
    then: Literal["stay"] | None = None
    label: str | None = None


class Cost(_Table):
    """Weights of the states and of the inputs: diagonals or matrices."""

    title: ClassVar[str] = "[cost]"
    Q: Vector | Matrix
    R: Vector | Matrix


class FilterTable(_Table):
    """Coloured noise, or the lag of an input, as states behind those of the file."""

    title: ClassVar[str] = "[[noise.filter]]"
    state: str
    kind: str
    std: Number | None = None
    time: Number | None = None
    length: Number | None = None
    speed: Number | None = None
    axis: str | None = None
    density: Number | None = None
    low: Number | None = None
    high: Number | None = None
    input: str | None = None


class Noise(_Table):
    """CT: diffusion, a matrix or a table by state. DT: a law, its one level, its flags, and a matrix. Both: filters."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Matrix | Number | Vector | bool]
    title: ClassVar[str] = "[noise]"
    more_keys = staticmethod(lambda: [key for law in LAWS.values() for key in (*law.levels, *law.flags, *law.tables)])
    diffusion: Matrix | Number | Vector | dict[str, Number] | None = None
    law: str | None = None
    matrix: Matrix | Number | Vector | None = None
    filter: list[FilterTable] = []

    @property
    def white(self) -> bool:
        """Whether there is more than filters."""
        return bool(self.model_fields_set - {"filter"} or self.model_extra)


class RandomTable(_Table):
    """A constant that is drawn once: a law, its one level, and a mean."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Number | Vector]
    title: ClassVar[str] = "[random]"
    more_keys = staticmethod(lambda: [key for law in LAWS.values() for key in (*law.levels, *law.tables)])
    law: str
    mean: Number = 0.0


class Specification(_Table):
    """A problem file."""

    time: Literal["continuous", "discrete"]
    horizon: Number
    states: Annotated[list[str], Field(min_length=1)]
    dynamics: dict[str, Any]
    initial: Starts
    name: str = "problem"
    delta: Number = 1e-3
    units: dict[str, str] = {}
    parameters: dict[str, Annotated[float, BeforeValidator(_no_text)]] = {}
    inputs: dict[str, Pair] = {}
    disturbances: dict[str, Pair] = {}
    uncertain: dict[str, Pair] = {}
    random: dict[str, RandomTable] = {}
    networks: dict[str, str] = {}
    definitions: dict[str, Number] = {}
    plan: dict[str, Number] | None = None
    cost: Cost | None = None
    noise: Noise | None = None
    stay: list[Constraint] = []
    avoid: list[Constraint] = []
    reach: Annotated[list[Constraint], Field(max_length=1)] = []
    domain: DomainTable | None = None


def json_schema() -> dict[str, Any]:
    """The JSON schema of problem files, for editors; what values mean is checked when a file is read."""
    schema: dict[str, Any] = Specification.model_json_schema()
    for name, table in (("Noise", Noise), ("RandomTable", RandomTable)):
        schema["$defs"][name]["properties"] |= {key: {} for key in table.more_keys()}
        schema["$defs"][name]["additionalProperties"] = False
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "certbound problem"}


def explain(error: ValidationError) -> str:
    """The faults of a problem file in one line each, without the machinery."""
    lines: list[str] = []
    faults = [(_key(fault), fault) for fault in error.errors()]
    for key, fault in faults:
        if fault["type"] == "dict_type" and isinstance(fault["input"], list) and any(_within(key, faults)):
            continue  # a list may stand there too, and is what was meant: the others tell of it
        message, plain = fault["msg"].removeprefix("Value error, "), _words(key, fault, faults)
        if any(line.startswith((f"`{key}`", f"`{key}.")) for line in lines) and plain:
            if fault["type"] == "string_type":  # another alternative of what was refused already
                lines = [line.replace(f"`{key}` {_PLAIN['float_type']},", f"`{key}` {_EITHER},") for line in lines]
            continue
        if plain and not fault["type"].startswith(("missing", "too")):
            got = repr(fault["input"])
            plain += f", got {got if len(got) <= _LONGEST else got[:_LONGEST] + '...'}"
        plain = plain or (message if message.startswith("must ") else "")
        line = f"`{key}` {plain}" if plain else f"`{key}`: {message[:1].lower()}{message[1:]}"
        line = line if key else line.removeprefix("``: ")
        if line not in lines:
            lines.append(line)
    return ", and ".join(lines[:4]) + (", and more" if len(lines) > 4 else "") + "."


def _words(key: str, fault: Any, faults: list[tuple[str, Any]]) -> str:
    """What is wrong with a key, in the words of this program; "" where only the message says so."""
    kind, own = fault["type"], [other["type"] for one, other in faults if one == key]
    if kind == "list_type" and key in ("stay", "avoid", "reach"):
        return f"must be a list of tables; write [[{key}]]"
    if kind == "list_type" and key.split(".")[-2:-1] == ["box"]:
        return "must be a pair [low, high], of which there is one for each state"
    if kind == "dict_type" and "list_type" in own:
        return f"{_PLAIN['list_type']}, or a table, such as {{ x = 0 }}"
    return _PLAIN.get(kind, "").format(**fault.get("ctx", {}))


def _key(fault: Any) -> str:
    """Where a fault is, without pydantic's names of the alternatives of a union."""
    return ".".join(str(part) for part in fault["loc"] if not (isinstance(part, str) and _is_machinery(part)))


def _within(key: str, faults: list[tuple[str, Any]]) -> list[str]:
    """The faulty keys below one."""
    return [one for one, _ in faults if one.startswith(f"{key}.")]


_EITHER = "must be a number or an expression in quotes"
_LONGEST = 60
_PLAIN = {
    "missing": "is missing",
    "list_type": "must be a list, such as [0, 1]",
    "dict_type": "must be a table, such as {{ x = 0 }}",
    "mapping_type": "must be a table, such as {{ x = 0 }}",
    "too_short": "must have at least {min_length} entries, got {actual_length}",
    "too_long": "must have at most {max_length} entries, got {actual_length}",
    "float_parsing": "must be a number",
    "float_type": "must be a number",
    "string_type": "must be a text in quotes",
    "literal_error": "must be {expected}",
}
"""What pydantic's kinds of faults are in the words of this program."""


def _is_machinery(part: str) -> bool:
    """True for pydantic's names of the alternatives of a union."""
    return any(mark in part for mark in "[(") or part in ("float", "str")
