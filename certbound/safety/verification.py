"""``verify_safety``: try the engines that fit, keep the smallest certified probability, answer with a verdict."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from certbound.display import Shown, at_least_text, log10_text, name_text, rounded
from certbound.errors import CertificateError, EngineError, SolverError, contained
from certbound.problem.problem import Problem
from certbound.reach.nominal import initial_cells
from certbound.reach.sets import ReachTube
from certbound.safety.answers import Deviation, EngineAnswer, Request, is_at_most, is_more_than, settled
from certbound.safety.falsification import Violation, find_violation
from certbound.safety.portfolio import ENGINES, engine_named

if TYPE_CHECKING:
    from certbound.safety.starts import SafeStarts
    from certbound.tubes.constants import Constants

_log = logging.getLogger(__name__)


_TAKEN = ("margin", "time", "constraint", "tube", "reach", "constants", "deviation")  # of the best answer
_LARGE = 60  # states beyond which no other engine is asked once one has proved SAFE

@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Verdict(Shown):
    """What is proved about a problem.

    Parameters
    ----------
    status : {"SAFE", "UNSAFE", "UNSAFE_NOMINAL", "UNKNOWN"}
        SAFE: the probability of breaking a constraint within the horizon is at most delta, proved.
        UNSAFE: that probability exceeds delta from some start (of a normal start: in the mean), proved.
        UNSAFE_NOMINAL: a noise-free trajectory from the initial set provably leaves the safe set.
    log10_delta : float
        log10 of the smallest bound on that probability that was proved: finite, at most 0 (0: nothing was). SAFE
        exactly when it is at most log10 of the problem's delta.
    margin : float or None
        Least Euclidean distance to breaking a constraint that the tube at delta leaves; negative: it does not fit.
    time, constraint
        Where the margin is least, and for which constraint.
    reason : str
        Why, in words; the disturbances that the bound covers, and assumptions (stated constants), are named here.
    method : str
        What proved it.
    tube, reach, constants
        The stochastic tube at delta, the noise-free reach tube, the constants (each None where there is none).
    deviation : Deviation or None
        The stochastic deviation at delta as plain bounds per piece.
    problem : Problem or None
        What the verdict is about.
    answers : mapping
        What every engine answered, by name.
    log10_lower : float or None
        log10 of a proved lower bound of the probability from the worst start, under the worst disturbance; None where
        no engine has one.
    """

    status: str
    log10_delta: float
    margin: float | None
    time: float | None
    constraint: str | None
    reason: str
    method: str
    tube: Any = None
    reach: ReachTube | None = None
    constants: Constants | None = None
    deviation: Deviation | None = None
    problem: Problem | None = field(default=None, repr=False)
    answers: Mapping[str, EngineAnswer] = field(default_factory=dict, repr=False)
    log10_lower: float | None = None

    @cached_property
    def certificate(self) -> dict[str, Any] | None:
        """The proof as data, made when first asked for; None where no probability was bounded.

        `certificate_text` says why in that case.
        """
        if self.problem is None:
            return None
        from certbound.safety.certificate import certificate_data

        try:
            return certificate_data(self.problem, self)
        except CertificateError:
            return None

    def certificate_text(self, problem: Problem, *, attempt: int = 0) -> str:
        """The proof as the text of a JSON file (docs/certificate.md); a later ``attempt`` spends more effort on it.

        Raises
        ------
        CertificateError
            If no probability was bounded that a certificate could state.
        """
        from certbound.safety.certificate import certificate_text

        return certificate_text(problem, self, attempt=attempt)

    def safe_starts(self, delta: float | None = None) -> SafeStarts:
        """The largest set of starts that a value function proves safe: P(a constraint is broken) <= delta from each.

        Parameters
        ----------
        delta : float, optional
            The problem's own where it is left out.

        Returns
        -------
        SafeStarts
            With ``contains``, ``bound``, ``measure``, ``boxes``. The proof over the whole safe set is made now, in
            about the time of the verdict.

        Raises
        ------
        InfeasibleError
            If the verdict rests on no value function (``method="values"`` gives one), or none applies.
        ValueError
            If ``delta`` does not lie in (0, 1), or the verdict has no problem.
        """
        from certbound.safety.starts import bound_safe_starts

        if self.problem is None:
            raise ValueError("`problem` must be set for safe starts; verify_safety sets it.")
        return bound_safe_starts(self.problem, self.answers, delta)

    def summary(self) -> str:
        """The verdict in one line."""
        asked = "" if self.problem is None else f"{name_text(self.problem.name)}: "
        target = "" if self.problem is None else f", asked {self.problem.delta!r}"
        bounds = f"{log10_text(self.log10_delta)}{at_least_text(self.log10_lower)}"
        return f"{self.status}  {asked}P(leaving) <= {bounds}{target}"

    def rows(self) -> list[tuple[str, str]]:
        """Margin, method and reason."""
        where = "" if self.time is None else f" at t = {self.time:.4g}"
        found = []
        if self.margin is not None:
            found.append(("margin", f"{rounded(self.margin, up=False, digits=4)}{where}, {self.constraint}"))
        found += [] if self.constants is None else [("constants", self.constants.summary())]
        return [*found, ("method", self.method), ("reason", self.reason)]

    def to_dict(self) -> dict[str, Any]:
        """What ``certbound verify --json`` prints, but for the seconds."""
        names = ("status", "log10_delta", "log10_lower", "margin", "time", "constraint", "reason", "method")
        found: dict[str, Any] = {name: getattr(self, name) for name in names}
        found["delta"] = None if self.problem is None else self.problem.delta
        found["constants"] = None if self.constants is None else self.constants.to_dict()
        return found | {"tube": None if self.deviation is None else self.deviation.to_dict()}

    def to_columns(self) -> dict[str, Any]:
        """The stochastic deviation per piece of time, under the states' names, as ``pandas.DataFrame`` takes it.

        Raises
        ------
        ValueError
            If no tube could be certified.
        """
        if self.deviation is None:
            raise ValueError(f"the verdict has no tube to tabulate; {self.reason}")
        return self.deviation.to_columns(None if self.problem is None else self.problem.system.states)

    def __bool__(self) -> bool:
        raise TypeError("a Verdict is neither true nor false; compare `.status` with 'SAFE'.")


def verify_safety(
    problem: Problem, method: str = "auto", cells: int | None = None, *, constants: Constants | None = None
) -> Verdict:
    """Prove that a problem's constraints are broken with probability at most delta, or say why not.

    Proves, for SAFE: P(some constraint is broken at some time of its window) <= 10**log10_delta <= delta, for every
    start in the initial set and every disturbance that does not see coming noise (by the linear response with
    additive noise: also those that do); ``reason`` says which. Leaving the model's domain counts as breaking.

    Parameters
    ----------
    problem : Problem
        With a plan if its system has inputs.
    method : str
        "auto" runs every engine that fits and keeps the smallest probability (those in reserve only where the others
        have not proved SAFE); the name of an engine (``ENGINES`` of `certbound.safety.portfolio`), such as "linear" or
        "values", runs that one; a tube method such as "kummer" or "thm3" runs the constants engine with that tube.
    cells : int, optional
        Parts along each side of the initial set.
    constants : Constants, optional
        Used instead of certified ones by the constants engine, and named in ``reason`` as an assumption unless they
        are certified and were proved again of this problem.

    Returns
    -------
    Verdict

    Raises
    ------
    ValueError
        If the system has inputs and no plan, the method is unknown, or ``cells`` or the constants do not fit. What
        fails afterwards is an engine: it answers that it does not apply, and why.

    Source: Thms K2, K4, K5, K7 of theory.

    Examples
    --------
    >>> import numpy as np, certbound as cb
    >>> system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=0.05 * np.eye(2))
    >>> problem = cb.Problem(system, initial=[0.2, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2)
    >>> verify_safety(problem, method="constants").status
    'SAFE'
    """
    names, inner = _chosen(method), "auto" if method in ENGINES else method
    request = Request(method=inner, cells=cells, constants=constants, thorough=method != "auto")
    _checked(problem, request)
    violation = _violation(problem)
    if violation is not None:
        return _unsafe(problem, violation)
    answers: dict[str, EngineAnswer] = {}
    for name in names:
        quick = any(_is_safe(answer, problem) or answer.conclusive for answer in answers.values())
        if quick and problem.system.dimension > _LARGE:
            continue
        answers[name] = _asked(name, problem, replace(request, quick=quick))
    if method == "auto" and cells is None and not any(_is_safe(answer, problem) for answer in answers.values()):
        for name in (name for name, row in ENGINES.items() if row.again):
            first = answers[name]
            if first.applicable and not first.conclusive:
                second = _asked(name, problem, Request(before=first.details))
                if second.applicable:
                    answers[name] = min(first, second, key=lambda answer: answer.log10_delta)
    return _verdict(problem, answers)


def _asked(name: str, problem: Problem, request: Request) -> EngineAnswer:
    """What an engine answers; where it fails, that it does not apply, and why."""
    try:
        with contained(name):
            return ENGINES[name].prove(problem, request)
    except EngineError as error:
        return EngineAnswer(applicable=False, reason=str(error), method=name)


def _violation(problem: Problem) -> Violation | None:
    """A proved violation of the noise-free model; None where there is none, or where the search for one failed."""
    try:
        with contained("noise-free"):
            return find_violation(problem)
    except EngineError as error:
        _log.info("no noise-free trajectory was followed: %s", error)
        return None


def _checked(problem: Problem, request: Request) -> None:
    """Refuse what is wrong with a request before any engine runs: from then on whatever fails is an engine.

    ValueError where the system has inputs and no plan, ``cells`` cannot be, or the method or the constants do not fit
    it.
    """
    from certbound.tubes.paper import check_method

    initial_cells(problem, request.cells)
    _ = problem.closed_loop
    continuous, n = problem.system.time == "continuous", problem.system.dimension
    check_method(request.method, continuous=continuous, dimension=n)
    constants = request.constants
    if constants is None:
        return
    if constants.continuous != continuous:
        raise ValueError(f"`constants` must state a {'rate' if continuous else 'gain'}, as the problem's time asks.")
    if constants.times is not None and constants.times[-1] < problem.horizon:
        raise ValueError(f"`constants` must reach the horizon {problem.horizon:g}, got {constants.times[-1]:g}.")
    from certbound.constants.stated import refuse_contradiction

    refuse_contradiction(problem, constants)


def _is_safe(answer: EngineAnswer, problem: Problem) -> bool:
    return answer.applicable and answer.certified and is_at_most(min(answer.log10_delta, 0.0), problem.delta)


def _chosen(method: str) -> tuple[str, ...]:
    if method == "auto":
        return tuple(ENGINES)
    name = engine_named(method)
    if name is not None:
        return (name,)
    from certbound.tubes.tuning import METHODS

    known = ", ".join(["auto", *ENGINES, *(name for name in METHODS if name != "auto")])
    raise ValueError(f"`method` must be one of {known}, got {method!r}.")


def _verdict(problem: Problem, answers: Mapping[str, EngineAnswer]) -> Verdict:
    """The best answer: certified before not, then the smaller probability, then the larger margin."""

    def rank(name: str) -> tuple[bool, bool, float, float]:
        answer = answers[name]
        margin = -math.inf if answer.margin is None else answer.margin
        return (not answer.applicable, not answer.certified, answer.log10_delta, -margin)

    name = min(answers, key=rank)
    best = answers[name]
    level = settled(best.log10_delta, problem.delta)
    safe = _is_safe(best, problem)
    reason = best.reason
    if not best.certified:
        reason = (
            f"{best.method} bounds the deviation at one time, not along the whole trajectory: it says that the "
            f"nominal {'fits' if level <= math.log10(problem.delta) else 'does not fit'}, and proves no more. {reason}"
        )
        level = 0.0
    if best.applicable and level < 0 and problem.system.disturbance is not None:
        reason = f"{_sentence(reason)} {_covered(best)}"
    if best.assumption:
        reason = f"{_sentence(reason)} Assumption: {best.assumption}."
    lower = best_lower(answers)
    unsafe = lower is not None and is_more_than(lower, problem.delta)
    if unsafe and safe:
        raise SolverError(
            f"two engines contradict each other: {name} proves at most 10^{level:.6g}, another one at least "
            f"10^{lower:.6g}; this is a defect of certbound, and nothing is answered."
        )
    others = [f"By {other}: {_sentence(answers[other].reason)}" for other in answers if other != name and not safe]
    return Verdict(
        status="SAFE" if safe else "UNSAFE" if unsafe else "UNKNOWN",
        log10_delta=level,
        log10_lower=lower,
        reason=" ".join([_sentence(reason), *others]).strip(),
        method=best.method or name,
        **{part: getattr(best, part) for part in _TAKEN},
        problem=problem,
        answers=MappingProxyType(dict(answers)),
    )


def best_lower(answers: Mapping[str, EngineAnswer]) -> float | None:
    """The largest proved lower bound of log10 of the probability, None where no engine has one."""
    found = [answer.log10_lower for answer in answers.values() if answer.applicable and answer.log10_lower is not None]
    return max(found, default=None)


def _covered(answer: EngineAnswer) -> str:
    """For which disturbances an answer holds."""
    if answer.foresight:
        return "It holds for every disturbance in its set, even one that sees coming noise."
    return "It holds for every disturbance in its set that does not see coming noise."


def _sentence(text: str) -> str:
    """The text with a full stop at its end."""
    return text if not text or text.endswith((".", "!", "?")) else f"{text}."


def _unsafe(problem: Problem, violation: Violation) -> Verdict:
    when = f"t = {violation.time:.4g}" if problem.system.time == "continuous" else f"step {violation.time:g}"
    start = ", ".join(f"{value:.4g}" for value in violation.start)
    return Verdict(
        status="UNSAFE_NOMINAL",
        log10_delta=0.0,
        margin=-violation.depth,
        time=violation.time,
        constraint=violation.constraint.label,
        reason=(
            f"without any noise the trajectory from ({start}) breaks '{violation.constraint.label}' at {when}, by "
            f"{violation.depth:.3g} (proved by intervals)."
        ),
        method="noise-free trajectory",
        reach=violation.reach,
        problem=problem,
    )
