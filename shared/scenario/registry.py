"""Tables of what a scenario can name: from a name to what makes it, ours and plug-ins' alike.

    @trigger
    def slip(now: Situation, mps: Annotated[float, Meta(ge=0)]) -> Flags:
        '''Sends where the velocity is off its plan by more than so many m/s.'''

A table is the decorator of its entries. Name, bounds and the sentence of help are those of the
function or class itself. The program gives it a fixed number of arguments (here `now`); those
behind are what a scenario writes in parentheses, as in `slip(0.3)` (`grammar.py`): numbers, and for
impairments and zones words and names of files, too. Nothing is imported here: `shell.plugins`
imports plug-ins, before a scenario is read.
"""

import inspect
import keyword
import math
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, overload

import msgspec
from msgspec import Meta

from skytether.shared.base.errors import ConfigError
from skytether.shared.base.hint import hint
from skytether.shared.scenario import grammar
from skytether.shared.scenario.grammar import Call, Combination, Expression, GrammarError, Value

F = TypeVar("F", bound=Callable[..., Any])

LOW, HIGH = {"ge": "<=", "gt": "<"}, {"le": "<=", "lt": "<"}
"""Bounds of a number from below and above, by their names in msgspec.Meta."""
FURTHER = {
    "multiple_of": "a multiple of",
    "pattern": "with the pattern",
    "min_length": "of a length from",
    "max_length": "of a length up to",
}
"""All other bounds, by their names in msgspec.Meta, as a message has them."""

UNITS: Mapping[str, Mapping[str, tuple[float, float]]] = MappingProxyType(
    {
        "bytes_per_s": {"kbit": (1e3, 8.0), "mbit": (1e6, 8.0), "gbit": (1e9, 8.0)},
        "per_s": {},
        "_s": {"us": (1.0, 1e6), "ms": (1.0, 1e3), "s": (1.0, 1.0)},
        "": {"%": (1.0, 100.0)},
    }
)
"""Units that may stand behind a number, by the end of the parameter's name: multiplier, divisor."""

_NAME = re.compile(r"[a-z_]\w*(-\w+)*", re.ASCII | re.IGNORECASE)
_WITH_UNIT = re.compile(rf"({grammar.NUMBER.pattern})([a-z]+|%)", re.ASCII | re.IGNORECASE)


class File(NamedTuple):
    """File that a scenario names: annotation and value of a parameter."""

    name: str
    content: bytes


Files = tuple[File, ...]
"""Files that a scenario names, as they were when it was read."""


def content(files: Files, name: str) -> bytes:
    """Content of a file that a scenario names.

    Raises:
        ConfigError: it has not been read with the scenario.
    """
    for file in files:
        if file.name == name:
            return file.content
    raise ConfigError(f"{name}: has not been read")


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that an entry takes, or one of some words, or the name of a file."""

    name: str
    type: Any = float
    """Type as msgspec converts to it, with bounds: of a number, of words (Literal), or of a text
    that names a file."""
    default: Value | None = None
    """Value where none is written; None: one must be."""
    is_rest: bool = False
    """Whether it stands for any number of arguments: all that are left."""

    def takes(self, value: Any) -> bool:
        """Whether the parameter may have this value."""
        try:
            msgspec.convert(value, self.type)
        except msgspec.ValidationError:
            return False
        return isinstance(value, str) or math.isfinite(value)

    def without_unit(self, value: Value | None) -> Value | None:
        """A number in the parameter's own unit, of one such as 50ms, 10% or 1mbit."""
        found = _WITH_UNIT.fullmatch(value) if isinstance(value, str) and not self.file else None
        units = next(units for end, units in UNITS.items() if self.name.endswith(end))
        if found is None or found[2].lower() not in units:
            return value
        multiplier, divisor = units[found[2].lower()]
        return float(found[1]) * multiplier / divisor

    @property
    def file(self) -> bool:
        """Whether the value is the name of a file."""
        return _bounds(self.type)[0] is str

    def __str__(self) -> str:
        kind, bounds = _bounds(self.type)
        if self.file or typing.get_origin(kind) is Literal:
            what = "a file" if self.file else " or ".join(typing.get_args(kind))
            return " ".join([self.name, what, *_further(bounds)])
        low = [f"{bounds[key]:.15g} {sign} " for key, sign in LOW.items() if key in bounds]
        high = [f" {sign} {bounds[key]:.15g}" for key, sign in HIGH.items() if key in bounds]
        ends = ["(whole)"] * (kind is int) + _further(bounds)
        return " ".join(["".join([*low, self.name, *high]), *ends])


