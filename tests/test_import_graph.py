"""The doors between rooms and sub-rooms open in one direction: checked on the source, without running it."""

from __future__ import annotations

import ast
import functools
import gc
import re
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "certbound"

# What a line names may import the lines above it: rooms, sub-rooms, and single modules that stand between these.
ORDER = """
errors watch
lazy arrays _version
parallel
checks
display
rigor
problem.model
problem.sets problem.noise
problem.table_laws
problem.adapters problem.networks
problem.signals problem.filters
problem.systems
problem.observers
problem.loops
problem.random_constants
problem.ingredients
problem.problem
problem.jumps_as_plan problem.held problem.reductions
problem problem.library
problem.foreign
problem.export problem.files
gaussian.scalar
gaussian.response gaussian.affine
gaussian
tubes.constants tubes.line_search
tubes.tube tubes.schedule tubes.excess
tubes.ballpath tubes.objective tubes.piecewise
tubes.question
tubes.paper tubes.kummer
tubes.exact
tubes
values
values.continuous values.discrete
values.kolmogorov
values.semilagrangian values.chains values.directed
simulation.compiled
simulation
simulation.estimates
constants.enclosures
constants.jacobians
constants.programs
constants
reach.nominal
reach.sets reach.remainder
reach.affine
reach.contraction reach.linear reach.sampled
reach.below
reach.starts
reach
quadratic.form_matrices quadratic.conic
quadratic.setting
quadratic.steps
quadratic
safety.answers safety.falsification
safety.engines safety.starts
safety.first_exits safety.laws
safety.certificates
safety.portfolio
safety.certificate
safety.verdict
safety.members safety.misses safety.averages safety.search
safety.decision
safety
safety.sweeps
synthesis
synthesis.plans
synthesis.controllers
plotting
html_report
cli.describe cli.messages cli.output
cli.options cli.pictures cli.progress
cli.clock cli.starters
cli.commands
cli
__main__
"""
CHECKER_ORDER = """
report words
reading
balls expressions
statement
constants linear barrier values endless affine time_pieces
claims
check
"""
LEVEL = {unit: level for level, line in enumerate(ORDER.split("\n")) for unit in line.split()}
LEVEL |= {
    f"checker.{unit}": level for level, line in enumerate(CHECKER_ORDER.split("\n")) for unit in line.split()
} | {"checker": 99}

GROUND = {"errors", "lazy", "arrays", "watch", "parallel", "_version", "checks", "display", "rigor"}
KNOWS_ONLY = {  # rooms that may be taken out and used elsewhere
    "tubes": GROUND,
    "gaussian": GROUND | {"problem"},
    "values": GROUND | {"problem"},
}
CHECKER_MAY_IMPORT = {"certbound.errors", "certbound.problem.model", "flint"}
CHECKER_TAKES = {"Tape", "Node", "JUMPS", "Layer", "Network", "Part", "needed", "rounded_comparison"}
"""What the checker may take of ``problem.model``: the description of a tape, and whether rounding decides in it."""
ON_ARRAYS = "certbound.checker.values"
"""The part of the checker that may take NumPy besides; it is loaded only for certificates that need it."""

ENTERED = {
    ("cli", "cli.commands"): "one module a command, and the application lists them",
}
"""Sub-rooms whose modules are imported from outside, by whom, and why; everybody else enters by the door."""

