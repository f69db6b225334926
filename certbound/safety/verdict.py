"""The verdict: what is proved about a problem, made of the engines' answers."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from certbound.display import Shown, at_least_text, log10_text, name_text, rounded
from certbound.errors import CertificateError, SolverError
from certbound.problem.problem import Problem
from certbound.reach.sets import ReachTube
from certbound.safety.answers import (
    SPARED,
    Deviation,
    EngineAnswer,
    LimitBounds,
    bound_limits,
    is_at_most,
    is_more_than,
    limits_of,
    settled,
)
from certbound.safety.falsification import Violation
from certbound.watch import Watch

if TYPE_CHECKING:
    from certbound.safety.starts import SafeStarts
    from certbound.tubes.constants import Constants

_BADNESS = ("SAFE", "UNKNOWN", "UNSAFE", "UNSAFE_NOMINAL")
_ALIKE = 1e-9  # of logarithms: by so much bounds may cross from rounding
_TAKEN = ("margin", "time", "constraint", "tube", "reach", "constants", "deviation")  # of the best answer


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
    limits : Limits or None
        What would be SAFE, where that was asked for and the problem is not (`certbound.safety.limits`).
    seconds : mapping of str to float
        The time that every engine took, by its name.
    members : tuple of Verdict
        Where the start is a union, the verdict on every member; this one is the worst of them.
    reserves : dict
        What engines answered that only a certificate had to ask, by name: kept, so that none is asked twice.
    cells : tuple of Cell
        Where constants are drawn, the cells of their values over which the bounds were averaged.
    stated : Problem or None
        Where limits move, the problem in coordinates in which they rest, of which the answers speak: failing is at most
        as probable as there.
    """

    pictured: ClassVar[bool] = True

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
    limits: Any = None
    seconds: Mapping[str, float] = field(default_factory=dict, repr=False)
    members: tuple[Verdict, ...] = field(default=(), repr=False)
    reserves: dict[str, EngineAnswer] = field(default_factory=dict, repr=False)
    cells: tuple[Any, ...] = field(default=(), repr=False)
    stated: Problem | None = field(default=None, repr=False)

    @property
    def by_limit(self) -> tuple[LimitBounds, ...]:
        """Which limit is met first: bounds of the probability that it is one of those that a path breaks first.

        A limit is a face of a set to stay in, or an obstacle or a round set as a whole. From above the bounds hold for
        every start, from below for some. What is known of single limits is what the engine knows that proved them
        one by one (the linear response, from one cell of starts); elsewhere the bound of failing at all stands.
        """
        problem = self.problem
        if problem is None:
            return ()
        plain = problem.reach is None and not (self.members or problem.random)
        known = [one.by_limit for one in self.answers.values() if one.applicable and one.certified and one.by_limit]
        lower = self.log10_lower if problem.reach is None else None  # never to arrive is another way to fail
        return bound_limits(limits_of(problem), self.log10_delta, lower, uppers=known if plain else ())

    @property
    def worst(self) -> Verdict:
        """Where the start is a union, the verdict on its worst member as a problem of its own; else this one."""
        return max(self.members, key=lambda one: (_BADNESS.index(one.status), one.log10_delta), default=self)

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
        problem = self.stated or self.problem  # at time 0 coordinates that move are the states
        problem = problem.replace(initial=problem.starts[0]) if self.members else problem
        found = bound_safe_starts(problem, self.answers, delta)  # the set is the same for every member of a union
        return replace(found, problem=self.problem)

    def summary(self) -> str:
        """The verdict in one line."""
        asked = "" if self.problem is None else f"{name_text(self.problem.name)}: "
        target = "" if self.problem is None else f", asked {self.problem.delta!r}"
        failing = "leaving" if self.problem is None else self.problem.failing
        bounds = f"{log10_text(self.log10_delta)}{at_least_text(self.log10_lower)}"
        return f"{self.status}  {asked}P({failing}) <= {bounds}{target}"

    @property
    def caution(self) -> str:
        """What to add to a margin that is positive though nothing is decided; empty elsewhere."""
        if self.status != "UNKNOWN" or self.margin is None or self.margin <= 0:
            return ""
        return " (of what could be followed; it does not make the answer SAFE)"

    def rows(self) -> list[tuple[str, str]]:
        """Margin, method and reason."""
        where = "" if self.time is None else f" at t = {self.time:.4g}"
        found = []
        if self.margin is not None:
            words = f"{rounded(self.margin, up=False, digits=4)}{where}, {self.constraint}{self.caution}"
            found.append(("margin", words))
        found += [] if self.constants is None else [("constants", self.constants.summary())]
        return [*found, ("method", self.method), ("reason", self.reason)]

    def to_dict(self) -> dict[str, Any]:
        """What ``certbound verify --json`` prints, but for the seconds."""
        names = ("status", "log10_delta", "log10_lower", "margin", "time", "constraint", "reason", "method")
        found: dict[str, Any] = {name: getattr(self, name) for name in names}
        found["delta"] = None if self.problem is None else self.problem.delta
        found["constants"] = None if self.constants is None else self.constants.to_dict()
        found["by_limit"] = [asdict(one) for one in self.by_limit]
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


def is_safe(answer: EngineAnswer, problem: Problem) -> bool:
    return answer.applicable and answer.certified and is_at_most(min(answer.log10_delta, 0.0), problem.delta)


def stopped(name: str, phase: str) -> EngineAnswer:
    """The answer of an engine that had found nothing when its time was over."""
    at = f", at '{phase}'" if phase else ""
    return EngineAnswer(method=name, reason=f"its time was over before it had proved anything{at}.")


