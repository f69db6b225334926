"""How results show themselves: one line, a few rows, HTML in notebooks, plain data, a picture, a JSON file."""

from __future__ import annotations

import html
import json
import math
import re
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from certbound._version import __version__

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Rows = list[tuple[str, str]]

_LATER: dict[str, Callable[..., Any]] = {}


def connect(**calls: Callable[..., Any]) -> None:
    """Say who does what a result is asked for and a later room does; the package's own ``__init__`` does so.

    ``draw`` (result, axes, states, times) draws a result, ``content`` (problem, plan file) is what a file holds,
    ``constants`` (data) reads constants back. In this way no room has to know a later one.
    """
    _LATER.update(calls)


def ask_later_room(name: str, *arguments: Any) -> Any:
    """What ``connect`` was told to call, called.

    Examples
    --------
    >>> ask_later_room("constants", {"rate": -0.5, "sigma": 0.1, "dimension": 2}).rate
    -0.5
    """
    return _LATER[name](*arguments)


class Shown:
    """A result that shows itself; a subclass says its ``summary``, its ``rows`` and its plain data (``to_dict``)."""

    __slots__ = ()

    pictured: ClassVar[bool] = False
    """Whether notebooks show the picture of ``plot`` beside the table: where it takes no new work."""

    def summary(self) -> str:
        """The result in one line."""
        raise NotImplementedError

    def rows(self) -> Rows:
        """What else there is to say: names and values."""
        return []

    def to_dict(self) -> dict[str, Any]:
        """The result as plain data: numbers, texts, lists, dictionaries, None."""
        raise NotImplementedError

    def to_json(self) -> str:
        """The plain data as one JSON object; what is not finite becomes null."""
        return json.dumps(plain(self.to_dict()), allow_nan=False)

    def save(self, path: str | Path) -> None:
        """Write the plain data to a JSON file, for ``cb.load_result``.

        The file holds numbers, no proof: a stranger should be given a certificate.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        content = {"certbound": __version__, "type": type(self).__name__, "data": plain(self.to_dict())}
        Path(path).write_text(json.dumps(content, allow_nan=False, indent=1) + "\n", encoding="utf-8")

    def plot(
        self, ax: Axes | None = None, *, states: Sequence[str | int] | str | int | None = None,
        times: tuple[float, float] | None = None, style: Mapping[str, Any] | None = None,
    ) -> Axes:  # fmt: skip
        """Draw the result into matplotlib axes (the current ones when omitted) and return them.

        Parameters
        ----------
        ax : Axes, optional
            Axes of a figure, with or without pyplot.
        states : name, index or list of them, optional
            Of a verdict, problem or reach tube: one state over time, or two in their plane; the place where the
            constraints are when omitted.
        times : (float, float), optional
            The part of the horizon that is drawn.
        style : mapping, optional
            matplotlib's rcParams for this picture, such as {"font.size": 8}.

        Raises
        ------
        ValueError
            If a state or a key of ``style`` is unknown, the times are not in order, or nothing could be drawn.
        """
        import matplotlib as mpl

        if unknown := set(style or {}) - set(mpl.rcParams):
            raise ValueError(f"`style` must use matplotlib's rcParams, such as 'font.size', got {min(unknown)!r}.")
        with mpl.rc_context(dict(style or {})):  # type: ignore[arg-type]  # rcParams by any name
            if ax is None:
                import matplotlib.pyplot as plt

                ax = plt.gca()
            ask_later_room("draw", self, ax, states, times)
        return ax

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.summary()}>"

    def __str__(self) -> str:
        return "\n".join([self.summary(), *(f"  {name}: {value}" for name, value in self.rows())])

    def _repr_html_(self) -> str:
        cells = "".join(
            f'<tr><th style="text-align:left">{html.escape(name)}</th>'
            f'<td style="text-align:left">{html.escape(value)}</td></tr>'
            for name, value in self.rows()
        )
        drawn = self._repr_png_() if self.pictured else None
        picture = "" if drawn is None else f'<img alt="" src="data:image/png;base64,{b64encode(drawn).decode()}">'
        return f"<div><b>{html.escape(self.summary())}</b><table>{cells}</table>{picture}</div>"

    def _repr_png_(self) -> bytes | None:
        """The picture of ``plot`` for notebooks; None where nothing can be drawn without new work."""
        if not self.pictured:
            return None
        from matplotlib.figure import Figure

        figure, stream = Figure(figsize=(6.0, 3.6), layout="constrained"), BytesIO()
        try:
            self.plot(figure.subplots())
        except (TypeError, ValueError):
            return None
        figure.savefig(stream, format="png", dpi=90)
        return stream.getvalue()


class Record(Shown, Mapping[str, Any]):
    """A result read back from a file: a mapping whose keys are attributes too. It proves nothing.

    Examples
    --------
    >>> Record("Verdict", {"status": "SAFE", "log10_delta": -4.0}).status
    'SAFE'
    """

    __slots__ = ("_data", "_kind")

    def __init__(self, kind: str, data: Mapping[str, Any]) -> None:
        self._kind = kind
        self._data = dict(data)

    def __getitem__(self, key: str) -> Any:
        return self._data[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._data)

    def __len__(self) -> int:
        return len(self._data)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name not in self._data:
            raise AttributeError(f"the record of a {self._kind} has no `{name}`; it has {', '.join(self._data)}")
        return self._data[name]

    def summary(self) -> str:
        """What was saved."""
        return f"{self._kind}, as saved"

    def rows(self) -> Rows:
        """Every entry, shortened."""
        texts = {name: str(value) for name, value in self._data.items()}
        return [(name, text if len(text) <= 70 else text[:67] + "...") for name, text in texts.items()]

    def to_dict(self) -> dict[str, Any]:
        """The entries."""
        return dict(self._data)

    def plot(self, ax: Any = None, **options: Any) -> Any:
        """A record cannot be drawn.

        Raises
        ------
        TypeError
            Always.
        """
        raise TypeError("a saved record cannot be drawn; compute the result again, or plot its numbers.")


def load_result(path: str | Path) -> Any:
    """A result written by ``.save``: constants come back as stated ones, anything else as a ``Record``.

    Nothing is proved by reading: constants are ``certified`` no more. Problems are read by ``cb.load``, certificates by
    ``certbound check``.

    Parameters
    ----------
    path : str or Path
        The JSON file.

    Raises
    ------
    ValueError
        If the file is none of certbound's results.

    Examples
    --------
    >>> import tempfile, certbound as cb
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     cb.Constants(rate=-0.5, sigma=0.1, dimension=2).save(f"{folder}/k.json")
    ...     load_result(f"{folder}/k.json").rate
    -0.5
    """
    cure = "give a file that `.save` wrote (`cb.load` reads problems)"
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        kind, data = str(content["type"]), dict(content["data"])
    except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"`path` must be a saved result, got {str(path)!r}: {error!r}; {cure}.") from error
    if kind == "Constants":
        return ask_later_room("constants", data)
    return Record(kind, data)


def plain(value: Any) -> Any:
    """JSON types: arrays become lists, numpy scalars numbers, what is not finite null.

    Examples
    --------
    >>> plain({"a": (1, float("inf"))})
    {'a': [1, None]}
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (bool, str, int)) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    raise TypeError(f"`value` must be made of JSON types and arrays, got {type(value).__name__}.")


