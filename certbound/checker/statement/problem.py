"""The problem that a certificate speaks of, read from its data."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, NamedTuple

from flint import arb, arb_mat

from certbound.checker.balls import diagonal, is_positive_definite, matrix
from certbound.checker.reading import Record, number, numbers, text
from certbound.checker.reading import entries as listed
from certbound.checker.report import STEP, Budget, Unproved, unlimited
from certbound.checker.statement.drawn import Drawn, read_drawn
from certbound.checker.statement.law_pieces import Piece
from certbound.checker.statement.laws import LAWS, Law
from certbound.checker.statement.regions import Constraint, read_constraint
from certbound.checker.statement.tapes import Hold, read_hold, read_tape
from certbound.checker.words import quoted, shortened
from certbound.errors import CertificateError
from certbound.problem.model import Tape, rounded_comparison

MOST_STATES = 400
MOST_STEPS = 100_000
_STAYING = "reach and stay"
_SLACK = arb(2) ** -39
"""How far a covariance may miss semidefiniteness where every variance is 1."""
_FIELDS = (
    "name", "time", "horizon", "delta", "states", "inputs", "disturbances", "dynamics", "plan", "disturbance_set",
    "noise", "initial", "constraints", "domain",
)  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Noise:
    """The noise: ``diffusion`` is the matrix g (CT) or G (DT), or a tape over (t, states).

    ``proxy`` is the covariance (or variance proxy) of w in discrete time, the identity in continuous time, None where a
    law has none. ``gaussian`` says whether it is exactly normal; ``uniform`` holds the halfwidths of independent
    uniform entries; ``entries`` the sizes of independent entries of one law, whose pieces at size 1 ``cut`` makes;
    ``halfwidth`` what no entry exceeds in size, None where nothing is known.
    """

    diffusion: arb_mat | Tape
    proxy: arb_mat | None
    gaussian: bool
    uniform: tuple[arb, ...] | None = None
    entries: tuple[arb, ...] = ()
    cut: Callable[[int], list[Piece]] | None = None
    halfwidth: tuple[arb, ...] | None = None
    budget: Budget = field(default_factory=unlimited)

    def constant(self) -> arb_mat:
        """A constant matrix; CertificateError of a tape."""
        if isinstance(self.diffusion, Tape):
            raise CertificateError("this proof needs a constant diffusion matrix.")
        return self.diffusion

    def covariance(self) -> arb_mat:
        """g g^T, or G S G^T; a constant matrix only."""
        matrix = self.constant()
        if self.proxy is None:
            raise Unproved("the law of the noise has no variance proxy")
        n, m = matrix.nrows(), matrix.ncols()
        self.budget.products(n, m, n + m)
        return matrix * self.proxy * matrix.transpose()


@dataclass(frozen=True, eq=False, kw_only=True)
class Initial:
    """The initial set: its box hull, and the covariance of a random start (None otherwise).

    ``kind`` and the exact data stay for proofs that use a ball or an ellipsoid itself; ``around`` says that the set is
    another one, inside the stated box.
    """

    kind: str
    low: tuple[arb, ...]
    high: tuple[arb, ...]
    covariance: arb_mat | None = None
    centre: tuple[float, ...] = ()
    radius: float = 0.0
    shape: arb_mat | None = None
    around: bool = False


class Change(NamedTuple):
    """Rows of a plan change from ``first`` to ``last``, exact times; meanwhile inputs lie in ``low`` to ``high``."""

    first: Fraction
    last: Fraction
    low: list[float]
    high: list[float]


@dataclass(frozen=True, eq=False, kw_only=True)
class Model:
    """A problem as the checker knows it; ``constraints`` ends with the domain where there is one."""

    name: str
    continuous: bool
    horizon: float
    delta: float
    dynamics: Tape
    plan: list[list[float]] | None
    disturbance: list[tuple[float, float]]
    noise: Noise
    initial: Initial
    constraints: tuple[Constraint, ...]
    domain: list[tuple[float | None, float | None]] | None
    states: tuple[str, ...] = field(default=())
    target: Constraint | None = None  # then a path fails that breaks a constraint before it is there, or never is
    stays: bool = False  # who is there must stay: a path fails too that breaks a constraint or leaves the target later
    unknown: tuple[str, ...] = ()  # disturbances that do not change: one that reacts to the state says nothing of them
    unit: str = ""  # of time, for humans
    ends: bool = False  # where the domain is left: that is no failure, and counting it as one bounds from above only
    drawn: tuple[Drawn, ...] = ()  # constants, over whose values the probability is an average
    hold: Hold | None = None  # then the inputs of the dynamics are what its law said last
    by_ito: bool = False  # derived by Ito's formula: no disturbance sees coming noise then
    changes: list[Change] | None = None  # of rows that do not change just at the ends of equal pieces; at 0, ..., T
    members: tuple[Initial, ...] = ()  # of a start that is a union; ``initial`` is then a box around them all
    budget: Budget = field(default_factory=unlimited)  # of the check that the problem was read for

    @property
    def dimension(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def steps(self) -> int:
        """Steps of a discrete-time horizon."""
        return int(self.horizon)

    def named_as(self, problem: Mapping[str, Any]) -> Model:
        """The same by the name and the labels of a problem's data, where both state the same problem.

        Nothing compares what is for humans, so that a file may say there what it likes.
        """
        labels = [shortened(str(row.get("label", ""))) for row in problem["constraints"]]
        own = [replace(constraint, label=label) for constraint, label in zip(self.constraints, labels)]
        target = self.target
        if target is not None:
            target = replace(target, label=shortened(str(problem["reach"].get("label", ""))))
        constraints = (*own, *self.constraints[len(own) :])  # the domain stands behind them
        return replace(self, name=str(problem.get("name", "")), constraints=constraints, target=target)


def _names(record: Record, name: str, least: int) -> tuple[str, ...]:
    found = tuple(text(item, record.at(name), 200) for item in record.items(name, least, MOST_STATES))
    if len(set(found)) != len(found):
        raise CertificateError(f"`{record.at(name)}` must hold different names.")
    return found


def read_model(value: object, budget: Budget, path: str = "problem") -> Model:
    """The problem in a certificate.

    CertificateError where a field is missing, has the wrong size, or makes no sense; Unproved where it is too large for
    the budget.
    """
    record = Record(value, path, _FIELDS, ("reach", "leaving", "unknown", "random", "units", "hold"))
    time = record["time"]
    if time not in ("continuous", "discrete"):
        raise CertificateError(f"`{path}.time` must be \"continuous\" or \"discrete\".")
    continuous = time == "continuous"
    horizon = math.inf if record["horizon"] is None else record.number("horizon")
    delta = record.number("delta")
    many = math.isfinite(horizon) and (horizon > MOST_STEPS or horizon != int(horizon))
    if not horizon > 0 or (not continuous and many):
        raise CertificateError(f"`{path}.horizon` must be positive (whole steps in discrete time), got {horizon:g}.")
    if not 0 < delta < 1:
        raise CertificateError(f"`{path}.delta` must lie in (0, 1), got {delta:g}.")
    states = _names(record, "states", 1)
    inputs, disturbances = _names(record, "inputs", 0), _names(record, "disturbances", 0)
    n = len(states)
    dynamics = read_tape(record["dynamics"], record.at("dynamics"), ("t", *states, *inputs, *disturbances), (n,))
    unknown = _names(record, "unknown", 1) if "unknown" in record.value else ()
    if not set(unknown) <= set(disturbances):
        raise CertificateError(f"`{path}.unknown` must hold names of disturbances.")
    if record["leaving"] not in (None, "ends"):
        raise CertificateError(f"`{path}.leaving` must be \"ends\" or absent.")
    domain = _ranges(record["domain"], record.at("domain"), n) if record["domain"] is not None else None
    if record["leaving"] is not None and domain is None:  # else the last limit would be taken for it
        raise CertificateError(f"`{path}.leaving` must be absent where there is no `domain`.")
    constraints = [
        read_constraint(item, f"{path}.constraints[{index}]", n, horizon, budget)
        for index, item in enumerate(record.items("constraints", 0, 1000))
    ]
    hold = read_hold(record, states, inputs)
    initial, members = _starts(record["initial"], path + ".initial", n, budget)
    if domain is not None:
        budget.hold(n * n // 4 + 1)
        constraints.append(Constraint.of_domain(domain))
    model = Model(
        name=record.text("name"), continuous=continuous, horizon=horizon, delta=delta, dynamics=dynamics,
        ends=record["leaving"] == "ends", states=states, hold=hold,
        plan=_plan(record, len(inputs) if hold is None else 0, continuous, horizon),
        disturbance=_disturbance(record, len(disturbances)), unknown=unknown,
        unit=_unit(record, continuous),
        drawn=read_drawn(record["random"], record.at("random"), disturbances),
        noise=_noise(record["noise"], path + ".noise", states, time, budget),
        initial=initial, members=members, target=_target(record, n, horizon, budget),
        constraints=tuple(constraints), domain=domain, budget=budget,
        stays="reach" in record.value and record["reach"].get("kind") == _STAYING,
    )
    _refuse_rounding(model, path)
    return model


def _refuse_rounding(model: Model, path: str) -> None:
    """CertificateError where a program that rounds takes another side of a comparison than exact arithmetic does."""
    steps = 0 if model.continuous else int(min(model.horizon, MOST_STEPS))
    given: list[tuple[object, int]] = [(model.dynamics, steps), (model.noise.diffusion, steps)]
    if model.hold is not None:
        given.append((model.hold.law, model.hold.count))
    sets = [*model.constraints, *([] if model.target is None else [model.target])]
    given += [(constraint.region.center, steps) for constraint in sets]
    for tape, samples in given:
        if not isinstance(tape, Tape):
            continue
        with model.budget.passing():
            found = rounded_comparison(tape, float(steps or model.horizon), samples, model.budget)
        if found is not None:
            raise CertificateError(f"`{path}` must not hold a comparison that rounding decides, got {found}.")


def _unit(record: Record, continuous: bool) -> str:
    """The unit of time, for the words of the claim, in quotes if it is the file's; of the others nothing is made."""
    units = record["units"] or {}
    if not isinstance(units, dict) or len(units) > MOST_STATES:
        raise CertificateError(f"`{record.at('units')}` must be texts by names.")
    own = {name: text(unit, record.at("units"), 20) for name, unit in units.items()}
    return quoted(own["time"]) if "time" in own else "s" if continuous else "steps"


