"""The linear response in ball arithmetic: units of the states, and rows carried back in blocks."""

from __future__ import annotations

import random

import pytest
from flint import arb, arb_mat, ctx

import certbound as cb
from certbound.checker import check_data, parse
from certbound.checker.balls import column, diagonal, matrix, row_sums
from certbound.checker.linear import response
from certbound.checker.linear.response import Load, balance, continuous_piece, supports
from certbound.checker.report import Budget, Unproved
from certbound.safety.certificate import certificate_text

UNITS = [arb(2) ** 40, arb(1), arb(2) ** -30]


def test_balanced_units_bring_a_matrix_in_mixed_units_back() -> None:
    own = matrix([[0.5, 1.0, 0.8], [1.0, 0.3, 1.1], [0.9, 1.0, 0.1]])
    mixed = diagonal(UNITS) * own * diagonal([1 / unit for unit in UNITS])
    found = balance(mixed)
    again = diagonal([1 / unit for unit in found]) * mixed * diagonal(found)
    assert row_sums(again) < 2 * row_sums(own)
    assert balance(own * 0) == [1, 1, 1]


def test_what_a_series_leaves_out_follows_the_precision() -> None:
    slope = matrix([[0.2, 2.0], [-0.3, 0.1]])
    with ctx.workprec(700):
        found = continuous_piece(slope, slope, arb(0.1), diagonal([arb(0.1), arb(0.2)]))
        assert all(x.rad() < arb(2) ** -600 for x in [*found.transition.entries(), *found.noise.entries()])
        assert all(found.transition[i, j].overlaps(matrix_at_128(slope)[i, j]) for i in range(2) for j in range(2))


def matrix_at_128(slope: arb_mat) -> arb_mat:
    with ctx.workprec(128):
        return continuous_piece(slope, slope, arb(0.1), slope * 0).transition


def test_the_series_of_a_piece_run_in_its_own_units() -> None:
    slope = matrix([[-1.0, 2.0, 0.5], [0.3, -0.7, 1.0], [1.0, 0.1, -2.0]])
    noise = diagonal([arb(0.1), arb(0.2), arb(0.3)])
    unit, back = diagonal(UNITS), diagonal([1 / value for value in UNITS])
    own = continuous_piece(slope, slope * 0, arb(0.1), noise)
    mixed = continuous_piece(unit * slope * back, slope * 0, arb(0.1), unit * noise * unit, UNITS)
    for found, exact in (
        (mixed.transition, unit * own.transition * back), (mixed.noise, unit * own.noise * unit),
        (mixed.deviation, unit * own.deviation * back), (mixed.gathered, unit * own.gathered * back),
    ):  # fmt: skip
        assert all(abs(x - y) <= 1e-12 * abs(y) + 1e-250 for x, y in zip(found.entries(), exact.entries()))
    with pytest.raises(Unproved, match="too long for the slope"):
        continuous_piece(unit * slope * back, slope * 0, arb(0.1), unit * noise * unit)


@pytest.mark.parametrize("block", [1, 3, 512])
def test_rows_are_carried_back_alike_in_blocks_of_any_size(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(response, "_ROWS", block)
    rng, n, count = random.Random(0), 2, 5

    def numbers(length: int) -> list[arb]:
        return [arb(rng.uniform(-1, 1)) for _ in range(length)]

    steps = [arb_mat(n, n, numbers(n * n)) for _ in range(count)]
    rows = [[numbers(n) for _ in range(rng.randrange(3))] for _ in range(count + 1)]
    loads = [
        Load(centre=column(numbers(n)), radius=[abs(x) for x in numbers(n)], generators=arb_mat(n, 2, numbers(4)),
             box=[abs(x) for x in numbers(n)])
        for _ in range(count)
    ]  # fmt: skip
    start = [arb(0.3), arb(0.2)]
    found = supports(steps, rows, loads, start, Budget(60.0))
    for node, own in enumerate(rows):
        for i, row in enumerate(own):
            middle, wide, reach, seen = arb(0), arb(0), arb(0), arb_mat(1, n, row)
            for j in range(node - 1, -1, -1):
                sizes = [abs(x) for x in seen.entries()]
                middle += (seen * loads[j].centre)[0, 0]
                wide += sum(a * b for a, b in zip(sizes, loads[j].radius))
                reach += sum(a * b for a, b in zip(sizes, loads[j].box))
                reach += sum(abs(x) for x in (seen * loads[j].generators).entries())
                seen = seen * steps[j]
            reach += sum(abs(x) * r for x, r in zip(seen.entries(), start))
            expected = (middle - wide, middle + wide, reach)
            values = (found.low[node][i], found.high[node][i], found.reach[node][i])
            assert all(abs(x - y) < 1e-12 for x, y in zip(values, expected))


def test_states_that_hardly_drive_each_other_keep_their_own_units() -> None:
    """About the origin the couplings are 0 or far below 1, so that units which balance them have no limit."""
    system = cb.ContinuousSystem(
        lambda x: [-x[0] + 0.3 * x[1] ** 2, -x[1] + 0.2 * x[2], -2 * x[2] + 0.1 * x[3] * x[0], -x[3]],
        states=4, diffusion=[[0.15 * (i == j) for j in range(4)] for i in range(4)],
    )  # fmt: skip
    problem = cb.Problem(system, initial=[0.0] * 4, safe=[cb.Inside(cb.Ball([0.0] * 4, 1.3))], horizon=3, delta=1e-2)
    report = check_data(parse(certificate_text(problem, cb.verify_safety(problem, method="linear"))))
    assert report.valid, report.reason
