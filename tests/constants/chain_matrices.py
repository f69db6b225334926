"""The chain of masses as matrices, written down apart from the package's model."""

from __future__ import annotations

import numpy as np

from certbound.constants.jacobians.affine import SectorSet


def chain_sector(masses: int, *, continuous: bool = False) -> SectorSet:
    """A + B Delta C of the chain: the slopes of tanh range over [0, 1] independently."""
    step, stiffness, damping = 0.1, 10.0, 2.0
    coupling = -2 * np.eye(masses) + np.eye(masses, k=1) + np.eye(masses, k=-1)
    coupling[0, 0] = -1.0
    zero, one = np.zeros((masses, masses)), np.eye(masses)
    drift = np.block([[zero, one], [stiffness * coupling, damping * coupling]])
    select = np.hstack([zero, one])
    left = np.vstack([zero, -one])
    low, high = np.zeros(masses), np.ones(masses)
    if continuous:
        return SectorSet(A=drift, B=left, C=select, low=low, high=high)
    return SectorSet(A=np.eye(2 * masses) + step * drift, B=step * left, C=select, low=low, high=high)


NOISE = np.vstack([np.zeros((3, 3)), 0.043 * np.eye(3)])
DIRECTIONS = np.array([[-1, 0, 0, 0, 0, 0], [1, -1, 0, 0, 0, 0], [0, 1, -1, 0, 0, 0], [0, 0, 0, 0, 0, 1.0]])