def _plan(record: Record, inputs: int, continuous: bool, horizon: float) -> list[list[float]] | None:
    if not inputs:
        if record["plan"] is not None:
            raise CertificateError(f"`{record.at('plan')}` must be null: the model has no inputs left.")
        return None
    rows: list[list[float]] = record.array("plan", None, inputs)
    if not rows or math.isinf(horizon) or (not continuous and len(rows) != int(horizon)):
        raise CertificateError(f"`{record.at('plan')}` must have one row a step.")
    return rows


def _ranges(value: object, path: str, count: int) -> list[tuple[float | None, float | None]]:
    """Pairs [low, high]; null is an end at infinity."""
    result: list[tuple[float | None, float | None]] = []
    for index, pair in enumerate(listed(value, path, count, count)):
        ends = [None if end is None else number(end, f"{path}[{index}]") for end in listed(pair, path, 2, 2)]
        if ends[0] is not None and ends[1] is not None and ends[0] > ends[1]:
            raise CertificateError(f"`{path}[{index}]` must rise.")
        result.append((ends[0], ends[1]))
    return result


def _disturbance(record: Record, count: int) -> list[tuple[float, float]]:
    path = record.at("disturbance_set")
    result = []
    for low, high in _ranges(record["disturbance_set"], path, count):
        if low is None or high is None:
            raise CertificateError(f"`{path}` must be bounded.")
        result.append((low, high))
    return result


