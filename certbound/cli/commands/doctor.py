"""``certbound doctor``: is this installation able to prove anything?"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import typer

from certbound.cli.messages import FAILED
from certbound.cli.options import JsonOption, examples
from certbound.cli.output import SETTINGS, console, show, spinner

EXAMPLES = examples("certbound doctor", "certbound doctor --json", "certbound doctor --warm")
EXTRAS = {"cluster": ["dask", "distributed"], "learn": ["sklearn"]}
WarmOption = Annotated[
    bool, typer.Option("--warm", help="Compile what first calls would, and keep it; say how many kernels that were.")
]


def doctor(warm: WarmOption = False, as_json: JsonOption = False) -> None:
    """Check Python, every dependency, the rigorous arithmetic, a solver, and one whole verdict."""
    checks: list[tuple[str, Callable[[], str]]] = [("python", _python)]
    checks += [(name, _version_of(name)) for name in _requirements()]
    checks += [("rounding", _rounding), ("ball arithmetic", _balls), ("tracing", _tracing), ("solver", _solver)]
    checks += [("verdict", _verdict)]
    checks += [(f"kernels: {name}", _compiling(work)) for name, work in _first_calls().items()] if warm else []
    rows = []
    with spinner("checking the installation") as tell:
        for name, check in checks:
            tell(f"checking the installation: {name}")
            started = time.perf_counter()
            try:
                detail, passed = check(), True
            except Exception as error:  # noqa: BLE001  (whatever is broken is what it reports)
                detail, passed = f"{type(error).__name__}: {error}", False
            seconds = round(time.perf_counter() - started, 3)
            rows.append({"name": name, "ok": passed, "detail": detail, "seconds": seconds})
    healthy = all(row["ok"] for row in rows)
    show({"ok": healthy, "checks": rows, "extras": _extras()}, as_json, lambda: _print(rows, healthy))
    raise typer.Exit(0 if healthy else FAILED)


def _print(rows: list[dict[str, Any]], healthy: bool) -> None:
    screen = console()
    if not SETTINGS.quiet:
        width = 2 + max(14, *(len(row["name"]) for row in rows))
        for row in rows:
            mark = "[green]ok  [/]" if row["ok"] else "[red]FAIL[/]"
            screen.print(f"{mark} {row['name']:<{width}}", end="")
            screen.print(row["detail"], markup=False)
        present = [f"{name} ({'installed' if found else 'not installed'})" for name, found in _extras().items()]
        screen.print(f"     {'extras':<{width}}{', '.join(present)}")
    screen.print("certbound is ready" if healthy else "certbound is not able to work here: mend what failed above")


def _extras() -> dict[str, bool]:
    return {name: all(importlib.util.find_spec(module) for module in modules) for name, modules in EXTRAS.items()}


def _requirements() -> dict[str, str]:
    """Distribution name -> version specifier of what the plain install needs."""
    import re
    from importlib.metadata import requires

    found = {}
    for line in requires("certbound") or []:
        if "extra ==" in line:
            continue
        match = re.match(r"([A-Za-z0-9._-]+)\s*(\(?[^;]*)", line)
        if match:
            found[match.group(1)] = match.group(2).strip(" ()")
    return found


def _version_of(distribution: str) -> Callable[[], str]:
    def check() -> str:
        from importlib.metadata import version as version_of

        module = {"python-flint": "flint", "pyyaml": "yaml"}.get(distribution, distribution.replace("-", "_"))
        importlib.import_module(module)
        version = version_of(distribution)
        needed = _requirements()[distribution]
        if not _satisfies(version, needed):
            raise RuntimeError(f"version {version} is installed, {needed} is needed; pip install -U {distribution}")
        return version

    return check


def _satisfies(version: str, needed: str) -> bool:
    """True where the version is not below the lower bound ``>=x.y`` (the only kind in this project)."""
    if not needed.startswith(">="):
        return True
    numbers = [
        [int(part) for part in text.split(".") if part.isdigit()] for text in (version, needed[2:].split(",")[0])
    ]
    return numbers[0] >= numbers[1]


def _python() -> str:
    return sys.version.split()[0]


def _rounding() -> str:
    import numpy as np

    from certbound.rigor.intervals import Interval, exp

    third = Interval.point(np.array(1.0)) / 3.0
    back = third * 3.0
    grown = exp(Interval.point(np.array(1.0)))
    if not (back.lo < 1.0 < back.hi and grown.lo < 2.718281828459045 < grown.hi and grown.hi - grown.lo < 1e-14):
        raise RuntimeError("interval arithmetic does not enclose 1/3*3 and e as it must")
    return "1/3*3 and e are enclosed"


def _balls() -> str:
    import flint

    value = flint.arb(100000).hypgeom_1f1(flint.arb("0.25"), flint.arb("0.5")).log()
    if not (value > 99990 and value < 100000):
        raise RuntimeError(f"log 1F1(1/4; 1/2; 1e5) came out as {value}")
    return "log 1F1(1/4; 1/2; 1e5) is right"


def _tracing() -> str:
    import numpy as np

    from certbound.problem.model import trace

    tape = trace(lambda t, x: np.array([x[1], -np.sin(x[0])]), {"t": ["t"], "x": ["angle", "speed"]})
    return f"a pendulum is {len(tape.nodes)} operations"


def _solver() -> str:
    import cvxpy
    import numpy as np

    cp: Any = cvxpy
    matrix = cp.Variable((2, 2), symmetric=True)
    problem = cp.Problem(cp.Minimize(cp.trace(matrix)), [matrix >> np.array([[2.0, 1.0], [1.0, 2.0]])])
    problem.solve(solver=cp.CLARABEL)
    if problem.status != cp.OPTIMAL or abs(problem.value - 4.0) > 1e-5:
        raise RuntimeError(f"Clarabel answered {problem.status}, {problem.value}")
    return "Clarabel solves a semidefinite program"


def _first_calls() -> dict[str, Callable[[], object]]:
    """Work that needs every kernel of value functions, and those of the bundled problems' simulations."""
    from certbound.problem.files import load
    from certbound.problem.library import MODELS
    from certbound.simulation.estimates import simulate_exits, simulate_rare_exits

    found = _value_kernels()
    for name in MODELS:
        problem = load(name)
        found[name] = partial(simulate_exits, problem, paths=1, rng=1)
        found[f"{name} --rare"] = partial(simulate_rare_exits, problem, paths=40, particles=20, rng=1)
    return found