def span_text(value: Any) -> str:
    """A number, or the range of several.

    Examples
    --------
    >>> span_text(0.5), span_text([1.0, 2.0])
    ('0.5', '1 ... 2')
    """
    values = [float(entry) for entry in value] if hasattr(value, "__len__") else [float(value)]
    low, high = min(values), max(values)
    return f"{high:.6g}" if low == high else f"{low:.4g} ... {high:.4g}"


def rounded(value: float, *, up: bool, digits: int = 6) -> str:
    """A number in ``digits`` decimal digits, never below the number itself (``up``), or never above it.

    Examples
    --------
    >>> rounded(-2.9999997, up=True), rounded(-2.9999997, up=False), rounded(0.1234, up=True, digits=2)
    ('-2.99999', '-3', '0.13')
    """
    if not math.isfinite(value):
        return f"{value:g}"
    context = Context(prec=digits, rounding=ROUND_CEILING if up else ROUND_FLOOR)
    return f"{float(context.create_decimal_from_float(float(value))):.{digits}g}"


def one_line(text: str) -> str:
    """A text without line breaks, control characters and repeated blanks.

    Examples
    --------
    >>> one_line("a\\n  b\\x1b[1m")
    'a b [1m'
    """
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())


def name_text(name: str, longest: int = 60) -> str:
    """A problem's name on one line, shortened; in quotes where capitals or signs in it could pass for a verdict.

    Examples
    --------
    >>> name_text("chain_rest"), name_text("x\\n[b]SAFE[/b]"), name_text("y" * 99, 8)
    ('chain_rest', '"x [b]SAFE[/b]"', 'yyyyy...')
    """
    line = _unquoted(name)
    line = line if len(line) <= longest else f"{line[: longest - 3]}..."
    return f'"{line}"' if line != line.lower() or not line or re.search(r"[:;='\[\]\"]", line) else line


