"""Numbers, settings and paths from the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer

from certbound.cli.messages import InputError
from certbound.cli.options import check_writable, integer, number, settings_of


def test_numbers_may_be_written_with_an_exponent() -> None:
    assert number("1e6") == 1e6
    assert integer("1e6") == 1_000_000


@pytest.mark.parametrize("text", ["nan", "NaN", "inf", "-inf", "one", "", "1,5", "0x10"])
def test_what_is_no_finite_number_is_refused(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="must be a"):
        number(text)


def test_a_broken_count_is_refused() -> None:
    with pytest.raises(typer.BadParameter, match="must be a whole number"):
        integer("1.5")


def test_settings_are_read_as_numbers() -> None:
    assert settings_of(["sigma=2e-2", "v=-1"]) == {"sigma": 0.02, "v": -1.0}
    assert settings_of(None) == {}


@pytest.mark.parametrize("pair", ["sigma", "sigma=", "=1", "sigma=nan", "sigma=big"])
def test_a_malformed_setting_is_refused_with_an_example(pair: str) -> None:
    with pytest.raises(InputError, match=r"write for example --set sigma=0\.02"):
        settings_of([pair])


def test_a_key_given_twice_is_refused() -> None:
    with pytest.raises(InputError, match="given twice"):
        settings_of(["sigma=1", "sigma=2"])


def test_an_output_that_cannot_be_written_is_refused_before_any_work(tmp_path: Path) -> None:
    check_writable(None, tmp_path / "new.json")
    with pytest.raises(InputError, match="does not exist"):
        check_writable(tmp_path / "missing" / "new.json")
    with pytest.raises(InputError, match="is a directory"):
        check_writable(tmp_path)