def _noise(value: object, path: str, states: tuple[str, ...], time: str, budget: Budget) -> Noise:
    if time == "continuous":
        record = Record(value, path, ("law", "diffusion"))
        if record["law"] != "wiener":
            raise CertificateError(f"`{path}.law` must be \"wiener\" in continuous time.")
        drives, m = _drives(record, "diffusion", states)
        return Noise(diffusion=drives, proxy=diagonal([arb(1)] * m), gaussian=True, budget=budget)
    name = text(value.get("law") if isinstance(value, dict) else None, f"{path}.law", 200)
    if name not in LAWS:
        raise CertificateError(f"`{path}.law` must be one of {', '.join(LAWS)}, got {quoted(name, 40)}.")
    law = LAWS[name]
    tables = ("tables",) if law.tables else ()
    record = Record(value, path, ("law", "level", "values", "matrix", *law.flags, *tables))
    drives, m = _drives(record, "matrix", states)
    proxy, sizes = _proxy(record, law, m, budget)
    cut, halfwidth = law.cut, sizes if law.bounded else None
    if cut is None:
        return Noise(diffusion=drives, proxy=proxy, gaussian=law.gaussian, halfwidth=halfwidth, budget=budget)
    found = [numbers(record["tables"][table], record.at(table), None) for table in law.tables]
    return Noise(
        diffusion=drives, proxy=proxy, gaussian=law.gaussian, uniform=sizes if law.uniform else None, entries=sizes,
        budget=budget, cut=lambda count: cut(count, found), halfwidth=halfwidth,
    )  # fmt: skip