MOST_DOORS = 5
MANY_DOORS = {
    "checker.endless": (7, "a proof from above and one from below of each kind, which the table of engines names"),
    "values.continuous": (16, "bounds, rates and charts, and the surfaces that certificates state, with their payment"),
    "values.discrete": (8, "one bound of any horizon more; kernels are those of the steps along the flow too"),
    "gaussian.affine": (7, "bounds from both sides, and the pieces that a certificate states, with their records"),
    "gaussian.scalar": (20, "a catalogue of bounds of scalar Gaussian events, of which each direction takes its own"),
    "problem.model": (41, "the one description of functions, which every room reads, differentiates and evaluates"),
    "gaussian.response": (21, "events in both times, for noise that depends on the state and not; units; jumps"),
    "reach.linear": (19, "certificates state the records of the search: linearisations, shares; bounds from below"),
    "constants.jacobians": (15, "nine of them are what users take of the constants room"),
    "constants.programs": (16, "one program each for rate, gain and erosion, with what it is asked; the solver"),
    "checker.balls": (14, "operations on ball matrices, as a library would offer them"),
    "problem.sets": (22, "the sets and constraints that users write, and the two forms that everybody reads"),
    "reach.nominal": (11, "curves, series and cells, which every kind of tube is made of"),
    "checker.statement": (17, "what a certificate states is read once and asked by all proofs; other coordinates"),
    "tubes.kummer": (10, "one tube, one mixture and one exit probability, with their checks and searches"),
    "checker.expressions": (11, "graphs, programs, expansions and ceilings are chosen by what a proof needs"),
    "constants.enclosures": (8, "enclosures and branch and bound, which barrier and reach use too"),
    "reach.contraction": (11, "the constants certificate restates the scalar equation piece by piece"),
    "problem.adapters": (9, "to and from each library"),
    "safety.certificates": (10, "a writer an engine, for each side where it has two; other coordinates, exact laws"),
    "safety.search": (6, "whom to ask next, and with what effort; and of limits that move, of what problem"),
    "safety.engines": (20, "the engines, and the rooms that their certificates restate"),
    "tubes.paper": (6, "the baselines, and the martingales that users take for processes of their own"),
    "reach.sets": (8, "tubes, requirements and their names, and directions for the certificate"),
}
"""Sub-rooms with more than ``MOST_DOORS`` names in their ``__init__``: how many at most, and why."""

WIDE_OPEN = {"problem.sets", "problem.library", "gaussian.scalar"}
"""Sub-rooms that offer what they hold, whether the package itself uses it or not."""

CIRCLES: dict[frozenset[str], str] = {}
"""Modules that import each other in a circle, in functions or for types, and why; there is none."""

TWICE = {
    "arithmetic": "the operations on numbers that enclose: intervals in rigor, balls in the checker",
    "barrier": "the barrier engine, its certificate, its check",
    "check": "checking a certificate, and the command that does it",
    "constants": "the constants c, L, sigma, nu: their record, the engine on them, its certificate",
    "diffusion": "noise that depends on the state in the linear engine: search, certificate, check",
    "elementary": "elementary functions: of intervals, and compiled into kernels",
    "events": "exceedances of the Gaussian response",
    "expansion": "second-order expansion over a box",
    "graph": "expressions as a shared graph",
    "linear": "the linear-response engine, its certificate",
    "normal": "tails of the normal distribution",
    "operations": "the table of the operations of a tape: the prover's, and the checker's own",
    "problem": "a safety problem",
    "proof": "the proof of a whole certificate of one kind; of one value function within curved limits",
    "quadratic": "quadratic forms in the checker's expansions; the engine of quadratic value bounds",
    "reach_tube": "the noise-free reach tube",
    "regions": "sets of states",
    "reading": "files of strangers",
    "rooms": "what constraints leave to the deviation",
    "series": "Taylor series in time",
    "values": "the engine of value functions, its certificate",
    "structure": "which entries of a Jacobian vary, and how",
}
"""Module names that stand in more than one folder, and the one thing that they mean."""

MODULE = re.compile(r"certbound(\.\w+)+")
MOST_MODULES = 14
HEAVY = {"casadi", "clarabel", "control", "cvxpy", "matplotlib", "numba", "plotly", "distributed", "dask"}


class Import:
    """One name imported by one line: ``base`` is the module, ``name`` what is taken of it."""

    def __init__(self, line: int, base: str, name: str) -> None:
        self.line, self.base, self.name = line, base, name

    def __repr__(self) -> str:
        return f"{self.line} imports {self.base}{'.' if self.name else ''}{self.name}"


def parsed(path: Path) -> ast.Module:
    """The syntax tree, without the garbage collector, which takes twice as long over its nodes."""
    gc.disable()
    try:
        return ast.parse(path.read_text(encoding="utf-8"))
    finally:
        gc.enable()


