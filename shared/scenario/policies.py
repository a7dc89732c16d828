"""Triggers and reports as a scenario writes them: `cost_gap & budget(5, 2) | silence(1)`.

    trigger := policy | trigger & trigger | trigger "|" trigger | ( trigger )
    policy  := name | name(number, …)

`&` binds tighter than `|`, as in Python, whose parser reads it; nothing is evaluated. The policies
that there are stand in `shared.scenario.registry`. A shape with numbers, as in `spiral(3)`, is
written like a policy by itself.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from skytether.shared.base.hint import hint
from skytether.shared.scenario.registry import TRIGGERS, PluginTable

TEXT_MAX = 200
"""Largest number of characters of a trigger."""
PERIOD_MAX = 1_000_000
"""Largest number of steps from one horizon to the next."""

_TOKENS = re.compile(
    r"(?:[\s&|(),]|[a-z_]\w*\b|-?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?(?![\w.]))*",
    re.ASCII | re.IGNORECASE,
)
"""Operators, names and numbers: nothing else that Python has gets as far as its parser."""


class PolicyError(Exception):
    """Error: a text is no trigger."""

    def __init__(self, given: str, expected: str) -> None:
        super().__init__(f"got {given!r}, expected {expected}")
        self.given = given
        self.expected = expected


@dataclass(frozen=True, slots=True)
class Policy:
    """A policy by itself, or a shape."""

    name: str
    values: tuple[float, ...]
    """Arguments as written; empty where it stands without."""

    def __str__(self) -> str:
        numbers = f"({', '.join(f'{value:.15g}' for value in self.values)})" if self.values else ""
        return f"{self.name}{numbers}"


@dataclass(frozen=True, slots=True)
class Combination:
    """Two triggers, of which both (&) or either (|) must want to send."""

    operator: Literal["&", "|"]
    left: "Expression"
    right: "Expression"


Expression = Policy | Combination


def parse(text: str, table: PluginTable = TRIGGERS) -> Expression:
    """The trigger that a text describes, or another combination of a table's policies.

    Raises:
        PolicyError: with the part of it that is wrong.
    """
    return _expression(_tree(text, table), table)


def shape(text: str, table: PluginTable) -> Policy:
    """Entry of a table that a text names, with its numbers.

    Raises:
        PolicyError: with the part of it that is wrong.
    """
    if text in table:  # a name with a hyphen is no name to Python
        return _policy(text, table, text, [])
    found = _expression(_tree(text, table), table)
    if not (isinstance(found, Policy) and found.values):  # a bare name is in the table, or none
        raise PolicyError(text, table.form)
    return found


def policies(expression: Expression) -> Iterator[Policy]:
    """Policies in a trigger, from left to right."""
    match expression:
        case Policy():
            yield expression
        case Combination(_, left, right):
            yield from policies(left)
            yield from policies(right)


def _tree(text: str, table: PluginTable) -> ast.expr:
    line = " ".join(text.split())
    if len(text) > TEXT_MAX or not _TOKENS.fullmatch(line):
        raise PolicyError(text, table.form)
    try:
        return ast.parse(line, mode="eval").body
    except SyntaxError:
        raise PolicyError(text, table.form) from None


def _expression(node: ast.expr, table: PluginTable) -> Expression:
    match node:
        case ast.BinOp(left, ast.BitAnd(), right):
            return Combination("&", _expression(left, table), _expression(right, table))
        case ast.BinOp(left, ast.BitOr(), right):
            return Combination("|", _expression(left, table), _expression(right, table))
        case ast.Name(name):
            return _policy(ast.unparse(node), table, name, [])
        case ast.Call(ast.Name(name), arguments):
            return _policy(ast.unparse(node), table, name, arguments)
    raise PolicyError(ast.unparse(node), table.form)


def _policy(text: str, table: PluginTable, name: str, arguments: list[ast.expr]) -> Policy:
    entry = table.get(name)
    if entry is None:
        raise PolicyError(text, f"a {table.kind}; {hint(name, table)}")
    values = [_number(argument) for argument in arguments]
    if not entry.takes(values):
        raise PolicyError(text, entry.form(name))
    return Policy(name, tuple(values))


def _number(node: ast.expr) -> Any:
    """Value of an argument that is a constant; a number may have a minus before it."""
    match node:
        case ast.Constant(value):
            return value
        case ast.UnaryOp(ast.USub(), ast.Constant(int() | float() as value)):
            return -value
    return None
