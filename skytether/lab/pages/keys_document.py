"""Text of docs/keys.md, made from the sections of a scenario; `make keys` writes it.

A key's meaning is its docstring in the section, as in `--help`, with the unit in brackets.
"""

import inspect
import re
from collections.abc import Iterator
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec

from skytether.shared.base.meanings import meanings
from skytether.shared.scenario.catalogue import KEYS
from skytether.shared.scenario.schema import Section
from skytether.shared.scenario.whole import Scenario

HEAD = """# Keys of a scenario

Every key that a scenario's file may have; each is also a flag of every command that flies. `make
keys` makes this page from the sections of `shared/scenario/schema.py` and of optional features.

- **Values** are written as in TOML, with the unit in square brackets; bounds of a list apply to
  each of its numbers.
- The **owner** of a key is the process that uses its value. A key of *both ends* is a
  [term](protocol.md#terms): if server and vehicle have different values, there is no flight. Other
  keys may differ; with *each end*, server and vehicle each use their own value. Keys of *virtual
  time* are not used over UDP.
- A key marked *in flight* can be [changed in flight](operating.md#change-keys-in-flight);
  `reference.points_m` and `reference.velocity_mps` only with `reference.shape = "live"`.
- Meanings use the terms of the [glossary](glossary.md), such as [horizon](glossary.md#horizon),
  [trigger](glossary.md#trigger) and [scheme](glossary.md#scheme).
"""


def document() -> str:
    return "\n".join([HEAD, *_tables(Scenario, "", inspect.getdoc(Scenario) or "")])


def _tables(section: type[Section], prefix: str, about: str) -> Iterator[str]:
    descriptions = meanings(section)
    rows: list[str] = []
    within: list[str] = []
    for field in msgspec.structs.fields(section):
        name = f"{prefix}{field.name}"
        if name in KEYS:
            rows.append(_row(name, field, descriptions[field.name]))
        else:
            inner = descriptions.get(field.name) or inspect.getdoc(field.type) or ""
            within += _tables(field.type, f"{name}.", inner)
    yield f"## {prefix.rstrip('.') or 'scenario'}\n\n{about}\n"
    yield "| key | values | default | owner | meaning |"
    yield "|---|---|---|---|---|"
    yield "\n".join(rows) + "\n"
    yield from within


def _row(name: str, field: msgspec.structs.FieldInfo, sentence: str) -> str:
    """Table row of a key; its unit is put after the allowed values."""
    key = KEYS[name]
    units = ", ".join(dict.fromkeys(re.findall(r"\[(.*?)\]", sentence)))
    cells = (
        f"`{name}`",
        values(field.type) + (f" [{units}]" if units else ""),
        f"`{_toml(field.default)}`",
        key.owner.value + (", in flight" if key.in_flight else ""),
        re.sub(r" \[.*?\]", "", sentence),
    )
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def values(kind: Any) -> str:
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        metas = [each for each in parts if isinstance(each, msgspec.Meta)]
        return _bounded(parts[0], metas[0]) if metas else values(parts[0])
    if origin is Literal:
        return ", ".join(f"`{_toml(part)}`" for part in parts)
    if origin is tuple:
        each = values(parts[0])
        if get_origin(parts[0]) is tuple:
            return each.replace("list of", "list of lists of")
        return f"{'list of' if parts[-1] is Ellipsis else len(parts)} numbers, {each}"
    if parts:
        return _either([values(part) for part in parts])
    return {bool: "`true`, `false`", str: "text"}[kind]


def _either(kinds: list[str]) -> str:
    """Allowed values of a union type, words first. A number or list of numbers has one range."""
    if kinds[1] == f"list of numbers, {kinds[0]}":
        return f"number or {kinds[1]}"
    return " or ".join(sorted(kinds, key=lambda each: not each.startswith("`")))


def _bounded(kind: type, meta: msgspec.Meta) -> str:
    if kind is str:
        return "text"
    if get_origin(kind) is tuple:
        return f"list of at most {meta.max_length} tables"
    low = _number(meta.ge) if meta.gt is None else f"more than {_number(meta.gt)}"
    return f"{'whole number, ' * (kind is int)}{low} to {_number(meta.le)}"


def _number(value: float | None) -> str:
    assert value is not None  # every number of a scenario has bounds
    return str(value) if isinstance(value, int) else f"{value:g}".replace("e+0", "e")


def _toml(value: object) -> str:
    """Value in a notation that is valid in TOML and in JSON."""
    return msgspec.json.encode(value).decode()


if __name__ == "__main__":
    print(document(), end="")
