"""Tables of the entries that a scenario can name: policies, shapes, schemes, vehicles and so on.

    @trigger
    def slip(now: Situation, mps: Annotated[float, Meta(ge=0)]) -> Flags:
        '''Sends where the velocity is off its plan by more than this many m/s.'''

A table is used as the decorator of its entries, both of built-in entries and of those in plug-ins.
The entry's name, bounds and help come from the decorated function or class. The program passes a
fixed number of arguments (here `now`). The scenario has the other arguments, as in `slip(0.3)`
(`grammar.py`): numbers, and for impairments and zones also words and file names.
`shell.commandline.plugins` imports plug-ins before a scenario is read.
"""

import inspect
import keyword
import math
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, overload

import msgspec
from msgspec import Meta

from skytether.shared.base.errors import ConfigError, NotInstalledError
from skytether.shared.base.hint import hint
from skytether.shared.scenario import grammar
from skytether.shared.scenario.grammar import Call, Combination, Expression, GrammarError, Value

F = TypeVar("F", bound=Callable[..., Any])

UNITS: Mapping[str, Mapping[str, tuple[float, float]]] = MappingProxyType(
    {
        "bytes_per_s": {"kbit": (1e3, 8.0), "mbit": (1e6, 8.0), "gbit": (1e9, 8.0)},
        "per_s": {},
        "_s": {"us": (1.0, 1e6), "ms": (1.0, 1e3), "s": (1.0, 1.0)},
        "": {"%": (1.0, 100.0)},
    }
)
"""Units allowed after a number, by the ending of the parameter's name. Each unit has a multiplier
and a divisor."""

_NAME = re.compile(r"[a-z_]\w*(-\w+)*", re.ASCII | re.IGNORECASE)
_WITH_UNIT = re.compile(rf"({grammar.NUMBER.pattern})([a-z]+|%)", re.ASCII | re.IGNORECASE)


class File(NamedTuple):
    """File that a scenario names, with its content. A parameter of this type takes a file name."""

    name: str
    content: bytes
    origin: tuple[float, ...] = ()
    """Latitude and longitude of the scenario's origin [degrees]; empty: not given."""


Files = tuple[File, ...]


def file_of(files: Files, name: str) -> File:
    """Content of a file that a scenario names; raises ConfigError if it was not read with the
    scenario.
    """
    for file in files:
        if file.name == name:
            return file
    raise ConfigError(f"{name}: has not been read")


@dataclass(frozen=True, slots=True)
class Parameter:
    """Parameter of an entry: a number, one of several words, or a file name."""

    name: str
    type: Any = float
    """Type for msgspec, with bounds: number, Literal of words, or str for a file name."""
    default: Value | None = None
    """Default value; None if the argument is required."""
    is_rest: bool = False
    """Whether the parameter collects all remaining arguments, like *args."""

    def takes(self, value: Any) -> bool:
        try:
            msgspec.convert(value, self.type)
        except msgspec.ValidationError:
            return False
        return isinstance(value, str) or math.isfinite(value)

    def without_unit(self, value: Value | None) -> Value | None:
        """Value, converted to the parameter's own unit if it is a word such as 50ms or 10%."""
        match = _WITH_UNIT.fullmatch(value) if isinstance(value, str) and not self.file else None
        units = next(units for end, units in UNITS.items() if self.name.endswith(end))
        if match is None or match[2].lower() not in units:
            return value
        multiplier, divisor = units[match[2].lower()]
        return float(match[1]) * multiplier / divisor

    @property
    def file(self) -> bool:
        return self.type is str or typing.get_args(self.type)[:1] == (str,)


