"""Catalogue of a scenario's keys: owner, term, and whether the key may change in flight.

A key with which both ends predict is a term, and must be equal at both. Each other key has one
owner (server, vehicle, netem or virtual time), or each end reads the key from its own scenario.
Importing this module fails if the type of a key does not name exactly one owner.
"""

from collections.abc import Iterator, Mapping
from operator import attrgetter
from types import MappingProxyType
from typing import NamedTuple

import msgspec

from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.terms import Difference
from skytether.shared.scenario.owners import Key, Owner
from skytether.shared.scenario.schema import Section
from skytether.shared.scenario.whole import Scenario


def keys(section: type[Section], prefix: str = "") -> Iterator[tuple[str, Key]]:
    """Dotted name and metadata of every key of a section, subsections included."""
    for field in msgspec.structs.fields(section):
        if isinstance(field.type, type) and issubclass(field.type, Section):
            yield from keys(field.type, f"{prefix}{field.name}.")
        else:
            metadata = getattr(field.type, "__metadata__", ())
            owned = [each for each in metadata if isinstance(each, Key)]
            assert len(owned) == 1, f"{prefix}{field.name}: expected one owner, as in OfServer[int]"
            yield f"{prefix}{field.name}", owned[0]


KEYS: Mapping[str, Key] = MappingProxyType(dict(keys(Scenario)))

TERMS: Mapping[str, str] = MappingProxyType(
    {
        key.term or name.rpartition(".")[2]: name
        for name, key in KEYS.items()
        if key.owner is Owner.BOTH
    }
)
"""Dotted key of each term, by the term's field in `Terms`."""

DECISIONS: Mapping[str, object] = MappingProxyType(
    {name: attrgetter(name)(Scenario()) for name, key in KEYS.items() if key.is_decision}
)
"""Keys that an operator sets only in flight, with the values that they have before."""


def keys_of(*groups: str) -> frozenset[str]:
    """Dotted names of the keys in these groups, which may change in flight."""
    return frozenset(name for name, key in KEYS.items() if key.in_flight in groups)


def differences(
    here: NamedTuple, there: NamedTuple, names: Mapping[str, str] = TERMS
) -> tuple[Difference, ...]:
    """Fields in which two tuples of one class differ; `names` has the dotted key of each field."""
    return tuple(
        Difference(names[field], _text(field, ours), _text(field, theirs))
        for field, ours, theirs in zip(here._fields, here, there, strict=True)
        if ours != theirs
    )


def _text(field: str, value: object) -> str:
    if field == "dt_ns" and isinstance(value, int):
        return f"{value / SECOND_NS:g}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(str, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)