def verdict_of(problem: Problem, answers: Mapping[str, EngineAnswer], method: str = "auto") -> Verdict:
    """The best answer: certified before not, then the smaller probability, then the larger margin.

    Where a lower bound decides, method and reason are those of its engine. Without any answer, UNKNOWN by ``method``.
    """
    if not answers:
        answers = {method: EngineAnswer(applicable=False, method=method, reason="no engine came to an answer.")}

    def rank(name: str) -> tuple[bool, bool, float, float]:
        answer = answers[name]
        margin = -math.inf if answer.margin is None else answer.margin
        return (not answer.applicable, not answer.certified, answer.log10_delta, -margin)

    name = min(answers, key=rank)
    best = answers[name]
    level = settled(best.log10_delta, problem.delta)
    safe = is_safe(best, problem)
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
    proved = best.certified and not best.assumption
    if lower is not None and best.assumption and ((unsafe and safe) or lower > best.log10_delta + _ALIKE):
        return _without_assumptions(problem, answers, best, lower)
    if lower is not None and ((unsafe and safe) or (proved and lower > best.log10_delta + _ALIKE)):
        raise SolverError(
            f"two engines contradict each other: {name} proves at most 10^{level:.6g}, another one at least "
            f"10^{lower:.6g}; this is a defect of certbound, and nothing is answered."
        )
    shown = name  # who decides
    if unsafe and not safe:
        shown = next(one for one, answer in answers.items() if answer.applicable and answer.log10_lower == lower)
        reason = reason if shown == name else answers[shown].below or answers[shown].reason
    asked = {other: answer for other, answer in answers.items() if other != shown and answer.reason != SPARED}
    others = [f"By {one}: {_bounded(answer)}{_sentence(answer.reason)}" for one, answer in asked.items() if not safe]
    return Verdict(
        status="SAFE" if safe else "UNSAFE" if unsafe else "UNKNOWN",
        log10_delta=level,
        log10_lower=lower,
        reason=" ".join([_sentence(reason), *others]).strip(),
        method=answers[shown].method or shown,
        **{part: getattr(best, part) for part in _TAKEN},
        problem=problem,
        answers=MappingProxyType(dict(answers)),
    )


def _without_assumptions(
    problem: Problem, answers: Mapping[str, EngineAnswer], refuted: EngineAnswer, lower: float
) -> Verdict:
    """The verdict of what is proved, where that refutes what was assumed."""
    found = verdict_of(problem, {name: answer for name, answer in answers.items() if not answer.assumption})
    words = (
        f"What was assumed is refuted: with it ({refuted.assumption}) the probability would be at most "
        f"10^{refuted.log10_delta:.6g}, and at least 10^{lower:.6g} is proved without."
    )
    return replace(found, reason=f"{_sentence(found.reason)} {words}")


def best_lower(answers: Mapping[str, EngineAnswer]) -> float | None:
    """The largest proved lower bound of log10 of the probability, None where no engine has one."""
    found = [answer.log10_lower for answer in answers.values() if answer.applicable and answer.log10_lower is not None]
    return max(found, default=None)


def undone(watch: Watch, answered: Collection[str], left_at: Mapping[str, str], names: tuple[str, ...]) -> str:
    """What more time would be spent on: engines that were interrupted at some phase, and those not asked."""
    begun = [(name, left_at[name]) for name in names if name in left_at]
    rest = [f"{name} ({phase})" if phase else name for name, phase in begun]
    rest += [name for name in names if name not in answered]
    more = f" More time would go on with {', then '.join(rest)}." if rest else ""
    return f"The search was stopped after {watch.limit:g} s.{more}"


def unfinished(names: Sequence[str]) -> str:
    """What a search that ended before its time would go on with, or that nothing is left to be tried."""
    if not names:
        return "Nothing more can be tried: no engine proves more with more effort."
    return f"A time limit of your own lets {', '.join(names)} go on."


def _bounded(answer: EngineAnswer) -> str:
    """The bound that an engine proved, or that what it found bounds nothing; empty where its reason says why."""
    if not (answer.applicable and answer.certified):
        return ""
    if answer.log10_delta < 0:
        return f"P <= {log10_text(answer.log10_delta)}; "
    return "nothing below 1; " if answer.details is not None else ""


def _covered(answer: EngineAnswer) -> str:
    """For which disturbances an answer holds."""
    if answer.foresight:
        return "It holds for every disturbance in its set, even one that sees coming noise."
    return "It holds for every disturbance in its set that does not see coming noise."


def _sentence(text: str) -> str:
    """The text with a full stop at its end."""
    return text if not text or text.endswith((".", "!", "?")) else f"{text}."


def unsafe(problem: Problem, violation: Violation, method: str = "auto") -> Verdict:
    """UNSAFE_NOMINAL by a trajectory without noise, which is looked for before any method is asked."""
    when = f"t = {violation.time:.4g}" if problem.system.time == "continuous" else f"step {violation.time:g}"
    start = ", ".join(f"{value:.4g}" for value in violation.start)
    what = f"breaks '{violation.constraint.label}' at {when}, by {violation.depth:.3g}"
    if violation.constraint is problem.reach:
        what = f"does not '{violation.constraint.label}' by {when}, and misses it by {violation.depth:.3g}"
    elif problem.reach is not None:
        what = f"breaks '{violation.constraint.label}' at {when}, before it is in the target"
    return Verdict(
        status="UNSAFE_NOMINAL",
        log10_delta=0.0,
        margin=-violation.depth,
        time=violation.time,
        constraint=violation.constraint.label,
        reason=(
            f"without any noise the trajectory from ({start}) {what} (proved by intervals)."
        ),
        method="noise-free trajectory" if method == "auto" else f"noise-free trajectory, looked for before {method}",
        reach=violation.reach,
        problem=problem,
    )
