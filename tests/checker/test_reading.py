"""What is refused before anything is proved: sizes, depth, numbers that are none, unknown keys."""

from __future__ import annotations

import json
import time

import pytest

from certbound.checker import check_data, parse, read
from certbound.checker.reading import Record, number, numbers, text, whole
from certbound.errors import CertificateError


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ('{"a": ', "no JSON"),
        ("[" * 200_000, "nested too deeply"),
        ('{"a": NaN}', "NaN"),
        ('{"a": -Infinity}', "Infinity"),
        ('{"a": 1e999}', "decimal number"),
        ('{"a": 0.5}', "decimal number"),
        ('{"a": 12345678901234567890}', "20 digits"),
        ('{"a": 1, "a": 2}', "same key twice"),
        ("[1]", "one JSON object"),
        (b"\xff\xfe{}", "no UTF-8"),
    ],
)
def test_content_that_is_no_certificate_is_refused_quickly_in_one_line(content: str | bytes, why: str) -> None:
    started = time.perf_counter()
    with pytest.raises(CertificateError, match=why) as caught:
        parse(content)
    assert time.perf_counter() - started < 2.0
    assert "\n" not in str(caught.value)


def test_a_huge_file_is_refused_by_its_size(tmp_path) -> None:
    huge = tmp_path / "huge.json"
    with huge.open("wb") as stream:
        stream.truncate(100_000_000)
    started = time.perf_counter()
    with pytest.raises(CertificateError, match="95 MiB"):
        read(huge)
    assert time.perf_counter() - started < 2.0
    with pytest.raises(CertificateError, match="longer than 16 MiB"):
        parse(" " * (17 * 2**20))


HUGE = {
    "numbers": '{"a":[' + "0," * 8_000_000 + "0]}",
    "lists": b'{"a":[' + b"[]," * 5_000_000 + b"[]]}",
    "objects": '{"a":[' + "{}," * 1_900_000 + "{}]}",
    "digits": '{"a":' + "9" * 16_000_000 + "}",
    "decimals": '{"a":0.' + "9" * 16_000_000 + "}",
    "text": '{"a":"' + "x" * 16_000_000 + '"}',
    "depth": '{"a":' * 300_000,
}


@pytest.mark.parametrize("kind", HUGE)
def test_whatever_fits_into_16_mib_is_refused_in_time(kind: str) -> None:
    started = time.process_time()
    with pytest.raises(CertificateError) as caught:
        check_data(parse(HUGE[kind]))
    assert time.process_time() - started < 2.0
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("written", ["1.5", "inf", "nan", "0x1.8", "0x1p+0", "1e3", 1, None, "0x1.0p+99999"])
def test_only_exact_hexadecimal_numbers_are_read(written: object) -> None:
    with pytest.raises(CertificateError, match="hexadecimal"):
        number(written, "x")


def test_a_number_beyond_the_doubles_is_refused() -> None:
    with pytest.raises(CertificateError, match="finite"):
        number("0x1.0p+1024", "x")
    with pytest.raises(CertificateError, match="at least 0"):
        number((-1.0).hex(), "x", least=0.0)


@pytest.mark.parametrize("value", [0.1, -1.5, 0.0, 5e-324, 1.7976931348623157e308])
def test_numbers_are_read_exactly(value: float) -> None:
    assert number(value.hex(), "x") == value


def test_shapes_are_checked() -> None:
    one = (1.0).hex()
    assert numbers([[one], [one]], "x", 2, 1) == [[1.0], [1.0]]
    with pytest.raises(CertificateError, match="`x` must have 3 entries"):
        numbers([one], "x", 3)
    with pytest.raises(CertificateError, match=r"`x\[1\]` must be a list"):
        numbers([[one], one], "x", None, None)


def test_records_know_their_keys() -> None:
    with pytest.raises(CertificateError, match="unknown entry `b`"):
        Record({"a": 1, "b": 2}, "r", ("a",))
    with pytest.raises(CertificateError, match="must have `a`"):
        Record({}, "r", ("a",))
    with pytest.raises(CertificateError, match="must be an object"):
        Record([], "r", ())


def test_counts_and_texts_are_bounded() -> None:
    with pytest.raises(CertificateError, match="whole number"):
        whole(True, "x", 0, 1)
    with pytest.raises(CertificateError, match=r"0\.\.3"):
        whole(4, "x", 0, 3)
    with pytest.raises(CertificateError, match="printable"):
        text("a\x1b[31m", "x", 10)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"format": "other"}, "format"),
        ({"version": 99}, "version"),
        ({"proof": {"engine": "python"}}, "engine"),
        ({"proof": []}, "engine"),
        ({"extra": 1}, "unknown entry"),
        ({"claim": {"log10_delta": (1.0).hex(), "method": "", "assumptions": []}}, "must not be positive"),
    ],
)
def test_a_certificate_with_a_wrong_frame_is_malformed(stepping, change: dict, why: str) -> None:
    with pytest.raises(CertificateError, match=why):
        check_data({**stepping.data, **change})


def test_a_path_ends_nowhere_without_a_domain(stepping) -> None:
    """Else the last limit is taken for the domain, and breaking it for no failure."""
    data = stepping.data
    data["problem"] |= {"leaving": "ends", "domain": None}
    with pytest.raises(CertificateError, match="where there is no `domain`"):
        check_data(data)


def test_every_truncation_is_refused(stepping) -> None:
    for length in range(0, len(stepping.text) - 2, max(1, len(stepping.text) // 40)):
        with pytest.raises(CertificateError):
            parse(stepping.text[:length])


def test_a_missing_field_anywhere_is_malformed(stepping) -> None:
    for part in ("problem", "proof", "claim"):
        for name in stepping.data[part]:
            data = stepping.data
            del data[part][name]
            with pytest.raises(CertificateError):
                check_data(data)


def test_a_field_of_a_wrong_kind_anywhere_is_malformed(stepping) -> None:
    for part in ("problem", "proof"):
        for name in stepping.data[part]:
            data = stepping.data
            data[part][name] = {"surprise": [1]}
            if name in ("name", "label"):
                continue
            with pytest.raises(CertificateError) as caught:
                check_data(json.loads(json.dumps(data)))
            assert "\n" not in str(caught.value)
