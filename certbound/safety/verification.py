"""``verify_safety``: try the engines that fit, keep the smallest certified probability, answer with a verdict."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from certbound.checks import instance
from certbound.parallel import alone
from certbound.problem.problem import Problem
from certbound.safety.decision import decide
from certbound.safety.limits import limits_so_far, smaller_verdicts
from certbound.safety.verdict import Verdict as Verdict
from certbound.watch import OutOfTime, Progress, Watch, current_watch

if TYPE_CHECKING:
    from certbound.tubes.constants import Constants


@alone()
def verify_safety(
    problem: Problem, method: str = "auto", cells: int | None = None, *, constants: Constants | None = None,
    time_limit: float | None = None, progress: Callable[[Progress], object] | None = None, smallest: bool = False,
    explain: bool = False, jobs: int = 1, executor: Any = None, patient: bool = True,
    started: float | None = None,
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
    time_limit : float, optional
        Seconds after which the best answer so far is returned; ``reason`` says what more time would go on with.
    progress : callable, optional
        Called with a `certbound.watch.Progress` about four times a second, and whenever a bound gets better.
    smallest : bool
        Once SAFE, go on to the smallest probability that can be proved.
    explain : bool
        Of what is not SAFE, find what would be: `Verdict.limits`.
    jobs : int
        Processes that prove cells of the initial set side by side; the answer is the same.
    executor : concurrent.futures.Executor or dask Client, optional
        Who proves cells instead, with the same answer.
    patient : bool
        Whether what is left of ``time_limit`` is spent where nothing is SAFE, on engines whose bounds go on falling; if
        not, the search ends where more time would hardly change the verdict.
    started : float, optional
        Time of ``time.perf_counter`` from which ``time_limit`` counts; that of the call when omitted.

    Returns
    -------
    Verdict

    Raises
    ------
    ValueError
        If the system has inputs and no plan, the method is unknown, the limit is not positive, or ``cells`` or the
        constants do not fit. What fails afterwards is an engine: it answers that it does not apply, and why.

    Source: Thms K2, K4, K5, K7 of theory.

    Examples
    --------
    >>> import numpy as np, certbound as cb
    >>> system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=0.05 * np.eye(2))
    >>> problem = cb.Problem(system, initial=[0.2, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2)
    >>> verify_safety(problem, method="constants").status
    'SAFE'
    """
    instance("problem", problem, Problem)
    own = time_limit is not None or progress is not None or jobs != 1 or executor is not None
    made = Watch(time_limit, progress=progress, jobs=jobs, executor=executor, patient=patient, started=started)
    watch = made if own else current_watch() or made
    verdict = decide(problem, method=method, cells=cells, constants=constants, watch=watch)
    with contextlib.suppress(OutOfTime), watch.running():
        if smallest and verdict.status == "SAFE":
            for found in smaller_verdicts(verdict, method=method, cells=cells):
                verdict = found
        if explain and verdict.status in ("UNKNOWN", "UNSAFE"):
            for limits in limits_so_far(verdict, cells=cells):
                verdict = replace(verdict, limits=limits)
    return verdict
