"""The adversary: what it does, that it finds planted faults, and that what it found comes again."""

import math
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from skytether.lab import adversary
from skytether.lab.adversary import (
    Air,
    Approach,
    Climb,
    Kind,
    Move,
    Moves,
    climb,
    dumps,
    fly,
    loads,
    shrunk,
    spare_m,
)
from skytether.server.control import roster
from skytether.server.control.known import Known
from skytether.server.control.together import Together
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.core.endpoint import Datagram
from skytether.shared.law.motion import Motion
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import Scenario

Patch = Callable[[pytest.MonkeyPatch], None]


def scenario(shape: str, duration: float = 40.0) -> Scenario:
    """A mission, by its name or shape."""
    loaded = reading.load(shape.partition("(")[0])
    if "(" in shape:
        reference = msgspec.structs.replace(loaded.reference, shape=shape)
        loaded = msgspec.structs.replace(loaded, reference=reference)
    return msgspec.structs.replace(loaded, duration=duration)


def move(
    kind: Kind, vehicle: int, way: str, start_s: float, length_s: float, *amounts: float
) -> Move:
    """A move, in seconds."""
    start_ns, length_ns = seconds_to_ns(start_s), seconds_to_ns(length_s)
    return Move(kind, vehicle, way, start_ns, length_ns, amounts)


FOUR = scenario("swap(4)")


def newest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the server keep apart from the newest motion alone."""
    motions = Known.motions

    def last(self: Known) -> list[Motion]:
        return motions(self)[-1:]

    monkeypatch.setattr(Known, "motions", last)


def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a new server not wait for the end of motions of the one before."""
    monkeypatch.setattr(roster, "LONGEST", -(10**6))


def heedless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the server accept zones that vehicles may fly into."""
    monkeypatch.setattr(Together, "objection", lambda *_: "")


@pytest.mark.parametrize(
    ("kinds", "ablation", "tries"),
    [
        ("losses,cuts", newest, 40),
        ("server", hasty, 40),
        ("zones", heedless, 20),
        ("goals", newest, 40),
        ("copies", newest, 40),
    ],
)
def test_each_kind_of_move_finds_a_planted_fault(
    kinds: str, ablation: Patch, tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A safeguard is off; with it, the same moves do no harm."""
    task = Climb(FOUR, tuple(map(Kind, kinds.split(","))), 1, tries)
    with monkeypatch.context() as without:
        ablation(without)
        best = climb(task).best
        assert spare_m(FOUR, best) < 0.0
    assert spare_m(FOUR, fly(FOUR, best.moves)) > 0.0
