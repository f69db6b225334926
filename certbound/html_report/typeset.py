"""Expressions of problem files as MathML, which browsers draw without any script.

What cannot be read is shown as it is written: typesetting proves nothing and refuses nothing.
"""

from __future__ import annotations

import ast
import html
import re

GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "zeta": "ζ", "eta": "η", "theta": "θ",
    "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "xi": "ξ", "pi": "π", "rho": "ρ", "sigma": "σ", "tau": "τ",
    "phi": "φ", "chi": "χ", "psi": "ψ", "omega": "ω",
}  # fmt: skip
_SIGNS: dict[type[ast.operator], tuple[str, int]] = {
    ast.Add: ("+", 1), ast.Sub: ("−", 1), ast.Mult: ("", 2), ast.Div: ("/", 2),
}  # fmt: skip
_FRACTION = 24  # characters above which a quotient stays on one line
_CLOSED = 5


def formula(text: str) -> str:
    """The MathML of an expression, without ``<math>``.

    Examples
    --------
    >>> formula("-x1**2")
    '<mrow><mo>−</mo><msup><msub><mi>x</mi><mn>1</mn></msub><mn>2</mn></msup></mrow>'
    """
    try:
        return _node(ast.parse(text.strip(), mode="eval").body)[0]
    except (SyntaxError, ValueError, RecursionError):
        return f"<mtext>{html.escape(text)}</mtext>"


def block(rows: list[tuple[str, str]]) -> str:
    """Equations under each other, aligned at their signs: left and right sides are MathML."""
    cells = "".join(
        f'<mtr><mtd class="left">{left}</mtd><mtd><mo>=</mo></mtd><mtd class="right">{right}</mtd></mtr>'
        for left, right in rows
    )
    return f'<math display="block"><mtable>{cells}</mtable></math>'


def name(word: str) -> str:
    """A name: Greek letters by their names, figures at its end as an index.

    Examples
    --------
    >>> name("theta_1"), name("px")
    ('<msub><mi>θ</mi><mn>1</mn></msub>', '<mi>px</mi>')
    """
    stem, index = re.fullmatch(r"(.*?)_?(\d*|(?<=_)\w+)", word).groups()  # type: ignore[union-attr]  # it matches all
    if not stem:
        stem, index = word, ""
    letter = f"<mi>{html.escape(GREEK.get(stem, stem))}</mi>"
    if not index:
        return letter
    kind = "mn" if index.isdigit() else "mi"
    return f"<msub>{letter}<{kind}>{html.escape(index)}</{kind}></msub>"


def _node(node: ast.expr) -> tuple[str, int]:
    """MathML, and how strongly it binds: 1 a sum, 2 a product, 3 a sign, 4 a power."""
    match node:
        case ast.Constant(value=int() | float() as value):
            return f"<mn>{value:.6g}</mn>", _CLOSED
        case ast.Name(id=word):
            return name(word), _CLOSED
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            return f"<mrow><mo>−</mo>{_bracketed(inner, 2)}</mrow>", 3
        case ast.UnaryOp(op=ast.UAdd(), operand=inner):
            return _node(inner)
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            return f"<msup>{_bracketed(left, _CLOSED)}{_node(right)[0]}</msup>", 4
        case ast.BinOp(left=left, op=op, right=right):
            return _binary(left, op, right)
        case ast.Call(func=ast.Name(id="sqrt"), args=[inner]):
            return f"<msqrt>{_node(inner)[0]}</msqrt>", _CLOSED
        case ast.Call(func=ast.Name(id="abs"), args=[inner]):
            return f"<mrow><mo>|</mo>{_node(inner)[0]}<mo>|</mo></mrow>", _CLOSED
        case ast.Call(func=ast.Name(id=function), args=arguments):
            inside = "<mo>,</mo>".join(_node(argument)[0] for argument in arguments)
            return f"<mrow><mi>{html.escape(function)}</mi>{_brackets(inside)}</mrow>", _CLOSED
    raise ValueError("this is no expression of a problem file.")


def _binary(left: ast.expr, op: ast.operator, right: ast.expr) -> tuple[str, int]:
    sign, strength = _SIGNS[type(op)]
    if isinstance(op, ast.Div) and len(ast.unparse(left)) + len(ast.unparse(right)) <= _FRACTION:
        return f"<mfrac>{_node(left)[0]}{_node(right)[0]}</mfrac>", _CLOSED
    between = f"<mo>{sign}</mo>"
    if isinstance(op, ast.Mult):
        between = "<mo>·</mo>" if isinstance(right, ast.Constant) else '<mspace width="0.17em"/>'
    return f"<mrow>{_bracketed(left, strength)}{between}{_bracketed(right, strength + 1)}</mrow>", strength


def _bracketed(node: ast.expr, least: int) -> str:
    text, strength = _node(node)
    return text if strength >= least else _brackets(text)


def _brackets(inner: str) -> str:
    """Brackets that grow with fractions only."""
    grows = "" if "<mfrac" in inner else ' stretchy="false"'
    return f"<mrow><mo{grows}>(</mo>{inner}<mo{grows}>)</mo></mrow>"
