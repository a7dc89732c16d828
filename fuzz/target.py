"""Base of all fuzzing targets: it takes bytes from outside, and checks the guarantees."""

from collections.abc import Sequence
from functools import cache
from inspect import isclass, isfunction
from random import Random
from types import FunctionType, ModuleType
from typing import Any

import msgspec

from fuzz.mutators import bytes_changed
from skytether.shared.scenario import reading
from skytether.shared.telemetry.record import Record
from skytether.sim.flight import fly

SCENARIO = msgspec.structs.replace(reading.load("demo"), duration=1.0, settle=0.0)


@cache
def flown() -> Record:
    return fly(SCENARIO)


class Target:
    """Target that takes bytes, and raises if a guarantee is broken."""

    code: Sequence[ModuleType] = ()
    """Modules whose branches guide atheris; compiled kernels are not among them."""
    largest = 1300
    """Size of the largest input [B]."""

    def __call__(self, payload: bytes) -> None:
        """Check an input; raises an exception if a guarantee is broken."""
        raise NotImplementedError

    def seeds(self) -> Sequence[bytes]:
        """Valid inputs to begin with; the list may change later."""
        raise NotImplementedError

    def mutated(self, rng: Random, payload: bytes) -> bytes:
        return bytes_changed(rng, payload)

    def next(self, rng: Random) -> bytes:
        if rng.random() < 0.1:
            return rng.randbytes(rng.randrange(1500))
        return self.mutated(rng, rng.choice(self.seeds()))


def functions(space: Any) -> list[FunctionType]:
    """Functions and methods defined in a module or class."""
    found = []
    for each in vars(space).values():
        if getattr(each, "__module__", None) != getattr(space, "__module__", space.__name__):
            continue
        if isfunction(each):
            found.append(each)
        elif isclass(each) and isclass(space) is False:
            found += functions(each)
    return found