def _bounds(hint: Any) -> tuple[Any, dict[str, Any]]:
    """Type without its bounds, and the bounds by their names in msgspec.Meta."""
    kind, *marks = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
    pairs = [(key, getattr(mark, key)) for mark in marks for key in (*LOW, *HIGH, *FURTHER)]
    return kind, {key: bound for key, bound in pairs if bound is not None}


def _further(bounds: dict[str, Any]) -> list[str]:
    """Bounds that are no interval, in words."""
    return [f"({FURTHER[key]} {bounds[key]})" for key in FURTHER if key in bounds]


@dataclass(frozen=True, slots=True)
class Entry:
    """Entry of a table: a policy, shape or impairment that a scenario can name."""

    make: Callable[..., Any]
    """Function or class that makes it, of what its table gives and of its numbers."""
    parameters: tuple[Parameter, ...]
    about: str
    """First paragraph of its docstring."""
    needs: str = ""
    """What a scheme must compute for it (`schemes.SchemeProperties.computes`); empty: nothing."""
    version: str = ""
    """Digest of a plug-in's file, or name and version of its package; empty for ours."""

    @property
    def source(self) -> str:
        """Name of the module it is from; of a plug-in that is a file, its path."""
        return self.make.__module__

    @property
    def is_ours(self) -> bool:
        """Whether it comes with Skytether."""
        return self.source.startswith("skytether.")

    def bound(self, call: Call) -> tuple[Value, ...] | None:
        """An argument for each parameter, as written or by default; None where they do not fit."""
        given: dict[str, Value] = {}
        rest: list[Value] = []
        names = [parameter.name for parameter in self.parameters if not parameter.is_rest]
        for key, value in zip(call.keys or [""] * len(call.values), call.values, strict=True):
            name = key or next((each for each in names if each not in given), "")
            if name in names and name not in given:
                given[name] = value
            elif not name and self.parameters and self.parameters[-1].is_rest:
                rest.append(value)
            else:
                return None
        values = [
            *((each, given.get(each.name, each.default)) for each in self.parameters[: len(names)]),
            *((self.parameters[-1], value) for value in rest),
        ]
        values = [(parameter, parameter.without_unit(value)) for parameter, value in values]
        if not all(value is not None and parameter.takes(value) for parameter, value in values):
            return None
        return tuple(msgspec.convert(value, parameter.type) for parameter, value in values)

    def form(self, name: str) -> str:
        """Grammar of an entry with this name."""
        if not self.parameters:
            return name
        shown = ", ".join(
            f"{each.name}{'…' if each.is_rest else ''}"
            if each.default is None
            else f"{each.name}={each.default}"
            for each in self.parameters
        )
        bounds = [str(each) for each in self.parameters if str(each) != each.name]
        return f"{name}({shown})" + (f" with {' and '.join(bounds)}" if bounds else "")


