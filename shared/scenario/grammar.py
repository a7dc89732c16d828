"""Texts of a scenario such as `cost_gap & budget(5, burst=2) | silence(1)`: names with arguments.

    text     := call | text & text | text "|" text | ( text )
    call     := name | name(argument, …)
    argument := value | key=value

`&` binds tighter than `|`. A value is a number, or a word such as the name of a file, which in
quotes may have any character but a quote. Impairments, zones and goals are calls joined by `&`
alone. What may be named stands in the tables of `shared.scenario.registry`.
"""

import re
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

TEXT_MAX = 200
"""Largest number of characters of a trigger, a report, a shape or a vehicle."""
TOKENS_MAX, NESTED_MAX = 200, 100
"""Largest numbers of calls, operators and parentheses, and of opening ones."""

Value = float | str

_QUOTED = r'"[^"]*"'
_TOKEN = re.compile(
    rf"\s*(?:([a-z_]\w*(?:-\w+)*)\s*(?:\(((?:{_QUOTED}|[^()\"])*)\))?|([&|()]))\s*",
    re.IGNORECASE | re.ASCII,
)
"""A call, or an operator or parenthesis between calls."""
_ARGUMENT = re.compile(
    rf"\s*(?:([a-z_]\w*)\s*=)?\s*((?:{_QUOTED}|[^,\"])*?)\s*,", re.IGNORECASE | re.ASCII
)
"""An argument with the comma behind it."""
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE | re.ASCII)


class GrammarError(Exception):
    """Error: a text is not what it should be; says which part of it, and what was expected."""

    def __init__(self, given: str, expected: str) -> None:
        super().__init__(f"got {given!r}, expected {expected}")
        self.given = given
        self.expected = expected


@dataclass(frozen=True, slots=True)
class Call:
    """A name with arguments."""

    name: str
    values: tuple[Value, ...] = ()
    """Arguments as they are written; once a table has bound the call, one for each parameter."""
    keys: tuple[str, ...] = ()
    """Name before the `=` of each argument as written, empty without; none of a bound call."""
    text: str = field(default="", compare=False)
    """The call as it is written."""
    begin: int = field(default=0, compare=False)
    """Index of its first character in the whole text."""

    def __str__(self) -> str:
        arguments = ", ".join(
            f"{each:.15g}" if isinstance(each, float) else str(each) for each in self.values
        )
        return f"{self.name}({arguments})" if arguments else self.name


@dataclass(frozen=True, slots=True)
class Combination:
    """Two texts, joined by & or |."""

    operator: Literal["&", "|"]
    left: "Expression"
    right: "Expression"


Expression = Call | Combination


def parse(text: str, form: str) -> Expression:
    """Calls combined with & and |, as a text has them.

    Args:
        text: what is written.
        form: what is expected, in messages.

    Raises:
        GrammarError: it is no such text.
    """
    tokens = deque(_tokens(text, form))
    if len(tokens) > TOKENS_MAX or tokens.count("(") > NESTED_MAX:
        raise GrammarError(text, form)

    def operand() -> Expression:
        token = tokens.popleft() if tokens else ""
        if token == "(":
            inner = either()
            if not tokens or tokens.popleft() != ")":
                raise GrammarError(text, form)
            return inner
        if isinstance(token, str):
            raise GrammarError(text, form)
        return token

    def joined(operator: Literal["&", "|"], operand: Callable[[], Expression]) -> Expression:
        left = operand()
        while tokens and tokens[0] == operator:
            tokens.popleft()
            left = Combination(operator, left, operand())
        return left

    def either() -> Expression:
        return joined("|", lambda: joined("&", operand))

    found = either()
    if tokens:
        raise GrammarError(text, form)
    return found


def leaves(expression: Expression) -> Iterator[Call]:
    """Calls in an expression, from left to right."""
    match expression:
        case Call():
            yield expression
        case Combination(_, left, right):
            yield from leaves(left)
            yield from leaves(right)


def calls(text: str, form: str) -> list[Call]:
    """Calls joined by & alone, of a text as long as may be; none of an empty one.

    Raises:
        GrammarError: see `parse`.
    """
    if not text.strip():
        return []
    tokens = _tokens(text, form)
    found = [token for token in tokens[::2] if isinstance(token, Call)]
    if len(tokens) != 2 * len(found) - 1 or any(mark != "&" for mark in tokens[1::2]):
        raise GrammarError(text, form)
    return found


def _tokens(text: str, form: str) -> list[Call | str]:
    """Calls, operators and parentheses of a text."""
    found: list[Call | str] = []
    at = 0
    while at < len(text):
        token = _TOKEN.match(text, at)
        if not token:
            raise GrammarError(text, form)
        name, arguments, mark = token.groups()
        found.append(mark or _call(name, arguments, text, token.start(1), token.end()))
        at = token.end()
    return found


def _call(name: str, arguments: str | None, text: str, begin: int, end: int) -> Call:
    """The call at a place of a text, with the arguments between its parentheses."""
    written = f"{arguments}," if arguments and arguments.strip() else ""
    pairs = _ARGUMENT.findall(written)
    values = tuple(_value(word) for _, word in pairs)
    return Call(name, values, tuple(key for key, _ in pairs), text[begin:end].rstrip(), begin)


def _value(word: str) -> Value:
    if NUMBER.fullmatch(word):
        return float(word) if re.search(r"[.e]", word, re.IGNORECASE) else int(word)
    return word[1:-1] if word[:1] == word[-1:] == '"' else word
