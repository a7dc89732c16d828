"""Command-line options: a dataclass, and a scenario whose keys are flags.

Flags of keys, as in `--control.trigger always`, are parsed here and checked with the scenario. tyro
parses the other options and reports wrong flags. Importing tyro takes 0.2 s and 9 MB at each start
of a process, so simple flags, which commands pass to processes, are also parsed here.
"""

import dataclasses
import io
import json
import re
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, redirect_stderr, suppress
from functools import cache
from itertools import takewhile
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from skytether.shared.base import toml
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import plugins
from skytether.shell.commandline.argument import HELP_KEYS, argument_of, hints_of

T = TypeVar("T")


def read(default: T, argv: Sequence[str], prog: str, help_: str | None) -> T:
    """Options of a command line, completed from `default`; `help_` describes the command.

    Raises:
        ConfigError: a flag is wrong, or a plug-in cannot be imported.
        SystemExit: the help was printed.
    """
    plugins.load(plugins.named(argv))
    options = plain(default, argv)
    if options is not None:
        return options
    if asked := {"-h", "--help", HELP_KEYS}.intersection(argv):
        from skytether.shell.commandline.help_text import help_text, keys_text

        scenario = getattr(default, "config", None)
        if scenario and HELP_KEYS in asked:
            print(keys_text(scenario, prog))
        else:
            print(help_text(default, prog, help_ or ""))
        raise SystemExit(0)
    import tyro

    kind: Any = type(default)
    said = io.StringIO()
    with ExitStack() as undo:
        _tell_tyro(kind, undo)
        try:
            with redirect_stderr(said):
                return tyro.cli(kind, args=argv, default=default, prog=prog)
        except SystemExit:
            raise ConfigError(refusal(said.getvalue(), kind, prog)) from None


def refusal(frame: str, options: type, prog: str) -> str:
    """Error message about a wrong command line, extracted from the framed text that tyro prints."""
    lines = (line.strip("│ ") for line in frame.splitlines() if line.startswith("│"))
    said = " ".join(takewhile(lambda line: not line.startswith("─"), lines))
    if unknown := re.match(r"Unrecognized options: (.*?)(?:, |$)", said):
        return _unknown(unknown[1], options, f"see {prog} --help")
    for pattern, sentence in REFUSALS:
        if found := re.match(pattern, said):
            return found.expand(sentence)
    return said


def _unknown(word: str, options: type, see: str) -> str:
    import difflib  # slow to import, and needed only for a misspelt flag

    if not word.startswith("-"):
        return f"got {word!r} as well, expected no further argument; {see}"
    flags, _ = _flags(options)
    names = [f"--{name.replace('_', '-')}" for name in flags]
    close = difflib.get_close_matches(word, names, 1, 0.8)
    return f"{word}: no such option; {f'did you mean {close[0]}?' if close else see}"


REFUSALS = (
    (r"Missing from [^:]+: (-\S+ )?(\S+) +(.*?)\.? +\(required\)", r"expected \1\2: \3"),
    (r"Missing value for argument '([^']+)'", r"\1: got nothing, expected a value"),
    (
        r"invalid choice ('.*') for argument '(\S+)'\. Expected one of \((.*?),?\)",
        r"\2: got \1, expected one of \3",
    ),
    (r"Error parsing (\S+): .* from \[(.*?)\].*'int'", r"\1: got \2, expected a whole number"),
    (r"Error parsing (\S+): .* from \[(.*?)\].*'float'", r"\1: got \2, expected a number"),
)
"""Regular expressions of tyro's error messages, each with the message that replaces it."""


def key_values(argv: Sequence[str], options: type) -> tuple[list[str], dict[str, Any]]:
    """Command line without the flags of a scenario's keys, and the values of these keys.

    A key's flag is followed by one word. The flag of a list is followed by all words up to the next
    flag, the flag of a boolean by none: `--control.feedback`, `--control.no-feedback`.

    Args:
        argv: the command line.
        options: the command's options; their flags are not keys.

    Raises:
        ConfigError: a key has no value.
    """
    words, rest, values = deque(argv), list[str](), dict[str, Any]()
    own, _ = _flags(options)
    while words:
        word = words.popleft()
        flag, equals, text = word.partition("=")
        key = flag.removeprefix("--").replace("-", "_")
        section, dot, name = key.rpartition(".")
        negated = f"{section}{dot}{name.removeprefix('no_')}"
        if not flag.startswith("--") or key in own or not (dot or _kinds(negated) or _slipped(key)):
            rest.append(word)
        elif bool in _kinds(negated):
            values[negated] = toml_value(text) if equals else negated == key
        else:
            given = [text] if equals else []
            while words and not equals and not words[0].startswith("--"):
                given.append(words.popleft())
                if _kinds(key) and tuple not in _kinds(key):
                    break
            values[key] = _key_value(key, given)
    return rest, values


def _slipped(flag: str) -> bool:
    import difflib  # slow to import, and needed only for a misspelt flag

    keys = (key for key in Scenario.__struct_fields__ if _kinds(key) != {str})
    return bool(difflib.get_close_matches(flag, keys, 1, 0.8))


