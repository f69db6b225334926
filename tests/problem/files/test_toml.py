"""Written TOML reads back as the same data."""

import tomllib

from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.problem.files.toml import toml_text

letters = st.characters(exclude_categories=["Cs"])  # all that UTF-8 has; to ask its codec for each takes a second
words = st.text(letters, max_size=5)
scalars = st.one_of(
    st.booleans(), st.integers(-(2**60), 2**60), st.floats(allow_nan=False), st.text(letters, max_size=8)
)
values = st.recursive(
    scalars,
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(words, inner, max_size=3)),
    max_leaves=6,
)
tables = st.dictionaries(words, values, max_size=3)
documents = st.dictionaries(
    st.text(letters, max_size=6),
    st.one_of(scalars, st.lists(scalars, max_size=3), tables, st.lists(tables, min_size=1, max_size=2)),
    max_size=4,
)


@settings(derandomize=True, deadline=None, max_examples=200)
@given(document=documents)
def test_any_document_survives(document):
    assert tomllib.loads(toml_text(document)) == document


def test_floats_keep_every_bit():
    value = 0.1 + 0.2
    assert tomllib.loads(toml_text({"x": value}))["x"] == value
    assert tomllib.loads(toml_text({"x": float("-inf")}))["x"] == float("-inf")
