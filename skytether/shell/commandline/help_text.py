"""Help of a command: its options in groups, wrapped to the terminal's width."""

import dataclasses
import math
import shutil
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from inspect import cleandoc, getdoc
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin

import msgspec

from skytether.shared.base.meanings import meanings
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline.argument import HELP_KEYS, argument_of, hints_of

ARGUMENTS, OPTIONS = "arguments", "options"
GROUPS = {
    "link": ("bind", "server", "path", "to", "secure", "keys", "key-id", "insecure"),
    "page, and control in flight": ("page", "no-page", "linger", "control", "feed", "new-flight"),
    "results and logs": (
        *("out", "json", "figure", "record", "csv", "parquet", "traces", "pcap", "html"),
        *("log", "metrics"),
    ),
    "processes and plug-ins": ("workers", "scheduler", "plugin"),
}
"""Flags of each group of the help. A flag that is not listed belongs to the group of options."""
MARGIN, INDENT_MAX = "  ", 26
SHORT = {bool: "", int: "N", float: "NUMBER", str: "TEXT"}


class OptionText(NamedTuple):
    form: str
    """Flag and the name of its value, as in `--seed N`."""
    text: str


def help_text(default: Any, prog: str, about: str) -> str:
    """Help text of a command; the values of the options in `default` are shown as defaults."""
    groups: dict[str, list[OptionText]] = {title: [] for title in (ARGUMENTS, OPTIONS, *GROUPS)}
    group_of = {flag: title for title, flags in GROUPS.items() for flag in flags}
    flies, arguments = hasattr(default, "config"), []
    for hint, name, text, value, required in _fields(default):
        argument = argument_of(hint)
        many = argument.positional and get_origin(get_args(hint)[0]) is tuple
        metavar = (argument.metavar or _metavar(hint, text)) + "..." * many
        if argument.positional:
            arguments.append(metavar if required else f"[{metavar}]")
            groups[ARGUMENTS].append(
                OptionText(metavar, text if required else _with_default(text, value))
            )
        else:
            flag = name.replace("_", "-")
            entry = OptionText(
                f"--{flag} {metavar}".rstrip(), _with_default(text, value, required=required)
            )
            groups[group_of.get(flag, OPTIONS)].append(entry)
    groups[OPTIONS].append(OptionText("-h, --help", "Show this help and exit."))
    usage = _filled(f"usage: {' '.join([prog, *arguments, '[OPTIONS]'])}", rest=MARGIN)
    parts = [usage, *_paragraphs(about)]
    if flies:
        said = f"Every key of a scenario is a flag, as in --duration 20; {HELP_KEYS} lists all."
        parts += _paragraphs(said)
    return "\n\n".join(parts) + "\n\n" + _grouped(groups)


def keys_text(scenario: Scenario, prog: str) -> str:
    """Help text of a scenario's keys; the scenario's values are shown as defaults."""
    groups: dict[str, list[OptionText]] = {}

    def add(section: msgspec.Struct, prefix: str, title: str) -> None:
        texts, hints = meanings(type(section)), hints_of(type(section))
        groups[title] = []
        for name in section.__struct_fields__:
            value, flag = getattr(section, name), name.replace("_", "-")
            if isinstance(value, msgspec.Struct):
                about = texts.get(name) or " ".join((getdoc(type(value)) or "").split())
                add(value, f"{flag}.", f"{flag}: {about}")
            else:
                switch = "[no-]" * isinstance(value, bool)
                form = f"--{prefix}{switch}{flag} {_metavar(hints[name], '')}".rstrip()
                shown = str(value).lower() if switch else value
                groups[title].append(OptionText(form, _with_default(texts.get(name, ""), shown)))

    add(scenario, "", "flight")
    return f"usage: {prog} [SCENARIO] [--KEY VALUE ...]\n\n{_grouped(groups)}"


def _fields(options: Any) -> Iterator[tuple[Any, str, str, Any, bool]]:
    """Annotation, flag, text and default of each option, and whether it is required."""
    kind: Any = type(options)
    texts, hints, empty = meanings(kind), hints_of(kind), dataclasses.MISSING
    for field in dataclasses.fields(options):
        hint, value = hints[field.name], getattr(options, field.name)
        argument = argument_of(hint)
        required = field.default is empty and field.default_factory is empty
        if dataclasses.is_dataclass(value):
            yield from _fields(value)
        elif field.name != "config":
            text = argument.help or texts.get(field.name, "")
            yield hint, argument.name or field.name, text, value, required


def _metavar(hint: Any, text: str) -> str:
    """Placeholder for an option's value, from its type and the beginning of the option's text."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        argument = argument_of(hint)
        return argument.metavar or _metavar(parts[0], text)
    if origin is Literal:
        return "|".join(filter(None, map(str, parts)))  # "" stands for a missing option
    if origin is tuple:
        of = _metavar(parts[0], text)
        return f"{of}..." if parts[-1] is Ellipsis else " ".join([of] * len(parts))
    if parts:
        kinds = dict.fromkeys(_metavar(part, text) for part in parts if part is not NoneType)
        return "|".join(kinds)
    if hint is Path:
        first = text.partition(" ")[0].upper()
        return first if first in ("FILE", "FOLDER") else "PATH"
    return "HOST:PORT" if hint is str and "HOST:PORT" in text else SHORT.get(hint, "TABLE")


def _with_default(text: str, value: Any, *, required: bool = False) -> str:
    """Help text of an option, followed by its default if a user could type this value."""
    if required:
        return f"{text} (required)"
    if value is None or value is False or value in ("", (), math.inf):
        return text
    shown = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return f"{text} (default: {shown})"


def _grouped(groups: Mapping[str, Sequence[OptionText]]) -> str:
    forms = [len(entry.form) for entries in groups.values() for entry in entries]
    indent = min(max(forms) + 2 * len(MARGIN), INDENT_MAX)
    blocks = []
    for title, entries in groups.items():
        if entries:
            lines = [_filled(f"{title[0].upper()}{title[1:]}")]
            for form, text in entries:
                head = f"{MARGIN}{form}".ljust(indent)
                if len(head) > indent or head[-1] != " ":
                    lines.append(head.rstrip())
                    head = " " * indent
                lines.append(_filled(text, head, " " * indent))
            blocks.append("\n".join(lines))
    return "\n\n".join(blocks)


def _paragraphs(text: str) -> list[str]:
    """Paragraphs of a docstring, wrapped to the terminal's width; indented lines are unchanged."""
    parts = cleandoc(text).split("\n\n")
    return [part if part.startswith(" ") else _filled(part) for part in parts if part]


def _filled(text: str, first: str = "", rest: str = "") -> str:
    return textwrap.fill(
        " ".join(text.split()),
        shutil.get_terminal_size().columns,
        initial_indent=first,
        subsequent_indent=rest,
        break_long_words=False,
        break_on_hyphens=False,
    )
