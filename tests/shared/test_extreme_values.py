"""Every scenario that is accepted can be flown, however extreme its values are."""

import os
import typing
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import hypothesis.strategies as st
import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings

from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.sim import flight

TRIGGERS = ["always", "periodic", "state_gap", "cost_gap | silence(1)", "budget(1000000, 1000000)"]


def values(kind: Any) -> st.SearchStrategy[Any]:
    """Values of a scenario's type: the extremes of its range, and any between."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        metas = [each for each in arguments if isinstance(each, msgspec.Meta)]
        return bounded(arguments[0], metas[0]) if metas else values(arguments[0])
    if origin is Literal:
        return st.sampled_from(arguments)
    if origin is tuple:
        items = [values(each) for each in arguments if each is not Ellipsis]
        return st.lists(items[0], max_size=3) if Ellipsis in arguments else st.tuples(*items)
    if arguments:
        return st.one_of(*map(values, arguments))
    if issubclass(kind, msgspec.Struct):
        hints = typing.get_type_hints(kind, include_extras=True)
        return st.fixed_dictionaries({key: values(each) for key, each in hints.items()})
    return {bool: st.booleans(), str: st.just("")}[kind]


def bounded(base: type, meta: msgspec.Meta) -> st.SearchStrategy[Any]:
    """Values of an annotated type; for a text, triggers."""
    if base is str:
        return st.sampled_from(TRIGGERS)
    if typing.get_origin(base) is tuple:
        return values(base)
    low, high = meta.gt if meta.ge is None else meta.ge, meta.le
    assert low is not None
    assert high is not None
    if base is int:
        return st.sampled_from([low, high]) | st.integers(int(low), int(high))
    inner = [float(np.nextafter(end, 1.0)) for end in (low, high)]
    wild = [0.0, 1e-300, -1e-300, 1e-3, 1.0, 1e3]
    extremes = [
        value for value in (low, high, *inner, *wild) if low <= value <= high and value != meta.gt
    ]
    between = st.floats(low, high, exclude_min=meta.gt is not None)
    return st.sampled_from(extremes) | between


def keys(section: type[msgspec.Struct], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, kind in typing.get_type_hints(section, include_extras=True).items():
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            yield from keys(kind, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", kind


KEYS = dict(keys(Scenario))


@st.composite
def drawn(draw: st.DrawFn) -> dict[str, Any]:
    """Keys and values of a scenario; few, because many random ones would contradict each other."""
    chosen = draw(st.lists(st.sampled_from(sorted(KEYS)), min_size=1, max_size=6, unique=True))
    return {key: draw(values(KEYS[key])) for key in chosen}


def made(flat: Mapping[str, Any]) -> Scenario:
    """Scenario with these keys, with at most fifty steps and two seconds to connect."""
    table: dict[str, Any] = {}
    for key, value in {"settle": 0.0, **flat}.items():
        *sections, last = key.split(".")
        inner = table
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[last] = value
    scenario = reading.check(table, "drawn")
    duration = min(scenario.duration, 0.5, 50 * scenario.control.dt)
    link = msgspec.structs.replace(scenario.link, connect_s=min(scenario.link.connect_s, 2.0))
    return msgspec.structs.replace(scenario, duration=duration, link=link)


def fly(scenario: Scenario) -> str:
    """Fly a scenario; returns why it was not flown. Inputs and packets must be finite."""
    flown = flight.fly(scenario)
    assert np.isfinite(flown.client["state"]).all()
    assert np.isfinite(flown.client["input"]).all()
    assert np.isfinite(flown.server["input"]).all()
    return str(flown.failure or "")


def is_flown_or_refused_in_one_line(flat: dict[str, Any]) -> bool:
    try:
        said = fly(made(flat))
    except ConfigError as error:
        said = str(error)
    return len(said.splitlines()) <= 1


@settings(max_examples=30, suppress_health_check=list(HealthCheck))
@given(drawn())
def test_extreme_values_are_flown_or_refused_in_one_line(flat: dict[str, Any]) -> None:
    # The table of heartbeats for a time-out of half an hour takes seconds.
    assume(flat.get("link.timeout_s", 0.0) < 100.0)
    assert is_flown_or_refused_in_one_line(flat)


@pytest.mark.long
@settings(
    max_examples=int(os.environ.get("LIMITS_EXAMPLES", "1000")),
    suppress_health_check=list(HealthCheck),
)
@given(drawn())
def test_many_extreme_values_are_flown_or_refused_in_one_line(flat: dict[str, Any]) -> None:
    assert is_flown_or_refused_in_one_line(flat)
