"""Every scenario that is not refused can be flown, however extreme its values are."""

import os
import typing
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import hypothesis.strategies as st
import msgspec
import numpy as np
from hypothesis import HealthCheck, given, settings

from shared import config
from shared.config import ConfigError, Scenario
from sim import flight

EVENTFUL = ["always", "periodic", "state_gap", "cost_gap | silence(1)", "budget(1000000, 1000000)"]


def extremes(low: float | None, high: float | None) -> list[float]:
    """Both ends of a range, what lies just inside of them and around zero, and far beyond."""
    wild = [0.0, 1e-300, -1e-300, 1e300, -1e300, 1e-3, 1.0, 1e3, 1e9]
    ends = [end for end in (low, high) if end is not None]
    inner = [float(np.nextafter(end, 1.0)) for end in ends]
    return [*ends, *inner, *wild]


def values(kind: Any) -> st.SearchStrategy[Any]:
    """Values of a type of a scenario: the extremes of its range, and anything between."""
    if typing.get_origin(kind) is typing.Annotated:
        base, *notes = typing.get_args(kind)
        (meta,) = (note for note in notes if isinstance(note, msgspec.Meta))
        if base is str:
            return st.sampled_from(EVENTFUL)
        low = meta.ge if meta.ge is not None else meta.gt
        if base is int:
            assert low is not None
            assert meta.le is not None
            ends = [int(low), int(meta.le)]
            return st.sampled_from(ends) | st.integers(*ends)
        between = st.floats(low, meta.le, exclude_min=meta.gt is not None)
        inside = [
            value
            for value in extremes(low, meta.le)
            if (meta.ge is None or value >= meta.ge)
            and (meta.gt is None or value > meta.gt)
            and (meta.le is None or value <= meta.le)
        ]
        return st.sampled_from(inside) | between
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return st.sampled_from(arguments)
    if origin is tuple and arguments[-1] is Ellipsis:
        return st.lists(values(arguments[0]), max_size=3)
    if origin is tuple:
        return st.tuples(*map(values, arguments))
    if arguments:
        return st.one_of(*map(values, arguments))
    plain = {bool: st.booleans(), str: st.just(""), float: st.sampled_from(extremes(None, None))}
    return plain[kind]


def keys(section: type[msgspec.Struct], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every key of a scenario, as it is written there, and its type."""
    for key, kind in typing.get_type_hints(section, include_extras=True).items():
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            yield from keys(kind, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", kind


KEYS = dict(keys(Scenario))


@st.composite
def drawn(draw: st.DrawFn) -> dict[str, Any]:
    """Keys and values of a scenario: a few of them, or there would hardly be two that agree."""
    chosen = draw(st.lists(st.sampled_from(sorted(KEYS)), min_size=1, max_size=6, unique=True))
    return {key: draw(values(KEYS[key])) for key in chosen}


def made(flat: Mapping[str, Any]) -> Scenario:
    """The scenario with these keys, which takes at most fifty steps and two seconds to connect."""
    table: dict[str, Any] = {}
    for key, value in {"settle": 0.0, **flat}.items():
        *sections, last = key.split(".")
        inner = table
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[last] = value
    scenario = config.check(table, "drawn")
    duration = min(scenario.duration, 0.5, 50 * scenario.control.dt)
    link = msgspec.structs.replace(scenario.link, connect_s=min(scenario.link.connect_s, 2.0))
    return msgspec.structs.replace(scenario, duration=duration, link=link)


def fly(scenario: Scenario) -> None:
    """Fly a scenario; what was flown and sent are numbers."""
    flown = flight.fly(scenario)
    assert np.isfinite(flown.client["state"]).all()
    assert np.isfinite(flown.client["input"]).all()
    assert np.isfinite(flown.server["input"]).all()


@settings(
    max_examples=int(os.environ.get("LIMITS_EXAMPLES", "150")),
    deadline=None,
    suppress_health_check=list(HealthCheck),
)
@given(drawn())
def test_extreme_values_are_flown_or_refused_in_one_line(flat: dict[str, Any]) -> None:
    """No number overflows, no step is divided by zero, and no warning is given."""
    try:
        scenario = made(flat)
    except ConfigError as refusal:
        assert len(str(refusal).splitlines()) == 1
        return
    fly(scenario)
