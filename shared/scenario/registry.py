"""Tables of what a scenario can name: from a name to what makes it, ours and plug-ins' alike.

    @trigger
    def slip(now: Situation, mps: Annotated[float, Meta(ge=0)]) -> Flags:
        '''Sends where the velocity is off its plan by more than so many m/s.'''

A table is the decorator of its entries. Name, bounds and the sentence of help are those of the
function or class itself. The program gives it a fixed number of arguments (here `now`); those
behind are numbers that a scenario writes in parentheses, as in `slip(0.3)`. Nothing is imported
here: `shell.plugins` imports plug-ins, before a scenario is read.
"""

import inspect
import keyword
import math
import re
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, overload

from msgspec import Meta

from skytether.shared.base.errors import ConfigError

F = TypeVar("F", bound=Callable[..., Any])

_NAME = re.compile(r"[a-z_]\w*(-\w+)*", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class DefaultKey:
    """Mark of a parameter: the key of the scenario's section whose value stands in for it."""

    name: str


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that an entry takes."""

    name: str
    low: float = -math.inf
    """Smallest value; it is finite in any case."""
    high: float = math.inf
    """Largest value; it is finite in any case."""
    whole: bool = False
    default: float | None = None
    """Value where the entry stands without arguments."""
    key: str = ""
    """Key whose value it has there instead, in the section of the scenario that names the entry."""

    def takes(self, value: Any) -> bool:
        """Whether the parameter may have this value."""
        kinds = (int,) if self.whole else (int, float)
        return type(value) in kinds and self.low <= value <= self.high and math.isfinite(value)

    @property
    def may_miss(self) -> bool:
        """Whether there is a value for it where none is written."""
        return bool(self.key) or self.default is not None

    def __str__(self) -> str:
        low = f"{self.low:.15g} <= " if math.isfinite(self.low) else ""
        high = f" <= {self.high:.15g}" if math.isfinite(self.high) else ""
        return f"{low}{self.name}{high}{' (whole)' * self.whole}"


@dataclass(frozen=True, slots=True)
class Entry:
    """Something that a scenario can name."""

    make: Callable[..., Any]
    """Function or class that makes it, of what its table gives and of its numbers."""
    parameters: tuple[Parameter, ...]
    about: str
    """First paragraph of its docstring."""
    schemes: tuple[str, ...] = ()
    """Schemes (`control.scheme`) with which it can be named; empty for all."""
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
        if not values and all(parameter.may_miss for parameter in self.parameters):
            return True
        return len(values) == len(self.parameters) and all(
            parameter.takes(value) for parameter, value in zip(self.parameters, values, strict=True)
        )

    def form(self, name: str) -> str:
        """What may be written of an entry with this name."""
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
    """

    def __init__(self, kind: str, form: str, *, given: int, class_: int) -> None:
        super().__init__()
        self.kind = kind
        self.form = form
        self._given, self._class = given, class_

    @overload
    def __call__(self, make: F) -> F: ...

    @overload
    def __call__(
        self, make: None = None, *, name: str = "", schemes: tuple[str, ...] = ()
    ) -> Callable[[F], F]: ...

    def __call__(
        self, make: F | None = None, *, name: str = "", schemes: tuple[str, ...] = ()
    ) -> F | Callable[[F], F]:
        """Add an entry: `@table`, or `@table(...)` with a name that is not the function's own.

        Raises:
            ConfigError: name or parameters are impossible, or somebody else's entry has the name.
        """

        def add(make: F) -> F:
            self.add(make, name or make.__name__, schemes)
            return make

        return add(make) if make else add

    def add(self, make: Callable[..., Any], name: str, schemes: tuple[str, ...] = ()) -> None:
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
        parameters = _parameters(what, make, self._class if isinstance(make, type) else self._given)
        about = inspect.cleandoc(make.__doc__ or "").partition("\n\n")[0]
        self[name] = Entry(make, parameters, " ".join(about.split()), schemes)


def _parameters(what: str, make: Callable[..., Any], given: int) -> tuple[Parameter, ...]:
    """Numbers that a function or class takes behind what it is given.

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
    return tuple(_parameter(what, each, hints.get(each.name, float)) for each in taken[given:])


def _parameter(what: str, taken: inspect.Parameter, hint: Any) -> Parameter:
    """One parameter, with the bounds and the key in its annotation.

    Raises:
        ConfigError: no number can be given for it.
    """
    kind, *marks = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
    default = None if taken.default is taken.empty else taken.default
    bounds = [mark for mark in marks if isinstance(mark, Meta)]
    low = next((mark.ge for mark in bounds if mark.ge is not None), -math.inf)
    high = next((mark.le for mark in bounds if mark.le is not None), math.inf)
    key = next((mark.name for mark in marks if isinstance(mark, DefaultKey)), "")
    parameter = Parameter(taken.name, low, high, kind is int, default, key)
    if taken.kind is not taken.POSITIONAL_OR_KEYWORD or kind not in (int, float):
        raise ConfigError(f"{what}: {taken}: expected a number, as in {taken.name}: float")
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
VEHICLES = PluginTable(
    "vehicle", "a vehicle such as 'simulated', or 'name(1.5)'", given=2, class_=2
)
"""Vehicles of `vehicle.kind`, given the `Scenario` and the vehicle's number. See
`client.vehicles`."""
TABLES = (TRIGGERS, REFERENCES, VEHICLES)
"""All tables that plug-ins add to."""
