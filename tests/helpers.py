"""Scenarios and shells that tests of several rooms need."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest

from skytether.client.pilot import Pilot
from skytether.shared.core.endpoint import Address
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import Scenario
from skytether.shell.driver import Shell
from skytether.sim import flight

LOOPBACK: Address = ("127.0.0.1", 0)


def packaged(name: str, *layers: Mapping[str, Any], **changes: Any) -> Scenario:
    """Packaged scenario with other keys.

    Args:
        name: the scenario's name.
        layers: tables laid over it, one after the other; a section keeps the keys that its layer
            does not name.
        changes: the last layer.

    Raises:
        ConfigError: the result is no scenario.
    """
    table = reading.to_table(reading.load(name))
    for layer in (*layers, changes):
        for key, value in layer.items():
            table[key] = table[key] | value if isinstance(value, dict) else value
    return reading.check(table, "test")


def uncompile(patch: pytest.MonkeyPatch) -> None:
    """Have vehicles in virtual time fly each step by the methods of `client`.

    Usual steps are one compiled call otherwise (`sim.pilot`), in which a method that a test
    replaces is never called: the test would fly as if it had replaced nothing.
    """
    patch.setattr(flight, "CompiledPilot", Pilot)


@asynccontextmanager
async def driven(*shells: Shell) -> AsyncIterator[None]:
    """Shells that run in this loop until the end of the block."""
    tasks = [asyncio.create_task(each.run()) for each in shells]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