@dataclass(frozen=True, slots=True)
class Entry:
    """Entry of a table: a policy, shape or impairment that a scenario can name."""

    make: Callable[..., Any]
    """Function or class, called with the program's arguments, then the scenario's arguments."""
    parameters: tuple[Parameter, ...]
    about: str
    needs: str = ""
    """Figure that a scheme must compute for this entry (`schemes.SchemeProperties.computes`);
    empty: none."""
    version: str = ""
    """Digest of a plug-in's file, or name and version of its package; empty for built-in
    entries."""

    @property
    def source(self) -> str:
        """Name of the module of `make`, or path of a plug-in that is a file."""
        return self.make.__module__

    @property
    def is_ours(self) -> bool:
        return self.source.startswith("skytether.")

    def bound(self, call: Call) -> tuple[Value, ...] | None:
        """Value of each parameter, from the call or its default; None if the call is invalid."""
        named: dict[str, Value] = {}
        rest: list[Value] = []
        names = [parameter.name for parameter in self.parameters if not parameter.is_rest]
        for key, value in zip(call.keys or [""] * len(call.values), call.values, strict=True):
            name = key or next((each for each in names if each not in named), "")
            if name in names and name not in named:
                named[name] = value
            elif not name and self.parameters and self.parameters[-1].is_rest:
                rest.append(value)
            else:
                return None
        values = [
            *((each, named.get(each.name, each.default)) for each in self.parameters[: len(names)]),
            *((self.parameters[-1], value) for value in rest),
        ]
        values = [(parameter, parameter.without_unit(value)) for parameter, value in values]
        if not all(value is not None and parameter.takes(value) for parameter, value in values):
            return None
        return tuple(msgspec.convert(value, parameter.type) for parameter, value in values)


