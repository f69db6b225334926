"""What a user takes from ``certbound.constants``."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from certbound import constants


@pytest.mark.parametrize("name", constants.__all__)
def test_every_name_is_there_and_documented(name):
    found = getattr(constants, name)
    assert callable(found)
    assert found.__doc__
    assert name in constants.__doc__
    assert name in dir(constants)


def test_norms_are_one_import_away():
    from certbound.constants import induced_norm, matrix_measure

    A = [[-2.0, 1.0], [0.0, -3.0]]
    assert [matrix_measure(A, p) for p in (1, np.inf)] == [-2.0, -1.0]
    assert matrix_measure(A, 1, weights=[0.25, 1.0]) == -2.0
    assert induced_norm(A, 1) == 4.0


def test_unknown_names_are_refused_and_nothing_slow_is_loaded():
    with pytest.raises(AttributeError, match="no attribute 'bound_speed'"):
        _ = constants.bound_speed
    code = "import sys, certbound.constants; print([m for m in ('casadi', 'cvxpy', 'control') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"
