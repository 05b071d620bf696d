"""Expressions from text: values, refusals with a caret, and hostile input."""

import math

import casadi
import pytest

from simulators.expression import MAX_DEPTH, MAX_LENGTH, ExpressionError, parse, symbols_used

NAMES = ("x", "y", "omega", "φ")
VALUES = {"x": 0.7, "y": -1.3, "omega": 2.5, "φ": 0.2}


def value(text: str, kind: type = casadi.SX) -> float:
    symbols = {name: kind.sym(name) for name in NAMES}
    function = casadi.Function("f", [*symbols.values()], [parse(text, symbols, kind)])
    return float(function(*VALUES.values()))


x, y, omega, phi = VALUES.values()


@pytest.mark.parametrize("kind", [casadi.SX, casadi.MX])
@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 + 2*3 - 4/8", 6.5),
        ("-x**2", -(x**2)),
        ("2**-1", 0.5),
        ("2**3**2", 512.0),
        ("(x - y)*omega/x", (x - y) * omega / x),
        ("+x - -y", x + y),
        ("1e-20*x", 1e-20 * x),
        ("2*pi", 2 * math.pi),
        ("φ", phi),
        ("sin(x) + cos(x) + tan(x)", math.sin(x) + math.cos(x) + math.tan(x)),
        ("asin(x) - acos(x) + atan(x)", math.asin(x) - math.acos(x) + math.atan(x)),
        ("sinh(x) + 2*cosh(x) + 3*tanh(x)", math.sinh(x) + 2 * math.cosh(x) + 3 * math.tanh(x)),
        ("atan2(y, x)", math.atan2(y, x)),
        ("exp(x) + log(x) + sqrt(x)", math.exp(x) + math.log(x) + math.sqrt(x)),
        ("abs(y) + 10*sign(y)", abs(y) - 10),
        ("min(x, y)", y),
        ("max(x, y, omega)", omega),
        ("where(x > y, omega, 7)", omega),
        ("where(x < y, omega, 7)", 7.0),
        ("where(0 < x < 1, 2, 3) + 10*where(0 < x < 0.5, 2, 3)", 32.0),
        ("(x >= x) + 2*(x <= y) + 4*(x == x) + 8*(x != x)", 5.0),
        ("where(min(x > 0, y > 0), 1, 2) + 10*where(max(x > 0, y > 0), 1, 2)", 12.0),
        ("x\n  + y", x + y),
    ],
)
def test_value(text: str, expected: float, kind: type) -> None:
    assert value(text, kind) == pytest.approx(expected, rel=1e-14)


def test_symbols_used() -> None:
    assert symbols_used("m*g*l*sin(phi) + C_m*u - 2*pi*max(u, 0)") == {"m", "g", "l", "phi", "C_m", "u"}
    with pytest.raises(ExpressionError, match="not a formula"):
        symbols_used("m*")


@pytest.mark.parametrize(
    ("text", "caret", "message"),
    [
        ("x + omgea*y", 4, "unknown name 'omgea'; known here: .*Did you mean omega"),
        ("x*sqt(y)", 2, "'sqt' is no function here; .*Did you mean sqrt"),
        ("x*omega(y)", 2, "'omega' is a quantity, not a function"),
        ("φ*φ*zz", 4, "unknown name 'zz'"),
        ("x + sin", 4, r"sin is a function: write sin\(...\)"),
        ("atan2(x)", 0, "atan2 takes 2 argument.s., 1 given"),
        ("sin(x, y)", 0, "sin takes 1 argument.s., 2 given"),
        ("min(x)", 0, "min takes 2 or more argument.s., 1 given"),
        ("where(x > 0, y)", 0, "where takes 3 argument.s., 2 given"),
        ("x > 0 and y > 0", 0, r"`and` and `or` are not allowed: use where\(condition, a, b\).*min\(a, b\) is `and`"),
        ("1 + (x or y)", 5, r"`and` and `or` are not allowed"),
        ("not x", 0, r"`not` is not allowed: use where.* 1 - a is `not`"),
        ("(x > 0) & (y > 0)", 0, "`&` is not allowed"),
        ("(x > 0) | (y > 0)", 0, "`[|]` is not allowed"),
        ("x + y # sum", 6, "a comment is not allowed"),
        ("x^2", 0, r"write \*\* for a power"),
        ("1 if x > 0 else 2", 0, r"write where\(condition, a, b\)"),
        ("x = 2", 2, "not a formula"),
        ("x +", 3, "not a formula"),
        ("y + 1/0", 4, "not a finite number"),
        ("x + True", 4, "a number or a name is expected, not True"),
    ],
)
def test_refusal_points_at_the_place(text: str, caret: int, message: str) -> None:
    with pytest.raises(ExpressionError, match=message) as caught:
        value(text)
    *_, shown, mark = str(caught.value).split("\n")
    assert shown == f"  {text}"
    assert mark == " " * (caret + 2) + "^"