def _drives(record: Record, name: str, states: tuple[str, ...]) -> tuple[arb_mat | Tape, int]:
    """What multiplies the noise, a matrix or a tape over t and the states, and its number of columns."""
    n = len(states)
    if not isinstance(record[name], dict):
        rows = _same_length(record.array(name, n, None), record.path)
        return matrix(rows), len(rows[0])
    inner = Record(record[name], record.at(name), ("columns", "nodes", "outputs"), ("networks",))
    m = inner.whole("columns", 1, MOST_STATES)
    tape = {key: entry for key, entry in inner.value.items() if key != "columns"}
    return read_tape(tape, inner.path, ("t", *states), (n, m)), m


def _same_length(rows: list[list[float]], path: str) -> list[list[float]]:
    if not 1 <= len(rows[0]) <= MOST_STATES or any(len(row) != len(rows[0]) for row in rows):
        raise CertificateError(f"`{path}` must hold a matrix of at most {MOST_STATES} columns.")
    return rows


def _proxy(record: Record, law: Law, m: int, budget: Budget) -> tuple[arb_mat | None, tuple[arb, ...]]:
    """The variance proxy that is proved of a law (None: it has none), and the sizes of entries that are independent."""
    level = record.text("level")
    if level not in law.levels:
        known = ", ".join(law.levels)
        raise CertificateError(f"`{record.at('level')}` must be one of {known}, got {quoted(level, 40)}.")
    if level == "covariance":
        found = _semidefinite(matrix(record.symmetric("values", m)), record.at("values"), budget)
        alone = all(found[i, j].is_zero() for i in range(m) for j in range(i))
        return found, tuple(found[i, i].sqrt() for i in range(m)) if alone else ()
    values = [arb(number(item, record.at("values"), least=0.0)) for item in record.items("values", m, m)]
    if level == "variance":
        return diagonal(values), tuple(value.sqrt() for value in values)
    if law.proxies is None:
        return None, tuple(values)
    return diagonal(law.proxies([value * value for value in values], record)), tuple(values)


def _semidefinite(a: arb_mat, path: str, budget: Budget) -> arb_mat:
    """A covariance that is positive semidefinite but for rounding; what is missing is added in proportion to variances.

    It is judged in units in which every variance is 1, so that a large one hides nothing of a small one.
    """
    n = a.nrows()
    budget.balls(6 * n * n)
    variances = [a[i, i] for i in range(n)]
    if not all(value >= 0 for value in variances):
        raise CertificateError(f"`{path}` must not have a negative variance.")
    kept = [i for i, value in enumerate(variances) if value > 0]
    if len(kept) < n and any(not a[i, j].is_zero() for i in range(n) if variances[i].is_zero() for j in range(n)):
        raise CertificateError(f"`{path}` must be positive semidefinite: what has no variance has no covariance.")
    scales = {i: 1 / variances[i].sqrt() for i in kept}
    scaled = matrix([[a[i, j] * scales[i] * scales[j] for j in kept] for i in kept])
    if is_positive_definite(scaled, budget):
        return a
    if not is_positive_definite(scaled + diagonal([_SLACK] * len(kept)), budget):
        raise CertificateError(f"`{path}` must be positive semidefinite.")
    return a + diagonal([value * _SLACK for value in variances])


def _target(record: Record, n: int, horizon: float, budget: Budget) -> Constraint | None:
    if "reach" not in record.value:
        return None
    return read_constraint(record["reach"], record.at("reach"), n, horizon, budget, ("reach", _STAYING))


