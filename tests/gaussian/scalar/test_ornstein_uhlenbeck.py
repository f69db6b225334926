"""Passages over lines and polygons against quadrature and closed forms."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from certbound.gaussian.scalar.normal import log_tail
from certbound.gaussian.scalar.ornstein_uhlenbeck import log_line_crossing, log_polygon_crossing


def line_crossing_by_quadrature(q0, q1, span, prior=None):
    """int phi(x) [P(no passage before)] L(q0 - x) dx, with the Bachelier-Levy formula on both sides."""

    def meet(a, b, other, length):
        c = np.expm1(2 * length)
        beta = (np.exp(length) * other - b) / c
        first = norm.sf((a + beta * c) / np.sqrt(c))
        return first + np.exp(-2 * a * beta + norm.logcdf((beta * c - a) / np.sqrt(c)))

    top = q0 if prior is None else min(q0, prior[1])

    def density(x):
        survive = 1.0 if prior is None else 1 - meet(prior[1] - x, prior[1], prior[0], prior[2])
        return norm.pdf(x) * survive * meet(q0 - x, q0, q1, span)

    return sum(quad(density, lo, hi, epsabs=0, epsrel=1e-10, limit=200)[0]
               for lo, hi in ((top - 8, top - 2), (top - 2, top - 0.4), (top - 0.4, top)))  # fmt: skip


@pytest.mark.parametrize("q0", [0.5, 3.0, 5.0])
@pytest.mark.parametrize("rise", [-0.4, 0.0, 0.7])
@pytest.mark.parametrize("span", [0.02, 0.3, 1.5])
def test_line_crossings_match_quadrature(q0, rise, span):
    exact = np.log(line_crossing_by_quadrature(q0, q0 + rise, span))
    assert exact - 1e-8 <= float(log_line_crossing(q0, q0 + rise, span)) <= exact + 1e-5


@pytest.mark.parametrize("levels", [(3.0, 3.0, 3.0), (4.0, 3.5, 3.6), (2.0, 2.4, 2.2), (5.0, 5.0, 4.5)])
@pytest.mark.parametrize("spans", [(0.2, 0.2), (0.5, 0.1), (0.05, 0.6)])
def test_passages_after_a_free_window_match_quadrature(levels, spans):
    q0, q1, q2 = levels
    exact = np.log(line_crossing_by_quadrature(q1, q2, spans[1], prior=(q0, q1, spans[0])))
    got = log_polygon_crossing(spans, [q0, q1], [q1, q2])[2]
    assert exact - 1e-8 <= got <= exact + 1e-5


def test_terms_beyond_the_range_of_floats_stay_upper_bounds():
    logs = log_polygon_crossing([0.01, 0.01], [20.0, 30.0], [30.0, 45.0])
    assert np.all(np.isfinite(logs))
    assert logs[2] >= float(log_tail(45.0))
    far = log_polygon_crossing([0.1, 0.1], [2000.0, 2000.0], [2000.0, 2000.0])
    assert np.all((far > -2.1e6) & (far < -1.9e6))


def test_a_polygon_needs_a_window():
    with pytest.raises(ValueError, match="at least one window"):
        log_polygon_crossing([], [], [])
