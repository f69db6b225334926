"""Normal tails and the probability of being below one level and above another, as upper bounds in ball arithmetic."""

from __future__ import annotations

from flint import arb

from certbound.checker.balls.matrices import upper

_PARTS = 20


def tail(x: arb) -> arb:
    """Q(x) = P(N(0, 1) > x).

    Examples
    --------
    >>> bool(abs(tail(arb(0)) - 0.5) < 1e-30)
    True
    """
    return (x / arb(2).sqrt()).erfc() / 2


def _density(x: arb) -> arb:
    return (-x * x / 2).exp() / (2 * arb.pi()).sqrt()


def below_and_above(a: arb, b: arb, correlation: arb) -> arb:
    """Upper bound of P(X <= a, Y > b) for standard normal X, Y with at least the given correlation.

    It is the integral over y > b of phi(y) g(y), g(y) = P(X <= a | Y = y) = Q((rho y - a)/sqrt(1 - rho^2)). For
    rho > 0 the factor g falls; it is concave up to y = a/rho and convex beyond, so that on each of a few parts its
    tangent, or its chord, lies above it, and phi times a line integrates in closed form. Other correlations, and what
    is left beyond the last part, are bounded by the tail of Y.
    """
    rho, a, b = correlation.lower(), a.upper(), b.lower()
    if not (a.is_finite() and b.is_finite() and rho.is_finite()):
        return upper(tail(b)) if b.is_finite() else arb(1)
    whole = tail(b)
    if not rho > 0.01:
        return upper(whole)
    if not rho < 1:
        rho = 1 - arb(2) ** -60
    spread = (1 - rho * rho).sqrt()
    last = arb.min((b * b + 20).sqrt() if b > 0 else b.abs_upper() + 5, arb.max((a + 6 * spread) / rho, b)).mid()
    if not last > b:
        return upper(arb.min(whole, whole * _factor(b, a, rho, spread)))
    knot = (a / rho).mid()
    total = arb(0)
    ends = [(b, knot, True), (knot, last, False)] if b < knot < last else [(b, last, bool(last <= knot))]
    for start, end, concave in ends:
        share = max(2, round(_PARTS * float((end - start) / (last - b))))
        points = [(start + (end - start) * i / share).mid() for i in range(share)] + [end]
        total += _lines(points, a, rho, spread, concave=concave)
    total += tail(last) * _factor(last, a, rho, spread)
    return upper(arb.min(total, whole))


def _factor(y: arb, a: arb, rho: arb, spread: arb) -> arb:
    return tail((rho * y - a) / spread)


def _lines(points: list[arb], a: arb, rho: arb, spread: arb, *, concave: bool) -> arb:
    """Integral of phi times a piecewise linear function above g."""
    tails, densities = [tail(y) for y in points], [_density(y) for y in points]
    values = [] if concave else [_factor(y, a, rho, spread) for y in points]
    total = arb(0)
    for i in range(len(points) - 1):
        mass, moment = tails[i] - tails[i + 1], densities[i] - densities[i + 1]
        if concave:
            anchor = ((points[i] + points[i + 1]) / 2).mid()
            height = _factor(anchor, a, rho, spread)
            slope = -rho / spread * _density((rho * anchor - a) / spread)
        else:
            anchor, height = points[i], values[i]
            slope = (values[i + 1] - values[i]) / (points[i + 1] - points[i])
        total += height * mass + slope * (moment - anchor * mass)
    return total