@functools.cache
def imports_of(path: Path, module: str) -> list[Import]:
    """Everything that a module imports, wherever in it; texts that are a module's name count as well."""
    found = []
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found += [Import(node.lineno, alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = package.split(".")
                parts = parts[: len(parts) - node.level + 1]
                base = ".".join([*parts, base] if base else parts)
            found += [Import(node.lineno, base, alias.name) for alias in node.names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and MODULE.fullmatch(node.value):
            found.append(Import(node.lineno, node.value, ""))
        elif isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "_HOME":
            for home, names in ast.literal_eval(node.value).items():
                found += [Import(node.lineno, f"{package}.{home}", name) for name in names.split()]
    return found


def modules_of(package: Path) -> dict[str, Path]:
    """Every module's name and file."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = ["certbound", *path.relative_to(package).with_suffix("").parts]
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def unit_of(module: str) -> str | None:
    """The longest name in the order that a module belongs to."""
    parts = module.split(".")[1:] if module.split(".")[0] == "certbound" else []
    names = [".".join(parts[:end]) for end in range(len(parts), 0, -1)]
    return next((name for name in names if name in LEVEL), names[-1] if names else None)


def room_of(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[0] == "certbound" else None


def subrooms_of(package: Path) -> set[str]:
    """Folders inside rooms."""
    return {
        ".".join(path.parent.relative_to(package).parts)
        for path in package.rglob("__init__.py")
        if len(path.parent.relative_to(package).parts) == 2
    }


def subroom_of(module: str, subrooms: set[str]) -> str | None:
    name = ".".join(module.split(".")[1:3])
    return name if module.startswith("certbound.") and name in subrooms else None


def allowed(importer: str, found: Import) -> bool:
    """Whether the order lets a module import this."""
    room, other = room_of(importer), room_of(found.base)
    if other is None and found.base == "certbound" and found.name and not found.name.startswith("__"):
        other = found.name  # from certbound import safety
    imported = found.base if room_of(found.base) else f"certbound.{other}" if other else found.base
    if room == "checker" and other != "checker":
        if imported == "certbound.problem.model":
            return found.name in CHECKER_TAKES
        may = CHECKER_MAY_IMPORT | ({"numpy"} if importer.startswith(ON_ARRAYS) else set())
        named = any(imported == name or imported.startswith(name + ".") for name in may)
        return named or imported.split(".")[0] in sys.stdlib_module_names
    if other is None or room is None or imported == "certbound.problem.__init__":
        return True
    if other == "checker" and room != "checker":
        return room in ("cli", "html_report")
    if other != room and room in KNOWS_ONLY and other not in KNOWS_ONLY[room]:
        return False
    one, two = unit_of(importer), unit_of(f"{imported}.{found.name}" if found.name else imported)
    if one == two or imported == f"certbound.{room}":
        return True
    return LEVEL.get(two or "", 99) < LEVEL.get(one or "", -1)


def by_the_door(importer: str, found: Import, subrooms: set[str], modules: set[str]) -> bool:
    """Whether an import from another sub-room goes to the sub-room itself, not to a module in it."""
    full = f"{found.base}.{found.name}" if f"{found.base}.{found.name}" in modules else found.base
    own, other = subroom_of(importer, subrooms), subroom_of(full, subrooms)
    if other is None or own == other or full == f"certbound.{other}":
        return True
    return (unit_of(importer), other) in ENTERED


def violations(package: Path) -> list[str]:
    """Every import against the order or past a door, as ``file:line imports name``."""
    found = []
    modules = modules_of(package)
    subrooms = subrooms_of(package)
    for module, path in modules.items():
        for entry in imports_of(path, module):
            if not allowed(module, entry) or not by_the_door(module, entry, subrooms, set(modules)):
                found.append(f"{path.relative_to(package)}:{entry}")
    return found


def circles(package: Path) -> list[frozenset[str]]:
    """Sets of modules each of which leads back to itself; a name counts for the module that its door took it from."""
    modules = modules_of(package)
    doors = {
        (module, entry.name): entry.base
        for module, path in modules.items()
        if path.name == "__init__.py"
        for entry in imports_of(path, module)
    }
    leads: dict[str, set[str]] = defaultdict(set)
    for module, path in modules.items():
        for entry in imports_of(path, module):
            full = f"{entry.base}.{entry.name}"
            target = full if full in modules else doors.get((entry.base, entry.name), entry.base)
            if target in modules and target != module and module != "certbound":
                leads[module].add(target)

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        ahead = list(leads[start])
        while ahead:
            module = ahead.pop()
            if module not in seen:
                seen.add(module)
                ahead += leads[module]
        return seen

    behind = {module: reached(module) for module in modules}
    looped = [module for module in modules if module in behind[module]]
    return sorted({frozenset(m for m in looped if m in behind[a] and a in behind[m]) for a in looped}, key=sorted)


def test_every_import_points_from_a_later_room_to_an_earlier_one_and_enters_by_its_door() -> None:
    assert violations(PACKAGE) == []


def test_no_module_leads_back_to_itself() -> None:
    assert [circle for circle in circles(PACKAGE) if circle not in CIRCLES] == []
    assert set(CIRCLES) <= set(circles(PACKAGE))


def test_every_room_and_sub_room_has_its_place_in_the_order() -> None:
    rooms = {
        path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert rooms - {"__init__", "__main__"} <= set(LEVEL)
    assert subrooms_of(PACKAGE) <= set(LEVEL)


def test_no_folder_holds_more_modules_than_can_be_looked_over() -> None:
    counts = Counter(path.parent for path in PACKAGE.rglob("*.py"))
    assert {str(folder): count for folder, count in counts.items() if count > MOST_MODULES} == {}


def names_offered(path: Path) -> list[str]:
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return list(ast.literal_eval(node.value))
    return []


def test_a_sub_room_has_few_doors_or_says_why_not() -> None:
    for room in sorted(subrooms_of(PACKAGE)):
        offered = names_offered(PACKAGE / room.replace(".", "/") / "__init__.py")
        assert len(offered) <= MANY_DOORS.get(room, (MOST_DOORS, ""))[0], room
    assert set(MANY_DOORS) <= subrooms_of(PACKAGE)


def python_files() -> Iterator[Path]:
    for folder in ("certbound", "tests", "experiments", "paper_figs"):
        yield from (ROOT / folder).rglob("*.py")


def test_every_door_is_used_from_outside() -> None:
    modules = modules_of(PACKAGE)
    names = {path: module for module, path in modules.items()}
    subrooms, taken = subrooms_of(PACKAGE), defaultdict(set)
    for path in python_files():
        module = names.get(path, "elsewhere.module")
        for entry in imports_of(path, module):
            if subroom_of(module, subrooms) != ".".join(entry.base.split(".")[1:3]):
                taken[entry.base].add(entry.name)
    for room in sorted(subrooms - WIDE_OPEN):
        offered = names_offered(PACKAGE / room.replace(".", "/") / "__init__.py")
        assert set(offered) <= taken[f"certbound.{room}"], room


def test_no_private_name_is_imported() -> None:
    names = {path: module for module, path in modules_of(PACKAGE).items()}
    found = []
    for path in python_files():
        for entry in imports_of(path, names.get(path, "elsewhere.module")):
            if re.match(r"_[a-z]|_[A-Z]", entry.name) and entry.base.startswith("certbound"):
                found.append(f"{path.relative_to(ROOT)}:{entry}")
    assert found == []


def test_no_door_has_the_name_of_a_module_beside_it() -> None:
    """A module that is loaded later takes the place of what the door offers under its name."""
    listed = [path for path in PACKAGE.rglob("__init__.py") if "names_in" not in path.read_text("utf-8")]
    taken = [(path, name) for path in listed for name in names_offered(path)
             if (path.parent / f"{name}.py").exists() or (path.parent / name).exists()]  # fmt: skip
    assert taken == []


def test_a_module_name_means_one_thing() -> None:
    names = Counter(path.stem for path in PACKAGE.rglob("*.py") if path.stem != "__init__")
    assert {name for name, count in names.items() if count > 1} <= set(TWICE)


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("problem/planted.py", "from certbound.safety import verification"),
        ("problem/planted.py", "from ..reach.dispatch import anything"),
        ("problem/sets/planted.py", "from certbound.problem.systems import ContinuousSystem"),
        ("tubes/planted.py", "from certbound.problem.model import Tape"),
        ("values/planted.py", "from certbound.tubes.tube import Tube"),
        ("gaussian/planted.py", "from certbound.reach.linear import LinearRun"),
        ("constants/planted.py", "def late():\n    import certbound.cli.app"),
        ("constants/planted.py", "import importlib\nimportlib.import_module('certbound.cli.app')"),
        ("display.py", "import importlib\nimportlib.import_module('certbound.plotting.results').draw"),
        ("rigor/planted.py", "from .. import problem"),
        ("rigor/__init__.py", "_HOME = {'planted': 'planted'}\nfrom certbound.tubes import tuning"),
        ("reach/planted.py", "from certbound.checker import verify"),
        ("reach/linear/planted.py", "from certbound.reach.contraction import local_tube"),
        ("safety/planted.py", "from certbound.reach.linear.run import LinearRun"),
        ("safety/planted.py", "from certbound.reach.linear import run"),
        ("reach/contraction/planted.py", "from certbound.reach.nominal.curve import Curve"),
        ("checker/planted.py", "import numpy"),
        ("checker/linear/planted.py", "import numpy.linalg"),
        ("checker/values/planted.py", "import scipy"),
        ("checker/values/planted.py", "from certbound.values import grids"),
        ("checker/planted.py", "from certbound.problem.systems import ContinuousSystem"),
        ("checker/planted.py", "from certbound.problem.model import compile_numpy"),
        ("checker/planted.py", "from certbound.rigor import intervals"),
        ("checker/balls/planted.py", "from certbound.checker.statement import Model"),
    ],
)
def test_a_planted_wrong_import_is_detected(tmp_path: Path, file: str, source: str) -> None:
    plant(tmp_path, file, source)
    assert len(violations(tmp_path)) == 1


@pytest.mark.parametrize(
    ("file", "source"),
    [
        (
            "tubes/planted.py",
            "from certbound.rigor import balls\nfrom .constants import Constants\nimport numpy",
        ),
        ("checker/planted.py", "import json\nfrom flint import arb\nfrom certbound.problem.model import Tape"),
        ("checker/values/planted.py", "import numpy as np\nimport numpy.typing as npt"),
        ("safety/planted.py", "from ..reach import linear\nfrom certbound import __version__"),
        ("safety/planted.py", "from certbound.reach.linear import LinearRun"),
        ("reach/linear/planted.py", "from certbound.reach.linear.run import LinearRun"),
        ("cli/app.py", "from certbound.cli.commands import check"),
    ],
)
def test_an_import_in_the_right_direction_passes(tmp_path: Path, file: str, source: str) -> None:
    plant(tmp_path, file, source)
    assert violations(tmp_path) == []


def plant(package: Path, file: str, source: str) -> None:
    """A package with the sub-rooms that planted imports speak of, and one more file."""
    rooms = ("reach/linear", "reach/contraction", "reach/nominal", "checker/statement", "problem/sets", "cli/commands")
    for room in rooms:
        (package / room).mkdir(parents=True)
        (package / room / "__init__.py").write_text("")
    for module in ("reach/linear/run", "reach/nominal/curve", "cli/commands/check"):
        (package / f"{module}.py").write_text("")
    planted = package / file
    planted.parent.mkdir(parents=True, exist_ok=True)
    planted.write_text(source)


def test_a_planted_circle_is_detected(tmp_path: Path) -> None:
    plant(tmp_path, "reach/linear/first.py", "from certbound.reach.linear.second import x")
    second = tmp_path / "reach/linear/second.py"
    second.write_text("if TYPE_CHECKING:\n    from certbound.reach.linear.first import y")
    assert circles(tmp_path) == [frozenset({"certbound.reach.linear.first", "certbound.reach.linear.second"})]


def loaded_by(statement: str, names: set[str]) -> set[str]:
    """Which of the named top-level modules a fresh interpreter holds after a statement."""
    code = f"import sys\n{statement}\nprint(*[name for name in {sorted(names)!r} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(result.stdout.split())


def test_importing_the_package_loads_nothing_heavy() -> None:
    """What one of the statements loads, the ones after it find loaded."""
    assert loaded_by("import certbound\nimport certbound.cli\nfrom certbound.cli import app", HEAVY) == set()


def test_a_verdict_begins_before_what_single_engines_need_is_loaded() -> None:
    parts = {f"scipy.{part}" for part in ("interpolate", "linalg", "ndimage", "optimize", "sparse", "special")}
    assert loaded_by("import certbound.cli.app, certbound.safety.verification", parts | {"numba"}) == set()


def test_importing_the_checker_loads_nothing_that_it_checks() -> None:
    assert loaded_by("import certbound.checker", HEAVY | {"numpy", "scipy", "certbound.rigor"}) == set()