def test_refusal_far_to_the_right_keeps_its_caret() -> None:
    with pytest.raises(ExpressionError) as caught:
        value("x + " * 50 + "nope + " + "x" * 50)
    *_, shown, mark = str(caught.value).split("\n")
    assert shown[mark.index("^") :].startswith("nope")


def test_empty_and_long() -> None:
    with pytest.raises(ExpressionError, match="the expression is empty"):
        value("  \n ")
    with pytest.raises(ExpressionError, match=f"characters, {MAX_LENGTH} are allowed: write the system as a Python"):
        value("x + " * MAX_LENGTH + "x")
    with pytest.raises(ExpressionError, match=f"more than {MAX_DEPTH} nested operations: add brackets"):
        value("+".join(["x"] * (MAX_DEPTH + 2)))
    assert value("+".join(["x"] * MAX_DEPTH)) == pytest.approx(MAX_DEPTH * x)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "().__class__.__bases__[0].__subclasses__()",
        "x.__class__",
        "__builtins__",
        "__x__",
        "open('/etc/passwd')",
        "eval('1')",
        "exec('1')",
        "getattr(x, 'name')",
        "sin.__call__(x)",
        "sin(x).sym('a')",
        "sin(x)(y)",
        "(lambda: 1)()",
        "lambda x: x",
        "[x for x in (1, 2)]",
        "{x: y}",
        "{x}",
        "(x, y)",
        "[x, y]",
        "x[0]",
        "f'{x}'",
        "'x'",
        "b'x'",
        "x + 'y'",
        "None",
        "...",
        "True",
        "1j",
        "x; y",
        "import os",
        "(y := 3)",
        "sin(*x)",
        "sin(**{})",
        "where(cond=x, a=1, b=2)",
        "atan2(y, x=1)",
        "x if y else omega",
        "x @ y",
        "x // y",
        "x % y",
        "x << 2",
        "~x",
        "x is y",
        "x in y",
        "await x",
        "yield x",
        "9**9**9",
        "9.0**9**9**9",
        "9**9**9*x",
        "1e999",
        "0/0*x",
        "log(0)*x",
        "sqrt(-1) + x",
        "9" * 400,
        "9" * MAX_LENGTH,
        "0x" + "f" * 300,
        "(" * 500 + "x" + ")" * 500,
        "-" * 1500 + "x",
        "sin(" * 150 + "x" + ")" * 150,
        "**".join(["9"] * 900),
        "x" * MAX_LENGTH,
        "x\0",
        "\ud800",
        "\x1b[31mx",
        "x" + "()" * 200,
        "x # comment\n+ nothing",
    ],
)
def test_hostile_is_refused(text: str) -> None:
    with pytest.raises(ExpressionError) as caught:
        value(text)
    assert str(caught.value).isprintable() or "\n" in str(caught.value)
    assert "\x1b" not in str(caught.value)
    assert "\0" not in str(caught.value)
