"""Options of a command on its command line: a dataclass, whose nested fields are flags with dots.

tyro reads any command line, shows the help and reports wrong flags. But it first builds a
description of all keys of a scenario, which takes longer than everything else until a vehicle's
first packet, and keeps the memory. So plain flags, with which processes are started, are read here,
and tyro is imported only for other lines.
"""

import dataclasses
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from inspect import cleandoc
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from skytether.shell import plugins

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Argument:
    """Annotation of a field: its form on the command line."""

    name: str | None = None
    """Name of the flag, if different from the field's; empty: each of the field's own fields is a
    flag."""
    metavar: str | None = None
    """Placeholder for the value in the help."""
    help: str | None = None
    """Text of the help, if different from the field's docstring."""
    positional: bool = False
    """Whether the argument is positional, without a flag."""
    append: bool = False
    """Whether the flag may come several times, with a value each."""


def read(default: T, argv: Sequence[str], prog: str, help_: str | None) -> T:
    """Options of a command line, laid over defaults; `help_` says what the command does.

    Raises:
        ConfigError: a plug-in cannot be imported.
        SystemExit: tyro has shown the help, or what is wrong with a flag.
    """
    plugins.load(plugins.named(argv))
    options = plain(default, argv)
    if options is not None:
        return options
    import tyro

    kind: Any = type(default)
    _tell_tyro(kind)
    about = cleandoc(help_ or "")
    return tyro.cli(kind, args=argv, default=default, prog=prog, description=about)


def plain(default: T, argv: Sequence[str]) -> T | None:
    """Options of a line of plain flags, as tyro would read them; None where only tyro can tell.

    Plain flags are `--flag VALUE`, `--flag=VALUE` and the bare `--flag` of a boolean, after at most
    one positional value. A value is a text, a path, a number or a literal, and begins with no
    hyphen.
    """
    fields = dataclasses.fields(default)  # type: ignore[arg-type]
    empty = dataclasses.MISSING
    if any(field.default is empty and field.default_factory is empty for field in fields):
        return None  # a required option may be missing: tyro reports it
    names, positional = _flags(type(default))
    options, words = default, deque(argv)
    try:
        if words and not words[0].startswith("-"):
            (name,) = positional
            options = _laid(options, (name,), words)
        while words:
            flag, equals, value = words.popleft().partition("=")
            if not flag.startswith("--"):
                return None
            if equals:
                words.appendleft(value)
            first, *rest = flag[2:].replace("-", "_").split(".")
            own = first in names and not rest
            path = (names[first],) if own else (names[""], first, *rest)
            options = _laid(options, path, words, given=bool(equals))
    except (LookupError, ValueError):
        return None
    return options


def _flags(options: type) -> tuple[Mapping[str, str], Sequence[str]]:
    """Fields of options by flag, and the positional ones."""
    flags, positional = {}, []
    for name, hint in get_type_hints(options, include_extras=True).items():
        argument = _argument(hint) or Argument()
        if argument.positional:
            positional.append(name)
        else:
            flags[name if argument.name is None else argument.name] = name
    return flags, positional


def _argument(hint: Any) -> Argument | None:
    """Form of a field on the command line, where its annotation has one."""
    return next((a for a in getattr(hint, "__metadata__", ()) if isinstance(a, Argument)), None)


def _laid(holder: Any, path: Sequence[str], words: deque[str], *, given: bool = True) -> Any:
    """Record with the next word as the value of one of its fields, or of a nested one.

    Raises:
        LookupError, ValueError: only tyro can read the value.
    """
    name, *below = path
    hint = get_type_hints(type(holder))[name]
    if below:
        value = _laid(getattr(holder, name), below, words, given=given)
    elif hint is bool and not given:
        value = True
    else:
        value = _value(hint, words.popleft(), given=given)
    change = dataclasses.replace if dataclasses.is_dataclass(holder) else msgspec.structs.replace
    return change(holder, **{name: value})


def _value(hint: Any, text: str, *, given: bool) -> Any:
    """Value of a text for a field with this annotation; `given` for `--flag=VALUE`.

    Raises:
        ValueError: only tyro can read the value.
    """
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    # Where one number may stand for all axes, the text is that number.
    (kind,) = (kind for kind in kinds if kind is not NoneType and get_origin(kind) is not tuple)
    if kind in (str, Path) and text and text != "None" and (given or text[0] != "-"):
        return kind(text)
    if kind in (int, float) and text[:1].isdecimal() and text.isascii():
        return kind(text)
    if get_origin(kind) is Literal and text in get_args(kind):
        return text
    raise ValueError(text)


@cache
def _tell_tyro(options: type) -> None:
    """Add tyro's annotations that correspond to the options' own."""
    from tyro import conf

    def told(hint: Any) -> Any:
        argument = _argument(hint)
        if hint is bool:
            return Annotated[hint, conf.FlagCreatePairsOff]  # no --no-no-page
        if argument is None:
            return hint
        words = [conf.arg(name=argument.name, metavar=argument.metavar, help=argument.help)]
        words += [conf.Positional] * argument.positional
        words += [conf.UseAppendAction] * argument.append
        return Annotated[(hint, *words)]

    hints = get_type_hints(options, include_extras=True)
    options.__annotations__ = {name: told(hint) for name, hint in hints.items()}