class PluginTable(dict[str, Entry]):
    """Entries of one kind by name, and the decorator that adds one.

    Args:
        kind: the noun for an entry, in messages.
        form: what an entry may look like in a scenario, in messages.
        given: number of arguments that the program gives to a function; a class is given `class_`.
        texts: whether entries take words and names of files beside numbers.
    """

    def __init__(
        self, kind: str, form: str, *, given: int, class_: int, texts: bool = False
    ) -> None:
        super().__init__()
        self.kind = kind
        self.form = form
        self._given, self._class, self._texts = given, class_, texts

    def parse(self, text: str) -> Expression:
        """Entries combined with & and |, each with an argument for each of its parameters.

        Raises:
            GrammarError: with the part of the text that is wrong.
        """

        def bound(expression: Expression) -> Expression:
            match expression:
                case Combination(operator, left, right):
                    return Combination(operator, bound(left), bound(right))
                case Call():
                    return self._bound(expression)

        return bound(grammar.parse(text, self.form))

    def one(self, text: str) -> Call:
        """The one entry that a text names.

        Raises:
            GrammarError: see `parse`.
        """
        found = grammar.parse(text, self.form)
        # Without arguments it is its name alone, which code compares with names.
        if not isinstance(found, Call) or not (found.keys or text == found.name):
            raise GrammarError(text, self.form)
        return self._bound(found)

    def calls(self, text: str) -> list[Call]:
        """Entries joined by & alone; none of an empty text.

        Raises:
            GrammarError: see `parse`.
        """
        return [self._bound(each) for each in grammar.calls(text, self.form)]

    def files(self, text: str) -> list[str]:
        """Files that entries joined by & name.

        Raises:
            GrammarError: see `parse`.
        """
        return [str(value) for call in self.calls(text) for value, file in self._args(call) if file]

    def made(self, call: Call, files: Files = (), *given: object) -> Any:
        """Make what a bound call describes.

        Args:
            call: the call.
            files: files of the scenario.
            given: what the program gives.

        Raises:
            ConfigError: a file of the call has not been read.
        """
        args = [
            File(str(value), content(files, str(value))) if file else value
            for value, file in self._args(call)
        ]
        return self[call.name].make(*given, *args)

    def with_files(self, text: str, change: Callable[[str], str]) -> str:
        """Entries joined by &, with other names of their files.

        Raises:
            GrammarError: see `parse`.
        """
        for call in reversed(self.calls(text)):
            if any(file for _, file in self._args(call)):
                values = [change(str(value)) if file else value for value, file in self._args(call)]
                text = self._with(text, call, values)
        return text

    def with_argument(self, text: str, at: str, value: object) -> str:
        """A text in which an entry has another argument.

        Args:
            text: entries combined with & and |.
            at: name of the entry, and behind a point that of the parameter, or else the first.
            value: the argument.

        Raises:
            KeyError: there is no such entry, or it has no such parameter.
            GrammarError: the text does not name the entry, or is wrong itself.
        """
        found, index = self._argument(text, at)
        for call in reversed(found):
            values: list[Any] = list(call.values)
            values[index] = value
            text = self._with(text, call, values)
        return text

    def argument(self, text: str, at: str) -> Value:
        """Argument of the first such entry in a text; see `with_argument`."""
        found, index = self._argument(text, at)
        return found[0].values[index]

    def _argument(self, text: str, at: str) -> tuple[list[Call], int]:
        """Calls of the entry of an argument in a text, and the index of its parameter."""
        name, _, key = at.partition(".")
        names = [parameter.name for parameter in self[name].parameters]
        if not names or (key and key not in names):
            raise KeyError(at)
        found = [each for each in grammar.leaves(self.parse(text)) if each.name == name]
        if not found:
            raise GrammarError(text, f"{name} in it")
        return found, names.index(key) if key else 0

    def _bound(self, call: Call) -> Call:
        entry = self.get(call.name)
        if entry is None:
            article = "an" if self.kind[0] in "aeiou" else "a"
            raise GrammarError(call.text, f"{article} {self.kind}; {hint(call.name, self)}")
        values = entry.bound(call)
        if values is None:
            raise GrammarError(call.text, entry.form(call.name))
        return replace(call, values=values, keys=())

    def _args(self, call: Call) -> list[tuple[Value, bool]]:
        """Arguments of a bound call, and whether each is the name of a file."""
        parameters = self[call.name].parameters
        last = len(parameters) - 1
        return [(each, parameters[min(i, last)].file) for i, each in enumerate(call.values)]

    def _with(self, text: str, call: Call, values: Sequence[Any]) -> str:
        """A text with other arguments of a call, every one written out."""
        files = [file for _, file in self._args(call)]
        shown = [
            f'"{value}"' if file else value if isinstance(value, str) else repr(value)
            for value, file in zip(values, files, strict=True)
        ]
        end = call.begin + len(call.text)
        return f"{text[: call.begin]}{call.name}({', '.join(shown)}){text[end:]}"

    @overload
    def __call__(self, make: F) -> F: ...

    @overload
    def __call__(
        self, make: None = None, *, name: str = "", needs: str = ""
    ) -> Callable[[F], F]: ...

    def __call__(
        self, make: F | None = None, *, name: str = "", needs: str = ""
    ) -> F | Callable[[F], F]:
        """Add an entry: `@table`, or `@table(...)` with a name that is not the function's own.

        Raises:
            ConfigError: name or parameters are impossible, or somebody else's entry has the name.
        """

        def add(make: F) -> F:
            self.add(make, name or make.__name__, needs)
            return make

        return add(make) if make else add

    def add(self, make: Callable[..., Any], name: str, needs: str = "") -> None:
        """Add an entry; that of the same module with this name gives way to it.

        Raises:
            ConfigError: see `__call__`.
        """
        what = f"{self.kind} {name}"
        if not _NAME.fullmatch(name) or keyword.iskeyword(name):
            raise ConfigError(f"{what}: expected a name of letters, digits and _")
        there = self.get(name)
        if there and there.source != make.__module__:
            raise ConfigError(f"{what}: expected another name, {there.source} has one of this name")
        if lacking := sorted(getattr(make, "__abstractmethods__", ())):
            raise ConfigError(f"{what}: expected the methods {', '.join(lacking)}, too")
        given = self._class if isinstance(make, type) else self._given
        parameters = _parameters(what, make, given, texts=self._texts)
        about = inspect.cleandoc(make.__doc__ or "").partition("\n\n")[0]
        self[name] = Entry(make, parameters, " ".join(about.split()), needs)