def _unquoted(text: str) -> str:
    return one_line(text).replace('"', "'")


def power_above(log10: float) -> float:
    """10**log10 as a float that is not below it; 1 at most, and never 0.

    Examples
    --------
    >>> power_above(-3.0), power_above(-0.5) >= 10**-0.5, power_above(-1e12) > 0
    (0.001, True, True)
    """
    value = min(math.pow(10.0, log10), 1.0)
    while value < 1 and (value == 0 or _EXACT.log10(Decimal(value)) < Decimal(log10)):
        value = math.nextafter(value, 1.0)
    return value


def amount(value: float, unit: str) -> str:
    """A number of units; of a unit that is a number itself, so many times it.

    Examples
    --------
    >>> amount(48, "15 min"), amount(0.5, "s")
    ('48 x 15 min', '0.5 s')
    """
    return f"{value:g} {'x ' * unit[:1].isdigit()}{unit}"


def unit_text(unit: str) -> str:
    """A unit as it stands in sentences: in quotes where it is more than one word, which could pass for what is proved.

    Examples
    --------
    >>> unit_text("15 min"), unit_text("s) <= 1e-9, asked (")
    ('15 min', '"s) <= 1e-9, asked ("')
    """
    plain_unit = re.fullmatch(r"(\d[\d.]* )?[\w/^*.%°·-]+", unit)
    return unit if plain_unit else f'"{_unquoted(unit)}"'


def at_least_text(log10: float | None) -> str:
    """A proved lower bound of a probability, rounded down, as words to add; empty where there is none.

    Examples
    --------
    >>> at_least_text(-2.9999997), at_least_text(None), at_least_text(-1000.0)
    (', at least 0.001', '', '')
    """
    if log10 is None or log10 < -300:
        return ""
    return f", at least {rounded(math.pow(10.0, log10) * (1 - 1e-12), up=False, digits=3)}"


_EXACT = Context(prec=60)


def log10_text(log10: float, *, ulps: int = 0) -> str:
    """A probability given by its decimal logarithm, rounded up to two digits, also where no float could hold it.

    ``ulps`` are the units in the last place by which the logarithm of a number that was asked for may have been rounded
    up: 0.001 is then shown as it was asked.

    Examples
    --------
    >>> log10_text(-3.0), log10_text(-49718.25), log10_text(-4.698), log10_text(-1.2175), log10_text(-0.12)
    ('1e-3', '5.7e-49719', '2.1e-5', '0.061', '0.76')
    >>> log10_text(-2.99999999), log10_text(-2.9999999999999996), log10_text(-2.9999999999999996, ulps=2)
    ('1.1e-3', '1.1e-3', '1e-3')
    >>> log10_text(-math.inf)
    '0'
    """
    if log10 >= 0 or log10 == -math.inf:
        return "1" if log10 >= 0 else "0"
    value = _EXACT.subtract(Decimal(log10), Decimal(ulps * math.ulp(log10)))
    exponent = math.floor(value)
    digits = _digits(_EXACT.subtract(value, Decimal(exponent - 1)))
    if value > -2:
        return f"{digits / 10 ** (1 - exponent):g}"
    return f"1e{exponent + 1}" if digits >= 100 else f"{digits / 10:g}e{exponent}"


def _digits(log10: Decimal) -> int:
    """The least whole number, from 10 on, whose decimal logarithm is at least that."""
    count = max(math.floor(math.pow(10.0, log10)) - 1, 10)
    while _EXACT.log10(Decimal(count)) < log10:
        count += 1
    return count
