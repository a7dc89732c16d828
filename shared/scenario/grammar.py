"""Grammar of texts in a scenario such as `cost_gap & budget(5, burst=2) | silence(1)`.

    text     := call | text & text | text "|" text | ( text )
    call     := name | name(argument, …)
    argument := value | key=value

`&` binds tighter than `|`. A value is a number or a word, such as a file name; a value in quotes
may have any character except a quote. Impairments, zones and goals are calls joined by `&` only.
The tables in `shared.scenario.registry` list the names.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

TEXT_MAX = 200
"""Largest number of characters in the text of a trigger, report, shape, scheme or vehicle."""
CALLS_MAX, NESTED_MAX = 100, 100
"""Largest number of calls in a text, and of opening parentheses that are not part of a call."""

Value = float | str

_QUOTED = r'"[^"]*"'
_CALL = re.compile(
    rf"([a-z_]\w*(?:-\w+)*)(?:\s*\(((?:{_QUOTED}|[^()\"])*)\))?", re.IGNORECASE | re.ASCII
)
_ARGUMENT = re.compile(
    rf"\s*(?:([a-z_]\w*)\s*=)?\s*((?:{_QUOTED}|[^,\"])*?)\s*,", re.IGNORECASE | re.ASCII
)
"""Pattern of an argument and the comma after it."""
_BETWEEN = re.compile(r"[\s&|()_]*", re.ASCII)
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE | re.ASCII)


class GrammarError(Exception):
    """Error in a text of a scenario. `given` is the invalid part, `expected` the expected form."""

    def __init__(self, given: str, expected: str) -> None:
        super().__init__(f"got {given!r}, expected {expected}")
        self.given = given
        self.expected = expected


@dataclass(frozen=True, slots=True)
class Call:
    name: str
    values: tuple[Value, ...] = ()
    """Arguments as written; after `PluginTable` has bound the call, one value per parameter."""
    keys: tuple[str, ...] = ()
    """Name of each argument, empty for a positional argument. After binding, the tuple is empty."""
    text: str = field(default="", compare=False)
    begin: int = field(default=0, compare=False)
    """Index of the call's first character in the text."""

    def __str__(self) -> str:
        arguments = ", ".join(
            f"{each:.15g}" if isinstance(each, float) else str(each) for each in self.values
        )
        return f"{self.name}({arguments})" if arguments else self.name


@dataclass(frozen=True, slots=True)
class Combination:
    operator: Literal["&", "|"]
    left: "Expression"
    right: "Expression"


Expression = Call | Combination


def parse(text: str, form: str) -> Expression:
    """Parse calls combined with & and |; `form` is the expected form of the text, for messages.

    Raises:
        GrammarError: the text is invalid.
    """
    found, between = _calls(text, form)
    if len(found) > CALLS_MAX or between.count("(") > NESTED_MAX:
        raise GrammarError(text, form)
    # Python parses `between`, which has only operators, parentheses and a name for each call: in
    # Python & and | have the same precedence as here.
    rest = iter(found)

    def expression(node: ast.expr) -> Expression:
        match node:
            case ast.BinOp(left, ast.BitAnd(), right):
                return Combination("&", expression(left), expression(right))
            case ast.BinOp(left, ast.BitOr(), right):
                return Combination("|", expression(left), expression(right))
            case ast.Name():
                return next(rest)
        raise GrammarError(text, form)

    try:
        return expression(ast.parse(between, mode="eval").body)
    except SyntaxError:
        raise GrammarError(text, form) from None


def leaves(expression: Expression) -> Iterator[Call]:
    """Calls in an expression, from left to right."""
    match expression:
        case Call():
            yield expression
        case Combination(_, left, right):
            yield from leaves(left)
            yield from leaves(right)


def calls(text: str, form: str) -> list[Call]:
    """Parse calls joined by & only; an empty text has no calls. The text may have any length.

    Raises:
        GrammarError: see `parse`.
    """
    if not text.strip():
        return []
    found, between = _calls(text, form)
    if between != " & ".join("_" * len(found)):
        raise GrammarError(text, form)
    return found


def _calls(text: str, form: str) -> tuple[list[Call], str]:
    """Calls in a text, and the text with each call replaced by _."""
    found = []

    def note(match: re.Match[str]) -> str:
        name, arguments = match.groups()
        terminated = f"{arguments}," if arguments and arguments.strip() else ""
        pairs = _ARGUMENT.findall(terminated)
        values = tuple(_value(word) for _, word in pairs)
        keys = tuple(key for key, _ in pairs)
        found.append(Call(name, values, keys, match[0], match.start()))
        return " _ "

    between = _CALL.sub(note, text)
    if not _BETWEEN.fullmatch(between):
        raise GrammarError(text, form)
    return found, " ".join(between.split())


DIGITS_MAX = 300
"""Largest number of digits of a whole number. A longer number becomes a float, usually infinite."""


def _value(word: str) -> Value:
    if NUMBER.fullmatch(word):
        # Python refuses whole numbers of more than 4300 digits; no parameter needs them.
        is_whole = len(word) <= DIGITS_MAX and not re.search(r"[.e]", word, re.IGNORECASE)
        return int(word) if is_whole else float(word)
    return word[1:-1] if word[:1] == word[-1:] == '"' else word