def load(module: str, what: str) -> Any:
    """Import a built-in module that a scenario needs; raises ConfigError if this module or one that
    it imports is not installed.

    Args:
        what: name of the feature that needs the module, for the message.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if not f"{error.name}.".startswith("skytether."):
            raise
        raise NotInstalledError(f"{what}: {error.name} is not installed") from None


def _offered() -> None:
    """Placeholder for an entry whose module is not loaded yet."""


_OFFERED = Entry(_offered, (), "")


class PluginTable(dict[str, Entry]):
    """Entries of one kind by name. The table is also the decorator that adds an entry.

    Methods that take a text of entries raise GrammarError if the text is invalid.

    Args:
        kind: noun for an entry, for messages.
        form: example of a text with entries, for messages.
        given: number of arguments that the program passes to a function.
        class_: number of arguments that the program passes to a class.
        texts: whether entries may also have words and file names as arguments.
    """

    def __init__(
        self, kind: str, form: str, *, given: int, class_: int, texts: bool = False
    ) -> None:
        super().__init__()
        self.kind = kind
        self.form = form
        self._given, self._class, self._texts = given, class_, texts
        self._modules: dict[str, str] = {}
        """Module of each entry declared by `offer`."""
        self._built_in: dict[str, Entry] = {}
        """Entries of the loaded built-in modules."""

    # -- entries of modules that are not loaded yet --------------------------------------------

    def offer(self, module: str, *names: str) -> None:
        """Declare entries of a built-in module, which is imported at their first use."""
        for name in names:
            self._modules[name] = module
            super().__setitem__(name, _OFFERED)

    def __getitem__(self, name: str) -> Entry:
        entry = super().__getitem__(name)
        if entry is _OFFERED:
            load(self._modules[name], f"{self.kind} {name}")
            entry = self._built_in[name]
            super().__setitem__(name, entry)
        return entry

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self else default  # noqa: SIM401 - that is this method

    def items(self) -> Any:
        return {name: self[name] for name in self}.items()

    def values(self) -> Any:
        return {name: self[name] for name in self}.values()

    # -- texts ---------------------------------------------------------------------------------

    def parse(self, text: str) -> Expression:
        """Parse entries combined with & and |, and bind their arguments to parameters."""

        def bound(expression: Expression) -> Expression:
            match expression:
                case Combination(operator, left, right):
                    return Combination(operator, bound(left), bound(right))
                case Call():
                    return self._bound(expression)

        return bound(grammar.parse(text, self.form))

    def one(self, text: str) -> Call:
        """Parse a text that names a single entry."""
        call = grammar.parse(text, self.form)
        # A text without arguments must equal the name, because other code compares the two.
        if not isinstance(call, Call) or not (call.keys or text == call.name):
            raise GrammarError(text, self.form)
        return self._bound(call)

    def calls(self, text: str) -> list[Call]:
        """Parse entries joined by & only; an empty text has no entries."""
        return [self._bound(each) for each in grammar.calls(text, self.form)]

    def files(self, text: str) -> list[str]:
        """Names of files in a text of entries joined by &."""
        return [str(value) for call in self.calls(text) for value, file in self._args(call) if file]

    def make(self, call: Call, files: Files = (), *given: object) -> Any:
        """Call the entry's function or class.

        Args:
            call: a bound call.
            files: files of the scenario.
            given: arguments from the program, which come first.

        Raises:
            ConfigError: a file of the call was not read with the scenario.
        """
        args = [file_of(files, str(value)) if file else value for value, file in self._args(call)]
        return self[call.name].make(*given, *args)

    def with_files(self, text: str, change: Callable[[str], str]) -> str:
        """Text of entries joined by &, with each file name replaced by `change(name)`."""
        for call in reversed(self.calls(text)):
            if any(file for _, file in self._args(call)):
                values = [change(str(value)) if file else value for value, file in self._args(call)]
                text = self.with_values(text, call, values)
        return text

    def _bound(self, call: Call) -> Call:
        entry = self.get(call.name)
        if entry is None:
            article = "an" if self.kind[0] in "aeiou" else "a"
            raise GrammarError(call.text, f"{article} {self.kind}; {hint(call.name, self)}")
        values = entry.bound(call)
        if values is None:
            raise GrammarError(call.text, _forms().form(call.name, entry))
        return replace(call, values=values, keys=())

    def _args(self, call: Call) -> list[tuple[Value, bool]]:
        parameters = self[call.name].parameters
        last = len(parameters) - 1
        return [(each, parameters[min(i, last)].file) for i, each in enumerate(call.values)]

    def with_values(self, text: str, call: Call, values: Sequence[Any]) -> str:
        """Copy of `text`, a text of entries, in which `values` replace the arguments of `call`."""
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
        """Decorate an entry: `@table`, or `@table(name=..., needs=...)`.

        Raises:
            ConfigError: name or parameters are invalid, or another module has an entry of the name.
        """

        def add(make: F) -> F:
            self.add(make, name or make.__name__, needs)
            return make

        return add(make) if make else add

    def add(self, make: Callable[..., Any], name: str, needs: str = "") -> None:
        """Add an entry; an entry of the same name and module is replaced.

        Raises:
            ConfigError: see `__call__`.
        """
        what = f"{self.kind} {name}"
        if not _NAME.fullmatch(name) or keyword.iskeyword(name):
            raise ConfigError(f"{what}: expected a name of letters, digits and _")
        other = super().get(name)
        source = self._modules.get(name) if other is _OFFERED else other and other.source
        if source and source != make.__module__:
            raise ConfigError(f"{what}: expected another name: {source} has an entry of this name")
        if lacking := sorted(getattr(make, "__abstractmethods__", ())):
            raise ConfigError(f"{what}: expected the methods {', '.join(lacking)}, too")
        passed = self._class if isinstance(make, type) else self._given
        parameters = _parameters(what, make, passed, texts=self._texts)
        about = inspect.cleandoc(make.__doc__ or "").partition("\n\n")[0]
        self[name] = Entry(make, parameters, " ".join(about.split()), needs)
        if self._modules.get(name) == make.__module__:
            self._built_in[name] = self[name]


def _forms() -> Any:
    """Module that formats entries for messages. It is loaded only after a user's mistake."""
    return load("skytether.shared.scenario.forms", "forms")


