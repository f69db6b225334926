"""Lower bounds of the probability that some of many events of the Gaussian response occur, at single times.

Proves (de Caen, 1997): P(A_1 or A_2 or ...) >= sum_k P(A_k)^2 / sum_l P(A_k and A_l), where every P(A_k) above may be
replaced by something less, and every P(A_k and A_l) below by something more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers
from certbound.gaussian.response.linear_response import LinearResponse, gamma
from certbound.gaussian.scalar import log_below_above, log_tail, log_tail_below
from certbound.watch import poll

_ROUND = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class Exceedances:
    """Events {rows[k] . Z > levels[k] at nodes[k]}, less parts of them that cost ``lost`` (M,) in probability."""

    nodes: Integers  # (M,)
    rows: Array  # (M, n)
    levels: Array  # (M,)
    lost: Array  # (M,)

    def chosen(self, index: Integers) -> Exceedances:
        """Some of them."""
        return Exceedances(
            nodes=self.nodes[index], rows=self.rows[index], levels=self.levels[index], lost=self.lost[index]
        )

    def chances(self, response: LinearResponse) -> Array:
        """Lower bounds of the events' probabilities, (M,), of the first cell: 0 where nothing is known."""
        tails = np.exp(log_tail_below(_standard(response, self)[1]))
        return np.asarray(np.maximum(tails * (1 - _ROUND) - self.lost, 0.0))

    def correlations(self, response: LinearResponse) -> Array:
        """Upper bounds of the correlations between the events' rows, (M, M), whatever their levels; none below 0."""
        return _correlations(response, self)

    def union(self, response: LinearResponse, correlations: Array | None = None) -> float:
        """A lower bound of the probability that one of the events occurs, for the first cell of a response.

        ``correlations`` are those of `correlations`, where they are known.
        """
        least = self.chances(response)
        likely = np.flatnonzero(least > 0)
        events, least = self.chosen(likely), least[likely]
        if not len(least):
            return 0.0
        small, _ = _standard(response, events)
        correlation = _correlations(response, events) if correlations is None else correlations[np.ix_(likely, likely)]
        first, second = np.triu_indices(len(least), 1)
        both = np.diag(np.exp(log_tail(small)))
        both[first, second] = np.exp(log_below_above(-small[first], small[second], -correlation[first, second]))
        both[second, first] = both[first, second]
        found = float(np.sum(least**2 / (both.sum(axis=1) * (1 + _ROUND) + 1e-300))) * (1 - _ROUND)
        return min(max(found, float(least.max())), 1.0)


def _standard(response: LinearResponse, events: Exceedances) -> tuple[Array, Array]:
    """Levels in standard deviations of their rows, from below and from above; without noise nothing is above them."""
    low, high = (v[0] for v in response.variance(events.rows[None], events.nodes))
    low = np.maximum(low, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = events.levels / np.sqrt(low), events.levels / np.sqrt(high)
    known = low > 0
    small, large = (np.where(known, end, np.inf) for end in (np.minimum(*ends), np.maximum(*ends)))
    return small * (1 - _ROUND * np.sign(small)), large * (1 + _ROUND * np.sign(large))


def _correlations(response: LinearResponse, events: Exceedances) -> Array:
    """Upper bounds of the correlations between the events' rows at their nodes, (M, M), none below 0."""
    order = np.argsort(-events.nodes, kind="stable")
    nodes, count = events.nodes[order], len(order)
    moved, error = events.rows[order].copy(), np.zeros(count)
    low, _ = (np.maximum(v[0], 0.0) for v in response.variance(events.rows[order][None], nodes))
    size = np.sqrt(low)
    found = np.zeros((count, count))
    begun = 0  # rows whose time has come, going backwards
    for node in range(int(nodes[0]), int(nodes[-1]) - 1, -1):
        poll("covariances of single times")
        here = np.flatnonzero(nodes == node)
        begun += len(here)
        deviation = _deviations(response, node)
        for k in here.tolist():
            own = np.broadcast_to(events.rows[order[k]], (begun, moved.shape[1]))
            at = np.full(begun, node)
            high = response.covariance_of(moved[None, :begun], own[None], at)[1][0]
            high = high + error[:begun] * (np.abs(own[0]) @ deviation) * (1 + _ROUND)
            scale = size[:begun] * size[k]
            with np.errstate(divide="ignore", invalid="ignore"):
                found[:begun, k] = np.where(high > 0, high / scale * (1 + _ROUND), 0.0)
        if node > nodes[-1]:
            forward, slack = response.transition[0, node - 1], float(response.transition_error[0, node - 1])
            size_of = np.abs(moved[:begun])  # what the product leaves out meets the state before it, and never grows
            rest = size_of.sum(axis=1, keepdims=True) * slack + 2 * gamma(len(forward)) * (size_of @ np.abs(forward))
            error[:begun] += rest @ _deviations(response, node - 1) * (1 + _ROUND) + 1e-300
            moved[:begun] = moved[:begun] @ forward
    result = np.zeros((count, count))
    result[np.ix_(order, order)] = np.minimum(np.maximum(found, found.T), 1.0)
    return result


def _deviations(response: LinearResponse, node: int) -> Array:
    """Upper bounds of the standard deviations of all coordinates at a node, (n,)."""
    square = np.diagonal(response.covariance[0, node] + response.covariance_error[0, node])
    return np.asarray(np.sqrt(np.maximum(square, 0.0)) * (1 + _ROUND))
