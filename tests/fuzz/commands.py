"""Every command on one problem, each in a function of its own; what went wrong is a finding, not an exception."""

from __future__ import annotations

import contextlib
import io
import json
import math
import re
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import certbound as cb
from certbound.errors import EngineError
from tests.fuzz import oracle
from tests.fuzz.drafts import Draft

__all__ = ["BUDGETS", "Finding", "Run"]

BUDGETS = {
    "verify": 30.0, "units": 30.0, "certificate": 30.0, "check": 30.0, "derive": 20.0, "tune": 10.0, "reach": 20.0,
    "simulate": 20.0, "file": 5.0, "cli": 30.0,
}  # fmt: skip
"""Seconds of processor time that an answer may take; a slower one is a finding."""
PATIENCE = 10.0
"""Limit of time that verify is given, seconds: without one, every engine that applies is asked in full."""
PATHS = 10_000
FINER = (4, 16, 64, 256)
"""Refinements of the time step that must confirm a contradiction in continuous time."""
MARGIN = 1e-9
"""Share by which log10 of a probability may differ from its limit by rounding."""

DOCUMENTED: dict[str, tuple[type[Exception], ...]] = {
    "verify": (),
    "certificate": (cb.CertificateError,),
    "derive": (cb.EnclosureError, cb.InfeasibleError),
    "tune": (),
    "reach": (cb.EnclosureError, cb.InfeasibleError, EngineError),
    "simulate": (),
}
"""Errors that are answers: what was asked for does not exist, and the message says why."""
_SAID = {
    "verify": ("nominal", "outlives"),
    "derive": ("unbounded",),
    "simulate": ("cannot be simulated", "not finite"),
    "file": ("does not exist in problem files",),
}
"""Words of a plain ValueError that its docstring announces."""

_TOO_COARSE = "steps are too coarse for the fastest modes of this model"
"""Of the warning of `simulate_exits` where too few steps are asked for."""


@dataclass(frozen=True)
class Finding:
    """Something that must not happen: of which command, of which kind, with a signature that groups like ones."""

    command: str
    kind: str
    signature: str
    message: str = ""


