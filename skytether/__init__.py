"""Skytether flies a UAV over a network that delays, reorders and loses packets.

    import skytether

    flight = skytether.fly("demo", duration=20)
    print(flight.summary.rmse_xy)

`docs/python.md` describes the library. The library has the names in `__all__`; a name is imported
when it is first used, so that `import skytether` is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skytether.library.bad_network import bad_network
    from skytether.library.comparing import compare
    from skytether.library.flight import Column, Flight, table
    from skytether.library.flying import check, fly, fly_batch, load
    from skytether.library.sweeping import Swept, sweep
    from skytether.shared.base.errors import ConfigError, FlightError, RecordingError
    from skytether.shared.endpoints.endpoint import Datagram, Endpoint
    from skytether.shared.scenario.whole import Scenario
    from skytether.shared.telemetry.summary import Summary
    from skytether.sim.world import World

__all__ = [
    "Column",
    "ConfigError",
    "Datagram",
    "Endpoint",
    "Flight",
    "FlightError",
    "RecordingError",
    "Scenario",
    "Summary",
    "Swept",
    "World",
    "bad_network",
    "check",
    "compare",
    "fly",
    "fly_batch",
    "load",
    "sweep",
    "table",
]

_HOMES = {
    "skytether.library.bad_network": ("bad_network",),
    "skytether.library.comparing": ("compare",),
    "skytether.library.flight": ("Column", "Flight", "table"),
    "skytether.library.flying": ("check", "fly", "fly_batch", "load"),
    "skytether.library.sweeping": ("Swept", "sweep"),
    "skytether.shared.base.errors": ("ConfigError", "FlightError", "RecordingError"),
    "skytether.shared.endpoints.endpoint": ("Datagram", "Endpoint"),
    "skytether.shared.scenario.whole": ("Scenario",),
    "skytether.shared.telemetry.summary": ("Summary",),
    "skytether.sim.world": ("World",),
}
"""Names of the library, by the module that defines them."""


if not TYPE_CHECKING:  # hidden from type checkers, which would otherwise accept any name

    def __getattr__(name: str) -> Any:
        for module, names in _HOMES.items():
            if name in names:
                value = globals()[name] = getattr(import_module(module), name)
                return value
        raise AttributeError(f"module 'skytether' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
