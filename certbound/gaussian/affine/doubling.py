"""Transition matrices and Gramians of a constant slope over halves of halves of the horizon, in ball arithmetic.

F(h) = exp(A h), Q(h) = int_0^h F(t) M F(t)^T dt for h = T/2^l. Where ||A|| h <= 1/2 the exponential of Van Loan's
matrix gives both; longer steps follow by F(2h) = F(h)^2 and Q(2h) = Q(h) + F(h) Q(h) F(h)^T. A product of balls
widens them by a factor that depends on the entries alone, so that some bits a doubling pay for any stiffness and any
horizon; whoever reads a result sees whether they sufficed.
"""

from __future__ import annotations

from flint import arb, arb_mat

from certbound.watch import poll


def norm_of(matrix: arb_mat) -> float:
    """About the largest absolute row sum."""
    rows, columns = matrix.nrows(), matrix.ncols()
    return max((sum(abs(float(matrix[i, j].mid())) for j in range(columns)) for i in range(rows)), default=0.0)


class Doubling:
    """F and Q for the steps T/2^l, each computed when it is first asked for."""

    def __init__(self, slope: arb_mat, sources: dict[str, arb_mat], horizon: float) -> None:
        self.slope, self.sources, self.horizon = slope, sources, arb(horizon)
        self.mild, turn = 0, norm_of(slope) * horizon
        while turn > 0.5:
            self.mild, turn = self.mild + 1, turn / 2
        self._transitions: dict[int, arb_mat] = {}
        self._gramians: dict[tuple[str, int], arb_mat] = {}

    def step(self, level: int) -> arb:
        """The length T/2^l."""
        return self.horizon * arb(2) ** (-level)

    def transition(self, level: int) -> arb_mat:
        """F(T/2^l)."""
        if level not in self._transitions:
            poll("transition matrices")
            if level >= self.mild:
                self._transitions[level] = (self.slope * self.step(level)).exp()
            else:
                half = self.transition(level + 1)
                self._transitions[level] = half * half
        return self._transitions[level]

    def gramian(self, name: str, level: int) -> arb_mat:
        """Q(T/2^l) of the source of that name."""
        key = name, level
        if key not in self._gramians:
            poll("covariances")
            if level >= self.mild:
                self._gramians[key] = self._first(self.sources[name], level)
            else:
                half, moved = self.gramian(name, level + 1), self.transition(level + 1)
                self._gramians[key] = half + moved * half * moved.transpose()
        return self._gramians[key]

    def _first(self, source: arb_mat, level: int) -> arb_mat:
        """By the exponential of [[-A, M], [0, A^T]] h (Van Loan, 1978)."""
        n, h = self.slope.nrows(), self.step(level)
        entries = [[arb(0)] * (2 * n) for _ in range(2 * n)]
        for i in range(n):
            for j in range(n):
                entries[i][j], entries[n + j][n + i] = -self.slope[i, j] * h, self.slope[i, j] * h
                entries[i][n + j] = source[i, j] * h
        power = arb_mat(entries).exp()
        forward = arb_mat([[power[n + j, n + i] for j in range(n)] for i in range(n)])
        return forward * arb_mat([[power[i, n + j] for j in range(n)] for i in range(n)])
