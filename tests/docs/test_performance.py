"""The page of measurements: its arithmetic, and a row of its tables."""

from __future__ import annotations

import pytest

from experiments.advice import CASES
from experiments.literature import LITERATURE
from experiments.performance import BENCHMARKS, benchmark_row, equal_strength, machine, power, table
from tests.docs.blocks import DOCS, ROOT


def test_equal_strength_is_the_count_without_exits_that_the_limits_need() -> None:
    from certbound.simulation.estimates.statistics import bound_binomial

    paths = round(10 ** equal_strength(-3))
    assert bound_binomial(0, paths, 0.99)[1] == pytest.approx(1e-3, rel=2e-3)


@pytest.mark.parametrize(
    ("log10", "text"), [(0.0, "1"), (-1.0, "0.1"), (-3.5, "3.2e-4"), (3.0, "1e+03"), (-500.0, "1.0e-500")]
)
def test_powers_are_short(log10: float, text: str) -> None:
    assert power(log10) == text


def test_a_table_is_markdown() -> None:
    assert table(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"


def test_the_machine_has_no_name() -> None:
    import platform

    assert "cores" in machine()
    assert platform.node() not in machine()


def test_every_benchmark_has_its_published_number() -> None:
    files = {path.stem for path in (ROOT / "experiments" / "benchmarks").glob("*.toml")}
    assert files == set(BENCHMARKS)
    page = (DOCS / "benchmarks.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in page for name in (*BENCHMARKS, *LITERATURE))


@pytest.mark.slow
def test_a_benchmark_that_is_easy_is_safe() -> None:
    row = benchmark_row("two_tanks")
    assert row[2] == "SAFE"
    assert int(row[3].partition("e-")[2]) > 40_000


def test_the_pages_say_when_and_where_they_were_measured() -> None:
    for name in ("performance.md", "benchmarks.md"):
        text = (DOCS / name).read_text(encoding="utf-8")
        assert "*Written by `python -m experiments.performance` on 20" in text
        assert "cores" in text


def test_the_guide_on_speed_has_the_rows_that_its_script_measures() -> None:
    text = (DOCS / "how-to" / "speed.md").read_text(encoding="utf-8")
    first = [line.split(" | ")[0].removeprefix("| ") for line in text.splitlines() if line.startswith("| `")]
    assert first[1:] == [*CASES]
