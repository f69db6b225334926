"""Plans are written and read by the inputs' names."""

import numpy as np
import pytest

from certbound.problem.files.plans import read_plan, write_plan


def test_a_plan_is_read_in_the_order_of_the_inputs(tmp_path):
    write_plan(tmp_path / "plan.json", [[1.0, 2.0], [3.0, 4.0]], ("u", "w"), cost=3.5)
    np.testing.assert_array_equal(read_plan(tmp_path / "plan.json", ("w", "u")), [[2, 1], [4, 3]])


def test_a_bare_list_of_rows_is_a_plan(tmp_path):
    (tmp_path / "plan.json").write_text("[[1], [2]]")
    np.testing.assert_array_equal(read_plan(tmp_path / "plan.json", ("u",)), [[1], [2]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "must be JSON"),
        ("[" * 100_000, "must be JSON"),
        ('{"plan": [[1]], "inputs": ["v"]}', r"must be for the inputs u, got \['v'\]"),
        ('{"plan": [[1]], "inputs": 3}', "must be for the inputs u, got 3"),
        ('{"plan": [[1, 2]]}', r"must hold rows of 1 numbers, got shape \(1, 2\)"),
        ('{"plan": [["a"]]}', "must hold rows of numbers under 'plan'"),
        ('{"rows": [[1]]}', "must hold rows of 1 numbers"),
    ],
)
def test_other_content_is_refused(content, message, tmp_path):
    (tmp_path / "plan.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        read_plan(tmp_path / "plan.json", ("u",))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"`plan\.file` must be a readable file, got .*none\.json"):
        read_plan(tmp_path / "none.json", ("u",))