def _parameters(
    what: str, make: Callable[..., Any], given: int, *, texts: bool
) -> tuple[Parameter, ...]:
    """Parameters that a function or class takes behind what it is given.

    Raises:
        ConfigError: it takes something else, or not even what it is given.
    """
    function = make.__init__ if isinstance(make, type) else make  # type: ignore[misc]
    try:
        hints = typing.get_type_hints(function, include_extras=True)
    except NameError as error:
        raise ConfigError(f"{what}: its annotations cannot be read: {error}") from None
    taken = list(inspect.signature(make).parameters.values())
    if len(taken) < given:
        raise ConfigError(f"{what}: got {len(taken)} parameters, expected at least {given}")
    return tuple(
        _parameter(what, each, hints.get(each.name, float), texts=texts) for each in taken[given:]
    )


def _parameter(what: str, taken: inspect.Parameter, hint: Any, *, texts: bool) -> Parameter:
    """Parameter of an entry, with the bounds in its annotation.

    Raises:
        ConfigError: nothing that a scenario writes can be given for it.
    """
    kind, *marks = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
    default = None if taken.default is taken.empty else taken.default
    words = texts and typing.get_origin(kind) is Literal and typing.get_args(kind)
    written = kind in (int, float) or (words and all(isinstance(each, str) for each in words))
    is_rest = texts and taken.kind is taken.VAR_POSITIONAL
    one = taken.kind is taken.POSITIONAL_OR_KEYWORD or is_rest
    if not one or not (written or (texts and kind is File)):
        raise ConfigError(f"{what}: {taken}: expected a number, as in {taken.name}: float")
    for mark in marks:
        if not isinstance(mark, Meta | str):  # a bound that nobody would check
            given = f"got {mark!r} with {taken.name}"
            raise ConfigError(f"{what}: {given}, expected bounds as in msgspec.Meta(ge=0)")
    bounds = [mark for mark in marks if isinstance(mark, Meta)]
    bounded: Any = str if kind is File else kind
    if bounds:
        bounded = Annotated[(bounded, *bounds)]
    try:
        with suppress(msgspec.ValidationError):
            msgspec.convert(0, bounded)
    except TypeError as error:
        said = str(error).partition(" - ")[0]
        raise ConfigError(f"{what}: bounds of {taken.name}: {said}") from None
    parameter = Parameter(taken.name, bounded, default, is_rest)
    if default is not None and not parameter.takes(default):
        raise ConfigError(f"{what}: got the default {taken.name} = {default}, expected {parameter}")
    return parameter


PERIOD_MAX = 1_000_000
"""Largest number of steps from one packet to the next."""

TRIGGERS = PluginTable(
    "policy", "policies such as 'state_gap & budget(5, 2) | silence(1)'", given=1, class_=2
)
"""Policies of `control.trigger`. A function is given a `triggers.Situation` at each step; a class
the control section and the largest number of vehicles, once. See `shared.scenario.triggers`."""
REPORTS = PluginTable("report", "reports such as 'deviation(0.05) | silence(1)'", given=1, class_=1)
"""Policies of `vehicle.report`, given an `observing.Unreported` at each step. See
`shared.scenario.observing`; no plug-in adds to them."""
REFERENCES = PluginTable("shape", "a shape such as 'circle', or 'name(1.5)'", given=1, class_=1)
"""Shapes of `reference.shape`, given the `Scenario`. See `shared.scenario.trajectories`."""
SCHEMES = PluginTable("scheme", "a scheme such as 'trajectory', or 'name(1.5)'", given=0, class_=1)
"""Schemes of `control.scheme`: of ours a function that says its properties, of a plug-in the class
itself, given a `server.common.scheme.Fleet`. See `shared.scenario.schemes`."""
VEHICLES = PluginTable(
    "vehicle", "a vehicle such as 'simulated', or 'name(1.5)'", given=2, class_=2
)
"""Vehicles of `vehicle.kind`, given the `Scenario` and the vehicle's number. See
`client.vehicles`."""
ZONES = PluginTable(
    "zone", "zones such as 'box(1, 2, -1, 1) & fence(-6, 6, -6, 6)'", given=0, class_=0, texts=True
)
"""Zones of a mission, each a function that gives a list of them. See `shared.scenario.zones`; no
plug-in adds to them."""
IMPAIRMENTS = PluginTable(
    "impairment",
    "impairments such as 'constant(0.05) & loss(0.1)'",
    given=0,
    class_=0,
    texts=True,
)
"""Impairments of a direction of the network: classes. See `shared.scenario.air`."""
TABLES = (SCHEMES, TRIGGERS, REFERENCES, VEHICLES, IMPAIRMENTS)
"""All tables that plug-ins add to."""
