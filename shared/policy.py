"""Triggers as a scenario writes them: `cost_gap & budget(5, 2) | silence(1)`.

    trigger := policy | trigger & trigger | trigger "|" trigger | ( trigger )
    policy  := name | name(number, …)

`&` binds tighter than `|`, as in Python, whose parser reads it; nothing is evaluated. Here is what
can be written, and `server/trigger.py` has what it does.
"""

import ast
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from shared.hint import hint

TEXT_MAX = 200
"""Largest number of characters of a trigger."""
PERIOD_MAX = 1_000_000
"""Largest number of steps from one horizon to the next."""

FORM = "policies such as 'state_gap & budget(5, 2) | silence(1)'"

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
class Parameter:
    """A number that a policy takes."""

    name: str
    low: float
    high: float = math.inf
    """Largest value; it is finite in any case."""
    whole: bool = False
    key: str = ""
    """Key of `ControlConfig` whose value it has where the policy stands without arguments."""

    def takes(self, value: Any) -> bool:
        """Whether the parameter may have this value."""
        kinds = (int,) if self.whole else (int, float)
        return type(value) in kinds and self.low <= value <= self.high and math.isfinite(value)

    def __str__(self) -> str:
        high = f" <= {self.high}" if math.isfinite(self.high) else ""
        return f"{self.low} <= {self.name}{high}{' (whole)' * self.whole}"


@dataclass(frozen=True, slots=True)
class Signature:
    """Name and parameters of a policy."""

    parameters: tuple[Parameter, ...] = ()
    schemes: tuple[str, ...] = ()
    """Schemes in which there is what it compares; empty for all."""

    def takes(self, values: Sequence[Any]) -> bool:
        """Whether these arguments are allowed; none at all where a key has the value of each."""
        if not values and all(parameter.key for parameter in self.parameters):
            return True
        return len(values) == len(self.parameters) and all(
            parameter.takes(value) for parameter, value in zip(self.parameters, values, strict=True)
        )

    def form(self, name: str) -> str:
        """What may be written of a policy with this name."""
        if not self.parameters:
            return name
        called = f"{name}({', '.join(parameter.name for parameter in self.parameters)})"
        bare = f"{name} or " if self.takes(()) else ""
        return f"{bare}{called} with {' and '.join(map(str, self.parameters))}"


SIGNATURES = {
    "always": Signature(),
    "periodic": Signature((Parameter("N", 1, PERIOD_MAX, whole=True, key="period"),)),
    "state_gap": Signature(
        (Parameter("epsilon", 0, key="epsilon"), Parameter("decay_rate", 0, key="decay_rate")),
        schemes=("committed", "predictive", "none"),
    ),
    "cost_gap": Signature((Parameter("c", 0, key="cost_gap"),), schemes=("committed",)),
    "expected_gap": Signature((Parameter("c", 0, key="cost_gap"),), schemes=("committed",)),
    "deviation": Signature((Parameter("metres", 0, key="deviation_m"),), schemes=("committed",)),
    "tolerance": Signature(
        (Parameter("metres", 0, key="tolerance_m"),), schemes=("dead_reckoning",)
    ),
    "delta": Signature((Parameter("metres", 0, key="tolerance_m"),), schemes=("dead_reckoning",)),
    "silence": Signature((Parameter("seconds", 0.001, 3600),)),
    "budget": Signature(
        (Parameter("packets_per_s", 0.001, 1_000_000), Parameter("burst", 1, 1_000_000))
    ),
}
"""Every policy, by name."""


@dataclass(frozen=True, slots=True)
class Policy:
    """A policy by itself."""

    name: str
    values: tuple[float, ...]
    """Arguments as written; empty where the policy stands without."""


@dataclass(frozen=True, slots=True)
class Combination:
    """Two triggers, of which both (&) or either (|) must want to send."""

    operator: Literal["&", "|"]
    left: "Expression"
    right: "Expression"


Expression = Policy | Combination


def parse(text: str) -> Expression:
    """The trigger that a text describes.

    Raises:
        PolicyError: with the part of it that is wrong.
    """
    line = " ".join(text.split())
    if len(text) > TEXT_MAX or not _TOKENS.fullmatch(line):
        raise PolicyError(text, FORM)
    try:
        tree = ast.parse(line, mode="eval")
    except SyntaxError:
        raise PolicyError(text, FORM) from None
    return _expression(tree.body)


def policies(expression: Expression) -> Iterator[Policy]:
    """Policies in a trigger, from left to right."""
    match expression:
        case Policy():
            yield expression
        case Combination(_, left, right):
            yield from policies(left)
            yield from policies(right)


def _expression(node: ast.expr) -> Expression:
    match node:
        case ast.BinOp(left, ast.BitAnd(), right):
            return Combination("&", _expression(left), _expression(right))
        case ast.BinOp(left, ast.BitOr(), right):
            return Combination("|", _expression(left), _expression(right))
        case ast.Name(name):
            return _policy(node, name, [])
        case ast.Call(ast.Name(name), arguments):
            return _policy(node, name, arguments)
    raise PolicyError(ast.unparse(node), FORM)


def _policy(node: ast.expr, name: str, arguments: list[ast.expr]) -> Policy:
    signature = SIGNATURES.get(name)
    if signature is None:
        raise PolicyError(ast.unparse(node), f"a policy; {hint(name, SIGNATURES)}")
    values: list[Any] = [
        item.value if isinstance(item, ast.Constant) else None for item in arguments
    ]
    if not signature.takes(values):
        raise PolicyError(ast.unparse(node), signature.form(name))
    return Policy(name, tuple(values))
