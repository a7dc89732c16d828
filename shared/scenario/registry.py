"""Tables of what a scenario can name: from a name to what makes it, ours and plug-ins' alike.

    @trigger
    def slip(now: Situation, mps: Annotated[float, Meta(ge=0)]) -> Flags:
        '''Sends where the velocity is off its plan by more than so many m/s.'''

A table is the decorator of its entries. Name, bounds and the sentence of help are those of the
function or class itself. The program gives it a fixed number of arguments (here `now`); those
behind are what a scenario writes in parentheses, as in `slip(0.3)`: numbers, and for impairments
words and names of files, too. Nothing is imported here: `shell.plugins` imports plug-ins, before a
scenario is read.
"""

import inspect
import keyword
import math
import re
import typing
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NewType, TypeVar, overload

import msgspec
from msgspec import Meta

from skytether.shared.base.errors import ConfigError

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

_NAME = re.compile(r"[a-z_]\w*(-\w+)*", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class DefaultKey:
    """Mark of a parameter: the key of the scenario's section whose value stands in for it."""

    name: str


File = NewType("File", str)
"""Annotation of a parameter that is the name of a file."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that an entry takes, or one of some words, or the name of a file."""

    name: str
    type: Any = float
    """Type as msgspec converts to it, with bounds: of a number, of words (Literal), or of a text
    that names a file."""
    default: float | str | None = None
    """Value where the entry stands without arguments."""
    key: str = ""
    """Key whose value it has there instead, in the section of the scenario that names the entry."""

    def takes(self, value: Any) -> bool:
        """Whether the parameter may have this value."""
        try:
            msgspec.convert(value, self.type)
        except msgspec.ValidationError:
            return False
        return isinstance(value, str) or math.isfinite(value)

    @property
    def file(self) -> bool:
        """Whether the value is the name of a file."""
        return _bounds(self.type)[0] is str

    @property
    def may_miss(self) -> bool:
        """Whether there is a value for it where none is written."""
        return bool(self.key) or self.default is not None

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

    def takes(self, values: Sequence[Any]) -> bool:
        """Whether these arguments are allowed; none at all where there is a value for each."""
        if not values and self.may_stand_alone:
            return True
        return len(values) == len(self.parameters) and all(
            parameter.takes(value) for parameter, value in zip(self.parameters, values, strict=True)
        )

    @property
    def may_stand_alone(self) -> bool:
        """Whether it may be written without arguments."""
        return all(parameter.may_miss for parameter in self.parameters)

    def form(self, name: str) -> str:
        """Grammar of an entry with this name."""
        if not self.parameters:
            return name
        called = f"{name}({', '.join(parameter.name for parameter in self.parameters)})"
        bare = f"{name} or " if self.takes(()) else ""
        return f"{bare}{called} with {' and '.join(map(str, self.parameters))}"

    def numbers(self, values: Sequence[float], section: object) -> tuple[Any, ...]:
        """Arguments as written, or those that stand in for them.

        Args:
            values: what is written; empty where nothing is.
            section: the section of the scenario that has the entry's keys.
        """
        return tuple(values) or tuple(
            getattr(section, parameter.key) if parameter.key else parameter.default
            for parameter in self.parameters
        )


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

    def written(self, name: str) -> str:
        """Grammar of the entry with this name."""
        entry = self[name]
        if not (self._texts and entry.parameters):
            return entry.form(name)
        shown = ", ".join(
            each.name if each.default is None else f"{each.name}={each.default}"
            for each in entry.parameters
        )
        return f"{name}({shown}) with {' and '.join(map(str, entry.parameters))}"

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
    """Parameter of an entry, with the bounds and the key in its annotation.

    Raises:
        ConfigError: nothing that a scenario writes can be given for it.
    """
    kind, *marks = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
    default = None if taken.default is taken.empty else taken.default
    words = texts and typing.get_origin(kind) is Literal and typing.get_args(kind)
    written = kind in (int, float) or (words and all(isinstance(each, str) for each in words))
    if taken.kind is not taken.POSITIONAL_OR_KEYWORD or not (written or (texts and kind is File)):
        raise ConfigError(f"{what}: {taken}: expected a number, as in {taken.name}: float")
    key = next((mark.name for mark in marks if isinstance(mark, DefaultKey)), "")
    for mark in marks:
        if not isinstance(mark, Meta | DefaultKey | str):  # a bound that nobody would check
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
    parameter = Parameter(taken.name, bounded, default, key)
    if default is not None and not parameter.takes(default):
        raise ConfigError(f"{what}: got the default {taken.name} = {default}, expected {parameter}")
    return parameter


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