@dataclass
class Run:
    """One problem on its way through the commands: findings, answers and seconds by command."""

    draft: Draft
    problem: cb.Problem
    findings: list[Finding] = field(default_factory=list)
    answers: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    verdict: Any = None

    def report(self, command: str, kind: str, signature: str, message: str = "") -> None:
        """Note a finding, once."""
        if any((f.command, f.kind, f.signature) == (command, kind, signature) for f in self.findings):
            return
        self.findings.append(Finding(command, kind, signature, message[:2000]))

    def rng(self, purpose: int) -> np.random.Generator:
        """Random numbers of a purpose, the same for the same seed."""
        return np.random.default_rng([self.draft.seed, 1000 + purpose])

    def to_dict(self) -> dict[str, Any]:
        """The record that is written."""
        draft = self.draft
        return {
            "seed": draft.seed, "family": draft.family, "features": sorted(draft.features), "answers": self.answers,
            "seconds": {name: round(value, 3) for name, value in self.seconds.items()}, "facts": self.facts,
            "findings": [asdict(finding) for finding in self.findings],
        }  # fmt: skip

    # ---- the commands ----------------------------------------------------------------------------------------

    def verify(self) -> None:
        """A verdict, whatever the problem."""
        self.verdict = self._attempt("verify", lambda: cb.verify_safety(self.problem, time_limit=PATIENCE))
        if self.verdict is None:
            return
        verdict = self.verdict
        self.answers["verify"] = verdict.status
        self.facts |= {"log10_delta": verdict.log10_delta, "delta": self.draft.delta, "method": verdict.method}
        for name, answer in verdict.answers.items():
            if "engine failed" in answer.reason:
                self.report("verify", "engine failed", f"{name}: {_plain(answer.reason)}", answer.reason)
        level = verdict.log10_delta
        if not (
            math.isfinite(level) and level <= 0 and verdict.status in ("SAFE", "UNSAFE", "UNSAFE_NOMINAL", "UNKNOWN")
        ):
            self.report("verify", "malformed", f"status {verdict.status}, log10_delta {level}")
        if (verdict.status == "SAFE") != (level <= math.log10(self.draft.delta)) and verdict.status in (
            "SAFE",
            "UNKNOWN",
        ):
            self.report("verify", "malformed", "SAFE is not log10_delta <= log10(delta)", f"{verdict.status} {level}")

    def units(self, name: str, factor: float, time_factor: float = 1.0) -> None:
        """The same problem with other units: the same verdict."""
        if self.verdict is None:
            return
        units = self.draft.units.times(factor, time_factor)
        found = self._attempt(
            "units", lambda: cb.verify_safety(self.draft.problem(units), time_limit=PATIENCE), documented="verify"
        )
        if found is None:
            return
        first, second = self.verdict, found
        if first.status != second.status:
            target = math.log10(self.draft.delta)
            near = all(abs(v.log10_delta - target) <= 0.02 * abs(target) + 0.02 for v in (first, second))
            gap = f"{first.log10_delta:.6g} -> {second.log10_delta:.6g}, asked {target:.6g}"
            kind = "close call" if near else "units"
            self.report("units", kind, f"{first.status} -> {second.status} ({name})", f"{gap}; {second.reason[:300]}")
        elif abs(first.log10_delta - second.log10_delta) > 0.02 * abs(first.log10_delta) + 0.02:
            gap = f"{first.log10_delta:.6g} -> {second.log10_delta:.6g}"
            self.facts.setdefault("levels in other units", []).append(f"{name}: {gap}")

    def certificate(self) -> None:
        """Of a verdict that bounds a probability: a certificate, which the checker accepts and which claims as much."""
        if self.verdict is None or self.verdict.log10_delta >= 0:
            return
        from certbound.checker import check_data, parse
        from certbound.cli.commands.check import proved_certificate
        from certbound.safety.certificate import problem_data

        made = self._attempt("certificate", lambda: proved_certificate(self.problem, self.verdict))
        text = getattr(made, "text", made)
        if not isinstance(text, str) or not text:
            if self.verdict.status == "SAFE" and made is None and self.answers["certificate"].startswith("refused"):
                self.report("certificate", "none", _plain(self.answers["certificate"]), self.answers["certificate"])
            return
        report = self._attempt("check", lambda: check_data(parse(text), problem_data(self.problem)))
        if report is None:
            return
        self.answers["check"] = "valid" if report.valid else "not proved"
        claimed = float.fromhex(json.loads(text)["claim"]["log10_delta"])
        self.facts["claimed"] = claimed
        if not report.valid:
            self.report("check", "rejected", _plain(report.reason), report.reason)
        if self.verdict.status == "SAFE" and claimed > math.log10(self.draft.delta) * (1 - MARGIN):
            self.report("certificate", "weaker", "the certificate of SAFE claims more than delta", f"{claimed}")

    def derive(self) -> Any:
        """Constants, and one metric a constraint."""
        constants = self._attempt("derive", lambda: cb.bound_constants(self.problem))
        if constants is not None:
            self._attempt("derive", lambda: cb.bound_metrics(self.problem))
        return constants

    def tune(self, constants: Any) -> None:
        """Every tube method that applies; then: do the paths stay in the best one?"""
        if constants is None:
            return
        from certbound.tubes.tuning import METHODS, SLOW

        def all_methods() -> Any:
            options = {"horizon": float(self.problem.horizon), "delta": self.draft.delta}
            best = cb.tune_tube(constants, **options)
            for method in METHODS:
                if method not in SLOW and method != "auto":
                    with contextlib.suppress(ValueError):  # its hypotheses do not hold
                        cb.tune_tube(constants, method=method, **options)
            return best

        tube = self._attempt("tune", all_methods)
        if tube is not None and constants.certified and self.draft.domain is None:
            self._compare("tune", self.draft.delta, lambda steps: self._outside_tube(tube, constants, steps))

    def reach(self) -> None:
        """Reach tubes with noise and without; then: do the paths stay in them?"""
        for noise in (True, False):
            tube = self._attempt("reach", lambda noise=noise: cb.bound_reach(self.problem, noise=noise))
            if tube is not None:
                level = 10.0**tube.log10_delta if noise else 0.0
                self._compare(
                    "reach", level, lambda steps, tube=tube, noise=noise: self._outside_reach(tube, noise, steps)
                )

    def simulate(self) -> None:
        """Exits by certbound's simulation and by the oracle's: neither may contradict what is certified."""
        rng = self.rng(1)
        known = self.draft.noise is None or self.draft.noise.law != "subgaussian"
        found = self._attempt(
            "simulate", lambda: cb.simulate_exits(self.problem, paths=PATHS, rng=rng, steps=self._steps())
        )
        if found is not None and not known:
            self.report("simulate", "malformed", "noise without a law was simulated")
        worst, policy = oracle.worst_case(self.draft, rng, paths=PATHS)
        self.facts |= {"exits": worst.exits, "lower": worst.lower}
        if found is not None:
            self.facts["exits by certbound"] = found.exits
        if self.verdict is None:
            return
        level = 10.0**self.verdict.log10_delta
        if worst.lower > 0 and level < 1:
            self.facts["ratio"] = level / worst.lower
            self.facts["ratio to estimate"] = level / (worst.exits / worst.paths)

        def again(steps: int) -> tuple[int, int]:
            count = oracle.recount(self.draft, worst.start, policy, self.rng(2), paths=PATHS, steps=steps)
            return count.exits, count.paths

        def by_certbound(steps: int) -> tuple[int, int]:
            options = {"steps": steps} if self.draft.continuous else {}
            counts = cb.simulate_exits(self.problem, paths=PATHS, rng=self.rng(3), halve=False, **options)
            return counts.exits, counts.paths

        if worst.lower > level:
            self._compare("simulate", level, again)
        if found is not None and oracle.lower_limit(found.exits, found.paths) > level:
            self._compare("simulate", level, by_certbound)
        if self.verdict.log10_lower is not None and self._truth_from_above:
            self._compare("simulate", 10.0**self.verdict.log10_lower, again, below=True)
        if self.verdict.status == "UNSAFE_NOMINAL":
            self._leaves_without_noise()

    @property
    def _truth_from_above(self) -> bool:
        """Whether no other start, disturbance or law that is allowed fails more often than the simulated one."""
        known = self.draft.noise is None or self.draft.noise.law not in ("bounded", "subgaussian")
        start = self.problem.initial
        return known and self.draft.disturbance is None and (start.random or start.is_point)

    def file(self) -> None:
        """Saved and loaded again: the same problem."""

        def there_and_back() -> cb.Problem:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "problem.toml"
                cb.save(self.problem.replace(name="again"), path)
                return cb.load(path)

        found = self._attempt("file", there_and_back)
        if found is not None:
            difference = self._attempt("file", lambda: self._difference(found))
            if difference:
                self.report("file", "changed", _plain(difference), difference)

    def _difference(self, other: cb.Problem) -> str:
        """What differs from the problem: model, noise, start by their data, constraints by where they hold."""
        from certbound.checker.statement.comparison import first_difference
        from certbound.safety.certificate import problem_data

        mine, theirs = ({**problem_data(p), "constraints": []} for p in (self.problem, other))
        difference = first_difference(mine, theirs)
        if difference:
            return difference
        ordered = sorted(self.problem.safe, key=lambda constraint: isinstance(constraint, cb.Outside))
        points = (
            oracle.starts(self.draft, self.rng(7), 200) * self.rng(8).uniform(-3, 3, (200, 1)) * self.draft.units.state
        )
        for first, second in zip(ordered, other.safe, strict=True):
            if (first.during, first.label) != (second.during, second.label):
                return f"constraint {first.label}, {first.during} became {second.label}, {second.during}"
            for t in (0.0, 0.7 * float(self.problem.horizon)):
                if np.any(first.satisfied(points, t) != second.satisfied(points, t)):
                    return f"constraint {first.label} holds elsewhere"
        return ""

    def command_line(self, limit: float = 5.0) -> None:
        """``verify --json --time-limit`` and ``derive`` on the saved file: documented exit codes, one JSON object."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "problem.toml"
            try:
                cb.save(self.problem, path)
            except ValueError:
                return
            limited = ["--json", "--time-limit", str(limit)]
            files = {"--certificate": "proof.json", "--plot": "plot.png", "--report": "report.html"}
            written = [word for option, name in files.items() for word in (option, str(Path(folder) / name))]
            self._command(["verify", str(path), *limited, *written], (0, 1), limit)
            self._command(["derive", str(path), *limited], (0, 2, 3), limit)
            self._command(["tune", str(path), *limited, "--plot", str(Path(folder) / "tubes.png")], (0, 2, 3), limit)
            self._command(["simulate", str(path), "--json", "--paths", "1000", "--seed", "1"], (0, 2), limit)

    def _command(self, words: list[str], codes: tuple[int, ...], limit: float) -> None:
        from certbound.cli.app import run

        out, err = io.StringIO(), io.StringIO()
        started = time.process_time()

        def call() -> int:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                return run(words)

        code = self._attempt("cli", call)
        said = err.getvalue()
        if code is None:
            return
        self.answers[f"cli {words[0]}"] = str(code)
        why = said.partition("why:")[2].partition("\n")[0].strip()
        if code not in codes or "certbound failed" in said:
            self.report("cli", f"exit {code}", f"{words[0]}: {_plain(why)}", said)
        if code in (0, 1) and not _is_object(out.getvalue()):
            self.report("cli", "malformed", f"{words[0]}: standard output is no JSON object", out.getvalue()[:500])
        if words[0] == "verify" and time.process_time() - started > 2 * limit + BUDGETS["certificate"]:
            self.report("cli", "slow", f"{words[0]} --time-limit {limit:g}", f"{time.process_time() - started:.1f} s")

    # ---- attempts and comparisons ----------------------------------------------------------------------------

    def _attempt(self, command: str, call: Callable[[], Any], documented: str = "") -> Any:
        """The answer of a call; None where it raised, which is an answer (documented) or a finding."""
        started = time.process_time()
        value = None
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            try:
                value = call()
                self.answers.setdefault(command, "done")
            except Exception as error:  # noqa: BLE001  (whatever it is, it is written down)
                self._refused(command, documented or command, error)
        spent = time.process_time() - started
        self.seconds[command] = self.seconds.get(command, 0.0) + spent
        for warning in heard:
            if _TOO_COARSE in str(warning.message):  # what a user who asks for too few steps is to be told
                self.facts["too coarse"] = True
                continue
            place = f"{Path(warning.filename).name}:{warning.lineno}"
            self.report(command, "warning", f"{warning.category.__name__} {place}", str(warning.message))
        if spent > BUDGETS[command]:
            self.report(command, "slow", f"{command} beyond {BUDGETS[command]:g} s", f"{spent:.1f} s")
        return value

    def _refused(self, command: str, rules: str, error: Exception) -> None:
        said = isinstance(error, ValueError) and any(word in str(error) for word in _SAID.get(rules, ()))
        if isinstance(error, DOCUMENTED.get(rules, ())) or said:
            self.answers[command] = f"refused: {type(error).__name__}: {str(error)[:300]}"
            return
        self.answers[command] = "error"
        trace = "".join(traceback.format_exception(error))
        self.report(command, "error", signature_of(error), trace[-1900:])

    def _compare(
        self, command: str, level: float, count: Callable[[int], tuple[int, int]], *, below: bool = False
    ) -> None:
        """A finding where hits out of paths refute ``level`` as an upper (or lower) bound, on finer grids as well."""
        said = []
        for factor in (1, *FINER) if self.draft.continuous else (1,):
            try:
                hits, paths = count(oracle.STEPS * factor)
            except Exception as error:  # noqa: BLE001  (what was answered cannot be used: a finding too)
                self.report(command, "error", signature_of(error), str(error))
                return
            said.append(f"{hits} of {paths} in {oracle.STEPS * factor} steps")
            limits = oracle.lower_limit(hits, paths), 1 - oracle.lower_limit(paths - hits, paths)
            if limits[1] >= level if below else limits[0] <= level:
                return
        self.report(
            command, "contradiction", f"{command} refuted by simulation", f"certified {level:.6g}: {', '.join(said)}"
        )

    def _steps(self) -> int | None:
        if not self.draft.continuous:
            return None
        plan = self.draft.plan
        return oracle.STEPS * (len(plan) if isinstance(plan, np.ndarray) else 1)

    def _paths(self, steps: int, noise: bool, paths: int = 2000) -> Iterator[tuple[float, Any]]:
        """Paths of the oracle; without noise a random start is its mean."""
        draft, rng = self.draft, self.rng(4)
        policy = next(iter(oracle.policies(draft, rng)))
        initial = oracle.starts(draft, rng, paths)
        if not noise and draft.start[0] == "gaussian":
            initial = np.tile(draft.start[1], (paths, 1))
        with np.errstate(all="ignore"):
            yield from oracle.follow(draft, initial, rng, steps=steps, policy=policy, noise=noise)

    def _outside_tube(self, tube: Any, constants: Any, steps: int) -> tuple[int, int]:
        """Paths whose distance from the noise-free path of the same start exceeds the radius at some time.

        Only where the disturbance is constant, so that both paths meet the same one; both by one scheme.
        """
        draft, units = self.draft, self.draft.units
        quiet = _without_noise(draft)
        metric = np.eye(draft.dimension) if constants.metric is None else constants.metric
        left: Any = False
        rng = self.rng(5)
        policy = next(iter(oracle.policies(draft, rng)))
        initial = oracle.starts(draft, rng, 2000)
        with np.errstate(all="ignore"):
            noisy = oracle.follow(draft, initial, rng, steps=steps, policy=policy)
            still = oracle.follow(quiet, initial, rng, steps=steps, policy=policy)
            for (t, x), (_, y) in zip(noisy, still):
                s = (x - y) * units.state
                size = np.sqrt(np.maximum(np.einsum("pi,ij,pj->p", s, metric, s), 0.0))
                at = min(t * units.time, float(self.problem.horizon))
                radius = tube.radius(at if draft.continuous else round(t))
                left = left | (size > radius * (1 + 1e-9) + 1e-12 * np.max(units.state)) if t > 0 else left
        return int(np.sum(left)), 2000

    def _outside_reach(self, tube: Any, noise: bool, steps: int) -> tuple[int, int]:
        """Paths outside the tube's box hulls at some time of the grid."""
        units = self.draft.units
        noise = noise and "noise: none" not in self.draft.features  # such paths are followed by the better scheme
        left: Any = False
        hull = tube.hull
        rough = bool(self.draft.features & {"model: jump", "model: kink"})
        share = (
            1e-9 if noise else 1e-3 if rough else 1e-6
        )  # of the scheme's own error where a kink or jump spoils its order
        slack = share * (1e-3 * units.state + np.maximum(np.abs(hull.lo), np.abs(hull.hi)))
        for t, x in self._paths(steps, noise):
            at = min(t * units.time, float(self.problem.horizon))
            if at > tube.end:
                break
            k = tube.curve.piece_of(at)
            state = x * units.state
            left = left | ~np.all((state >= hull.lo[k] - slack[k]) & (state <= hull.hi[k] + slack[k]), axis=1)
        return int(np.sum(left)), 2000

    def _leaves_without_noise(self) -> None:
        """UNSAFE_NOMINAL: some noise-free path of the oracle must leave too."""
        from certbound.safety.falsification import find_violation

        draft, rng = self.draft, self.rng(6)
        members = (self.problem.replace(initial=start) for start in self.problem.starts)
        violation = next(filter(None, map(find_violation, members)), None)
        points = oracle.starts(draft, rng, 400) if draft.start[0] != "gaussian" else np.tile(draft.start[1], (2, 1))
        if violation is not None:
            points = np.vstack([points, violation.start / draft.units.state])
        for factor in FINER[:3] if draft.continuous else (1,):  # a window's end may fall between two steps
            for policy in oracle.policies(draft, rng):
                if np.any(oracle.exits(draft, points, rng, steps=factor * oracle.STEPS, policy=policy, noise=False)):
                    return
        if draft.disturbance is None:
            self.report("verify", "contradiction", "UNSAFE_NOMINAL, and no noise-free path leaves", self.verdict.reason)


