"""Grammar of texts in a scenario such as `cost_gap & budget(5, burst=2) | silence(1)`.

    text     := call | text & text | text "|" text | ( text )
    call     := name | name(argument, …)
    argument := value | key=value

`&` binds tighter than `|`. A value is a number or a word, such as a file name; in quotes it may
have any character except a quote. Impairments, zones and goals are calls joined by `&` only. The
tables in `shared.scenario.registry` list the names.
"""

import re
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

TEXT_MAX = 200
"""Largest number of characters of a trigger, report, shape, scheme or vehicle."""
TOKENS_MAX, NESTED_MAX = 200, 100
"""Largest number of tokens (calls, operators and parentheses), and of opening parentheses."""

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
"""An argument and the comma after it."""
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE | re.ASCII)


class GrammarError(Exception):
    """Error in a text: the invalid part, and the expected form."""

    def __init__(self, given: str, expected: str) -> None:
        super().__init__(f"got {given!r}, expected {expected}")
        self.given = given
        self.expected = expected


@dataclass(frozen=True, slots=True)
class Call:
    name: str
    values: tuple[Value, ...] = ()
    """Arguments as written; after `PluginTable` has bound the call, one for each parameter."""
    keys: tuple[str, ...] = ()
    """Name of each argument, empty for a positional one; no names after binding."""
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

    expression = either()
    if tokens:
        raise GrammarError(text, form)
    return expression


def leaves(expression: Expression) -> Iterator[Call]:
    """Calls in an expression, from left to right."""
    match expression:
        case Call():
            yield expression
        case Combination(_, left, right):
            yield from leaves(left)
            yield from leaves(right)


def calls(text: str, form: str) -> list[Call]:
    """Parse calls joined by & only; an empty text has none. The text's length is not limited.

    Raises:
        GrammarError: see `parse`.
    """
    if not text.strip():
        return []
    tokens = _tokens(text, form)
    parsed = [token for token in tokens[::2] if isinstance(token, Call)]
    if len(tokens) != 2 * len(parsed) - 1 or any(mark != "&" for mark in tokens[1::2]):
        raise GrammarError(text, form)
    return parsed


def _tokens(text: str, form: str) -> list[Call | str]:
    tokens: list[Call | str] = []
    at = 0
    while at < len(text):
        token = _TOKEN.match(text, at)
        if not token:
            raise GrammarError(text, form)
        name, arguments, mark = token.groups()
        tokens.append(mark or _call(name, arguments, text, token.start(1), token.end()))
        at = token.end()
    return tokens


def _call(name: str, arguments: str | None, text: str, begin: int, end: int) -> Call:
    terminated = f"{arguments}," if arguments and arguments.strip() else ""
    pairs = _ARGUMENT.findall(terminated)
    values = tuple(_value(word) for _, word in pairs)
    return Call(name, values, tuple(key for key, _ in pairs), text[begin:end].rstrip(), begin)


DIGITS_MAX = 300
"""Largest number of digits of a whole number; a longer one becomes a float, mostly infinite."""


def _value(word: str) -> Value:
    if NUMBER.fullmatch(word):
        # Python makes no whole number of more than 4300 digits; nothing here takes so large a one.
        is_whole = len(word) <= DIGITS_MAX and not re.search(r"[.e]", word, re.IGNORECASE)
        return int(word) if is_whole else float(word)
    return word[1:-1] if word[:1] == word[-1:] == '"' else word
