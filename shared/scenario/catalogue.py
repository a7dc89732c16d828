"""Catalogue of a scenario's keys: their owners, the terms made of them, and which may change.

Whatever both ends predict with is a term. Every other key belongs to one end, which may set it as
it likes. There is no third kind: a key that does not name its owner cannot be imported.
"""

from collections.abc import Iterator, Mapping
from types import MappingProxyType

import msgspec

from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.terms import Difference, Terms
from skytether.shared.scenario.owners import InFlight, Key, Owner
from skytether.shared.scenario.schema import Scenario, Section


def keys(section: type[Section], prefix: str = "") -> Iterator[tuple[str, Key]]:
    """Every key of a section and of those within it, with dots, and its metadata."""
    for field in msgspec.structs.fields(section):
        if isinstance(field.type, type) and issubclass(field.type, Section):
            yield from keys(field.type, f"{prefix}{field.name}.")
        else:
            metadata = getattr(field.type, "__metadata__", ())
            found = [each for each in metadata if isinstance(each, Key)]
            assert len(found) == 1, f"{prefix}{field.name}: expected one owner, as in OfServer[int]"
            yield f"{prefix}{field.name}", found[0]


KEYS: Mapping[str, Key] = MappingProxyType(dict(keys(Scenario)))
"""Every key of a scenario, with dots, and its metadata."""

TERMS: Mapping[str, str] = MappingProxyType(
    {
        key.term or name.rpartition(".")[2]: name
        for name, key in KEYS.items()
        if key.owner is Owner.BOTH
    }
)
"""Key that each term is made of, by the term's field in `Terms`."""


def keys_of(*groups: InFlight) -> frozenset[str]:
    """Keys that may change in flight, of these groups."""
    return frozenset(name for name, key in KEYS.items() if key.in_flight in groups)


def differences(here: Terms, there: Terms) -> tuple[Difference, ...]:
    """Every term on which two ends differ, told by its key."""
    return tuple(
        Difference(TERMS[field], _text(field, ours), _text(field, theirs))
        for field, ours, theirs in zip(Terms._fields, here, there, strict=True)
        if ours != theirs
    )


def _text(field: str, value: object) -> str:
    """A term as the scenario writes it."""
    if field == "dt_ns" and isinstance(value, int):
        return f"{value / SECOND_NS:g}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(str, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)