def _value_kernels() -> dict[str, Callable[[], object]]:
    import numpy as np

    import certbound as cb

    def leaving(diffusion: list[list[float]]) -> Callable[[], object]:
        def drift(x: Any) -> Any:
            return np.array([x[1], -x[0] - x[1]])

        system = cb.ContinuousSystem(drift, states=2, diffusion=diffusion)
        safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
        problem = cb.Problem(system, initial=[0.0, 0.0], safe=safe, horizon=0.2, delta=0.5)
        return partial(cb.verify_safety, problem, method="values")

    return {"values": leaving([[0.4, 0.0], [0.0, 0.4]]), "values, noise in one of two": leaving([[0.0], [0.4]])}


def _compiling(work: Callable[[], object]) -> Callable[[], str]:
    """A check that does some work, and counts the kernels that were compiled for it, or found compiled."""

    def check() -> str:
        before = _kernels()
        work()
        compiled, loaded = (after - start for after, start in zip(_kernels(), before))
        return f"{compiled} compiled, {loaded} found compiled"

    return check


def _kernels() -> tuple[int, int]:
    """How many kernels this process has compiled so far, and how many it has loaded from the cache."""
    from numba.core.dispatcher import Dispatcher

    modules = [module for name, module in list(sys.modules.items()) if name.startswith("certbound")]
    kernels = {id(value): value for module in modules for value in vars(module).values()}
    found = [value for value in kernels.values() if isinstance(value, Dispatcher)]
    loaded = sum(sum(kernel.stats.cache_hits.values()) for kernel in found)
    return sum(len(kernel.nopython_signatures) for kernel in found) - loaded, loaded


def _verdict() -> str:
    from certbound.problem.files import load
    from certbound.safety.verification import verify_safety

    verdict = verify_safety(load("ou"))
    if verdict.status != "SAFE":
        raise RuntimeError(f"`ou` should be SAFE, got {verdict.status}: {verdict.reason}")
    return f"ou is SAFE, log10 delta {verdict.log10_delta:.2f}"