def _without_noise(draft: Draft) -> Draft:
    from dataclasses import replace

    return replace(draft, diffusion=(), noise=None)


def _is_object(text: str) -> bool:
    try:
        return isinstance(json.loads(text), dict)
    except json.JSONDecodeError:
        return False


def signature_of(error: BaseException) -> str:
    """Type, innermost place in certbound, and the message without its numbers."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/certbound/" in f.filename]
    place = f"{'/'.join(Path(frames[-1].filename).parts[-2:])}:{frames[-1].name}" if frames else "outside certbound"
    return f"{type(error).__name__} in {place}: {_plain(str(error))}"


def _plain(message: str) -> str:
    """A message without its numbers."""
    return re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?", "#", " ".join(message.split()))[:120]


def units_of(draft: Draft, rng: np.random.Generator) -> list[tuple[str, float, float]]:
    """Other units to ask in: a power of two, 1e8 or 1e-8, and sometimes another time."""
    small = float(np.max(draft.units.state)) <= 1.0
    found = [("a power of two", 2.0 ** float(rng.integers(5, 27) * (1 if small else -1)), 1.0)]
    found.append(("1e8", 1e8, 1.0) if small else ("1e-8", 1e-8, 1.0))
    if draft.continuous and rng.random() < 0.2:
        found[1] = ("time", 1.0, 2.0 ** float(rng.integers(-12, 13)))
    return found