def _key_value(key: str, words: Sequence[str]) -> Any:
    kinds = _kinds(key)
    values = words if kinds <= {str} else [_number_or_other(word) for word in words]
    if len(values) == 1 and (kinds != {tuple} or isinstance(values[0], list)):
        return values[0]
    if not values and tuple not in kinds:
        raise ConfigError(f"{key}: got nothing, expected a value")
    return values


def _number_or_other(word: str) -> Any:
    """Value that a text has in TOML; also a number that only Python accepts, as `1.` or `.5`."""
    value = toml_value(word)
    with suppress(ValueError):
        return float(word) if isinstance(value, str) else value
    return value


@cache
def _kinds(key: str) -> frozenset[Any]:
    """Types that a key's value may have, such as `tuple` for a list; empty for an unknown key."""
    kind: Any = Scenario
    for name in key.split("."):
        kind = get_type_hints(kind).get(name) if hasattr(kind, "__struct_fields__") else None
    if kind is None:
        return frozenset()
    kinds = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    words = {type(word) for each in kinds if get_origin(each) is Literal for word in get_args(each)}
    return frozenset(words | {get_origin(each) or each for each in kinds} - {Literal})


def toml_value(text: str) -> Any:
    """Value that a text has in TOML, if JSON can express this value; otherwise the text itself."""
    try:
        table = toml.loads(f"value = {text}")
        return json.loads(json.dumps(table["value"], allow_nan=False)) if len(table) == 1 else text
    except (ValueError, RecursionError, TypeError):
        return text


def plain(default: T, argv: Sequence[str]) -> T | None:
    """Options of a command line that has only simple flags, as tyro parses them; otherwise None.

    Simple flags are `--flag VALUE`, `--flag=VALUE` and the bare `--flag` of a boolean, after at
    most one positional value. A value is a text, a path, a number or a literal, without a leading
    hyphen. A flag that may be repeated takes one value each time.
    """
    fields = dataclasses.fields(default)  # type: ignore[arg-type]
    empty = dataclasses.MISSING
    if any(field.default is empty and field.default_factory is empty for field in fields):
        return None  # a required option may be missing: tyro reports it
    kind: Any = type(default)
    names, positional = _flags(kind)
    hints, words = get_type_hints(kind), deque(argv)
    repeated = {name for name, hint in hints_of(kind).items() if argument_of(hint).append}
    given: dict[str, Any] = {}
    try:
        if words and not words[0].startswith("-"):
            (name,) = positional
            given[name] = _value(hints[name], words.popleft(), given=True)
        while words:
            flag, equals, value = words.popleft().partition("=")
            if not flag.startswith("--"):
                return None
            name = names[flag[2:].replace("-", "_")]
            if hints[name] is bool and not equals:
                given[name] = True
            else:
                text = value if equals else words.popleft()
                hint = get_args(hints[name])[0] if name in repeated else hints[name]
                read_value = _value(hint, text, given=bool(equals))
                if name in repeated:
                    given[name] = (*given.get(name, ()), read_value)
                else:
                    given[name] = read_value
    except (LookupError, ValueError):
        return None
    return dataclasses.replace(default, **given)  # type: ignore[type-var]


def _flags(options: type) -> tuple[Mapping[str, str], Sequence[str]]:
    flags, positional = {}, []
    for name, hint in hints_of(options).items():
        argument = argument_of(hint)
        if argument.positional:
            positional.append(name)
        else:
            flags[name if argument.name is None else argument.name] = name
    return flags, positional


def _value(hint: Any, text: str, *, given: bool) -> Any:
    """Convert a text to the type `hint`; `given` if the text was written as `--flag=VALUE`.

    Raises:
        ValueError: only tyro can parse the value.
    """
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    (kind,) = (kind for kind in kinds if kind is not NoneType)
    if kind in (str, Path) and text and text != "None" and (given or text[0] != "-"):
        return kind(text)
    if kind in (int, float) and text[:1].isdecimal() and text.isascii():
        return kind(text)
    if get_origin(kind) is Literal and text in get_args(kind):
        return text
    raise ValueError(text)


def _tell_tyro(options: type, undo: ExitStack) -> None:
    """Replace the annotations of options by annotations for tyro, which skips the scenario's keys.

    Args:
        undo: restores the options' own annotations.
    """
    from tyro import conf

    def annotated(hint: Any) -> Any:
        argument = argument_of(hint)
        within = hint if isinstance(hint, type) else get_args(hint)[0]
        if within is Scenario:
            return Annotated[hint, conf.Fixed, conf.Suppress]
        if dataclasses.is_dataclass(within):
            _tell_tyro(within, undo)
        words = [conf.arg(name=argument.name, metavar=argument.metavar)]
        words += [conf.FlagCreatePairsOff] * (hint is bool)  # no flag --no-no-page
        words += [conf.Positional] * argument.positional
        words += [conf.UseAppendAction] * argument.append
        return Annotated[(hint, *words)]

    undo.callback(setattr, options, "__annotations__", options.__annotations__)
    options.__annotations__ = {name: annotated(hint) for name, hint in hints_of(options).items()}