def _parameters(
    what: str, make: Callable[..., Any], given: int, *, texts: bool
) -> tuple[Parameter, ...]:
    """Parameters of a function or class without the first `given` parameters.

    Raises:
        ConfigError: a parameter has an unusable type, or there are fewer than `given` parameters.
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
        ConfigError: its type, bounds or default are unusable.
    """
    kind, *marks = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
    default = None if taken.default is taken.empty else taken.default
    words = texts and typing.get_origin(kind) is Literal and typing.get_args(kind)
    is_writable = kind in (int, float) or (words and all(isinstance(each, str) for each in words))
    is_rest = texts and taken.kind is taken.VAR_POSITIONAL
    is_single = taken.kind is taken.POSITIONAL_OR_KEYWORD or is_rest
    if not is_single or not (is_writable or (texts and kind is File)):
        raise ConfigError(f"{what}: {taken}: expected a number, as in {taken.name}: float")
    for mark in marks:
        if not isinstance(mark, Meta | str):  # a bound of another kind would not be checked
            got = f"got {mark!r} with {taken.name}"
            raise ConfigError(f"{what}: {got}, expected bounds as in msgspec.Meta(ge=0)")
    bounds = [mark for mark in marks if isinstance(mark, Meta)]
    bounded: Any = str if kind is File else kind
    if bounds:
        bounded = Annotated[(bounded, *bounds)]
    try:
        with suppress(msgspec.ValidationError):
            msgspec.convert(0, bounded)
    except TypeError as error:
        reason = str(error).partition(" - ")[0]
        raise ConfigError(f"{what}: bounds of {taken.name}: {reason}") from None
    parameter = Parameter(taken.name, bounded, default, is_rest)
    if default is not None and not parameter.takes(default):
        expected = _forms().parameter_text(parameter)
        raise ConfigError(f"{what}: got the default {taken.name} = {default}, expected {expected}")
    return parameter


PERIOD_MAX = 1_000_000

TRIGGERS = PluginTable(
    "policy", "policies such as 'state_gap & budget(5, 2) | silence(1)'", given=1, class_=2
)
"""Policies of `control.trigger`. A function is called at each step, with a `Situation`; a class is
called once, with the control section and the largest number of vehicles. See
`server.triggers.trigger`."""
REPORTS = PluginTable("report", "reports such as 'deviation(0.05) | silence(1)'", given=1, class_=1)
"""Policies of `vehicle.report`, called with a `reports.Unreported` at each step. See
`client.reports`. Plug-ins cannot add reports."""
REFERENCES = PluginTable("shape", "a shape such as 'circle', or 'name(1.5)'", given=1, class_=1)
"""Shapes of `reference.shape`, called with the `Scenario`. See `shared.scenario.curves`."""
SCHEMES = PluginTable("scheme", "a scheme such as 'trajectory', or 'name(1.5)'", given=0, class_=1)
"""Schemes of `control.scheme`. A built-in scheme is a function that returns the scheme's
properties; a plug-in's scheme is a class, called with a `server.planning.scheme.Fleet`. See
`shared.scenario.schemes`."""
PLANNERS = PluginTable("planner", "a planner such as 'mpc', or 'name(1.5)'", given=1, class_=1)
"""Planners of `control.planner`, called with a `planners.Problem`. See
`shared.scenario.planners`."""
MPC = "mpc"
"""Name of the server's built-in planner."""
VEHICLES = PluginTable(
    "vehicle", "a vehicle such as 'simulated', or 'name(1.5)'", given=2, class_=2
)
"""Vehicles of `vehicle.kind`, called with the `Scenario` and the vehicle's number. See
`client.vehicles`."""
IMPAIRMENTS = PluginTable(
    "impairment",
    "impairments such as 'constant(0.05) & loss(0.1)'",
    given=0,
    class_=0,
    texts=True,
)
"""Impairments of a direction of the network. Each is a class, see `netem.impairments`."""
PLUGIN_TABLES = (SCHEMES, PLANNERS, TRIGGERS, REFERENCES, VEHICLES, IMPAIRMENTS)
"""Tables to which plug-ins can add entries."""
