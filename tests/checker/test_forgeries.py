"""Every inequality that a proof rests on has a forged certificate that violates just this one: all are refused."""

from __future__ import annotations

import importlib
import re
import time
from pathlib import Path

import pytest

from certbound.checker import check_data, parse
from certbound.errors import CertificateError
from tests.checker import (  # noqa: F401  # they enter themselves
    affine_forgeries,
    backward_forgeries,
    entering_forgeries,
    goal_forgeries,
    lasting_forgeries,
    staged_forgeries,
    turned_forgeries,
    value_forgeries,
    window_forgeries,
)
from tests.checker.forgeries import FORGERIES, forged, report_of, text

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "certificate.md"
SECONDS = 2.0

pytestmark = pytest.mark.usefixtures("kept_tables")


@pytest.mark.parametrize("base", sorted({forgery.base for forgery in FORGERIES.values()}))
def test_what_is_forged_is_proved_before(base: str) -> None:
    report = report_of(base)
    assert report.valid, report.reason


@pytest.mark.parametrize("name", FORGERIES)
def test_a_certificate_that_violates_one_inequality_is_refused_for_it(name: str) -> None:
    forgery, data = FORGERIES[name], forged(name)
    given = parse(text(forgery.base))["problem"] if name == "the problem is the given one" else None
    started = time.process_time()
    try:
        report = check_data(data, given)
        reason = "VALID" if report.valid else report.reason
    except CertificateError as error:
        reason = str(error)
    assert time.process_time() - started < SECONDS
    assert reason != "VALID"
    assert re.search(forgery.reason, reason), reason


def listed() -> list[tuple[str, str, str]]:
    """The rows of the document's list."""
    section = DOCUMENT.read_text(encoding="utf-8").partition("## The inequalities")[2].partition("\n## ")[0]
    rows = [re.fullmatch(r"\| (.+) \| `(.+)` \| `(.+)` \|", line) for line in section.splitlines()]
    return [(row[1], row[2], row[3]) for row in rows if row is not None]


def test_the_document_lists_the_same_inequalities() -> None:
    assert listed() == [(name, forgery.file, forgery.place) for name, forgery in FORGERIES.items()]


@pytest.mark.parametrize(("file", "place"), sorted({(f.file, f.place) for f in FORGERIES.values()}))
def test_every_inequality_is_where_the_document_says(file: str, place: str) -> None:
    found = importlib.import_module(f"certbound.checker.{file.removesuffix('.py').replace('/', '.')}")
    for part in place.split("."):
        found = getattr(found, part)
    assert callable(found)