def met_at(model: Model, time: float) -> Model:
    """The problem of keeping the constraints up to a time of the target's window, and of being in the target then.

    It is one way of not failing. Constraints that begin later are dropped, the others end with that time.

    CertificateError where the time is none of the window, the plan is an array over a longer time, or inputs that are
    held are not computed then.
    """
    target = model.target
    assert target is not None
    model.budget.spend(4 * STEP * (1 + len(model.constraints)))
    first, last = target.during or (0.0, model.horizon)
    if not (first <= time <= last and time > 0) or (not model.continuous and time != int(time)):
        raise CertificateError("`proof.time` must be a time of the target's window, after 0.")
    plan = model.plan
    if plan is not None and time != model.horizon:
        if model.continuous:
            raise CertificateError("`proof.time` must be the horizon where the plan is an array.")
        plan = plan[: int(time)]
    kept = []
    for constraint in model.constraints:
        begin, end = constraint.during or (0.0, model.horizon)
        if begin <= time:
            whole = constraint.during is None
            kept.append(replace(constraint, during=None if whole else (begin, min(end, time))))
    due = replace(target, during=(time, time))
    number = len(kept) if model.domain is None else len(kept) - 1  # the domain stands last
    constraints = (*kept[:number], due, *kept[number:])
    hold = None if model.hold is None else model.hold.until(time, model.horizon)
    return replace(model, horizon=time, plan=plan, hold=hold, target=None, constraints=constraints)


def _starts(value: object, path: str, n: int, budget: Budget) -> tuple[Initial, tuple[Initial, ...]]:
    """The start, and the members of one that is a union."""
    if not isinstance(value, dict) or value.get("kind") != "union":
        return _initial(value, path, n, budget), ()
    rows = Record(value, path, ("kind", "members")).items("members", 2, 1000)
    budget.balls(2 * n * len(rows))
    members = tuple(_initial(row, f"{path}.members[{index}]", n, budget) for index, row in enumerate(rows))
    if any(member.covariance is not None for member in members):
        raise CertificateError(f"`{path}.members` must be sets, not random starts.")
    low = tuple(min(member.low[j].lower() for member in members) for j in range(n))
    high = tuple(max(member.high[j].upper() for member in members) for j in range(n))
    return Initial(kind="box", low=low, high=high), members


def _initial(value: object, path: str, n: int, budget: Budget) -> Initial:
    kinds = {
        "box": ("low", "high"), "ball": ("center", "radius"), "ellipsoid": ("center", "shape"),
        "gaussian": ("mean", "covariance"),
    }  # fmt: skip
    kind = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in kinds:
        raise CertificateError(f"`{path}.kind` must be one of {', '.join(kinds)}.")
    record = Record(value, path, ("kind", *kinds[kind]), ("around",) if kind == "box" else ())
    if kind == "box":
        low, high = record.array("low", n), record.array("high", n)
        if any(a > b for a, b in zip(low, high)):
            raise CertificateError(f"`{path}.low` must not exceed `high`.")
        around = record["around"] is not None and record.flag("around")
        return Initial(kind=kind, low=tuple(map(arb, low)), high=tuple(map(arb, high)), around=around)
    centre = record.array("mean" if kind == "gaussian" else "center", n)
    points = [arb(x) for x in centre]
    if kind == "gaussian":
        covariance = _semidefinite(matrix(record.symmetric("covariance", n)), record.at("covariance"), budget)
        return Initial(kind=kind, low=tuple(points), high=tuple(points), covariance=covariance, centre=tuple(centre))
    if kind == "ball":
        radius = record.number("radius", least=0.0)
        reach, shape = [arb(radius)] * n, None
    else:
        rows = record.symmetric("shape", n)
        if not is_positive_definite(matrix(rows), budget):
            raise CertificateError(f"`{path}.shape` must be positive definite.")
        reach, shape, radius = [arb(rows[i][i]).sqrt() for i in range(n)], matrix(rows), 0.0
    return Initial(
        kind=kind, low=tuple(p - r for p, r in zip(points, reach)), high=tuple(p + r for p, r in zip(points, reach)),
        centre=tuple(centre), radius=radius, shape=shape,
    )
