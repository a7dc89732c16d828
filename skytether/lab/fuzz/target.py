"""Target of fuzzing: something that takes bytes of others, and what is promised of it."""

from collections.abc import Sequence
from inspect import isclass, isfunction
from random import Random
from types import FunctionType, ModuleType
from typing import Any

from skytether.lab.fuzz.mutators import bytes_changed


class Target:
    """Something that takes bytes, and raises where a promise is broken."""

    code: Sequence[ModuleType] = ()
    """Modules by whose branches atheris is guided; kernels are compiled, and are none."""
    largest = 1300
    """Size of the largest input [B]."""

    def __call__(self, payload: bytes) -> None:
        """Take an input.

        Raises:
            Exception: whatever is not promised.
        """
        raise NotImplementedError

    def seeds(self) -> Sequence[bytes]:
        """Inputs to begin with; there may be others of them later."""
        raise NotImplementedError

    def mutated(self, rng: Random, payload: bytes) -> bytes:
        """An input with something changed."""
        return bytes_changed(rng, payload)

    def next(self, rng: Random) -> bytes:
        """An input: random bytes, or a mutated one of the seeds."""
        if rng.random() < 0.1:
            return rng.randbytes(rng.randrange(1500))
        return self.mutated(rng, rng.choice(self.seeds()))


def functions(space: Any) -> list[FunctionType]:
    """Functions and methods of a module or class."""
    found = []
    for each in vars(space).values():
        if getattr(each, "__module__", None) != getattr(space, "__module__", space.__name__):
            continue
        if isfunction(each):
            found.append(each)
        elif isclass(each) and isclass(space) is False:
            found += functions(each)
    return found
