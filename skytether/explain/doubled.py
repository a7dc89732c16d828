"""Parts of a double (`doubles`) in virtual time: wake-ups of both ends, its network, its vehicle.

The impairment `doubled` repeats the recorded delay and loss of each packet. The vehicle `doubled`
replaces a real vehicle by the model, plus a share of the recorded deviation from the model:

    x(k+1) = A x(k) + B u(k) + share · (x_r(k+1) - A x_r(k) - B u_r(k))

x_r and u_r are the states and inputs of the recorded flight. With the recorded inputs and share 1
the vehicle flies as recorded; with share 0 it flies like the model in calm air.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.sensor import Sensor
from skytether.client.simulated.vehicle import SimulatedVehicle
from skytether.client.simulated.weather import Weather
from skytether.explain.cases import Double
from skytether.netem.impairments.draws import SLOT_S, Draws, Fate
from skytether.netem.impairments.impairment import impairment
from skytether.netem.impairments.traces import Trace
from skytether.shared.base.chance import stream
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.endpoints.steady import Steady
from skytether.shared.law.model import Array
from skytether.shared.scenario.registry import VEHICLES, File
from skytether.shared.scenario.schema import Scenario
from skytether.sim.flight import MIDNIGHT_NS, SERVER
from skytether.sim.world import World

FLOWN: list[Double] = []
"""Recorded flight that the next vehicle of kind `doubled` repeats. It is a global variable, because
a scenario cannot contain arrays."""


def actions(double: Double, scenario: Scenario) -> Iterator[tuple[float, Callable[[World], None]]]:
    """Actions that make a flight in virtual time a double, each with its time of flight [s]."""
    FLOWN[:] = [double]
    client = f"client {scenario.seed}.1"
    if not double.sends_first:
        yield 0.0, partial(_keep_silent, host=client)
    for host, late_ns in ((client, double.client_late_ns), (SERVER[0], double.server_late_ns)):
        yield 0.0, partial(_wake_late, host=host, late_ns=late_ns)
    yield 0.0, partial(World.freeze, name=client)
    yield double.opens_s, partial(World.thaw, name=client)


def _keep_silent(world: World, host: str) -> None:
    """Let a client send nothing at step 0, like a client that must first save its state (see
    `client.memory`).
    """
    client: Any = world.endpoint(host)
    report = client._report

    def first(now_ns: int) -> None:  # noqa: ARG001
        client._report = report

    client._report = first


def _wake_late(world: World, host: str, late_ns: Mapping[int, int]) -> None:
    world.restart(host, Late(world.endpoint(host), late_ns))


class Late(Steady):
    """Endpoint that is woken as late as the recorded process; by default, by the median lateness.

    Args:
        late_ns: see `Double`.
    """

    def __init__(self, inner: Endpoint, late_ns: Mapping[int, int]) -> None:
        super().__init__(inner)
        self._late_ns = late_ns
        self._usual_ns = int(np.median([*late_ns.values()])) if late_ns else 0

    def next_wake_ns(self) -> int | None:
        due_ns = super().next_wake_ns()
        if due_ns is None or due_ns < MIDNIGHT_NS:  # no wake is due, or one immediately
            return due_ns
        return due_ns + self._late_ns.get(due_ns - MIDNIGHT_NS, self._usual_ns)


@impairment(name="doubled")
class DoubledPath(Trace):
    """Delays or loses each packet like the recorded one with the same slot and rank in the slot."""

    def __init__(self, file: File) -> None:
        super().__init__(file, "once")
        rows = [map(float, line.split(",")) for line in file.content.decode().split()[1:]]
        self._fates = {
            (round(time_s / SLOT_S), rank): (seconds_to_ns(delay_s), bool(is_lost))
            for time_s, delay_s, is_lost, rank in rows
        }

    def __call__(self, fate: Fate, draws: Draws) -> None:
        """Apply the fate of the recorded packet; between two recorded packets, interpolate."""
        if (known := self._fates.get((fate.slot, fate.rank))) is None:
            super().__call__(fate, draws)
            return
        fate.delay_ns += known[0]
        fate.lost |= known[1]


class PushedPlant(FirstOrderPlant):
    """Plant without wind; a share of the recorded deviation is added to its state at each step."""

    def __init__(self, scenario: Scenario, flown: Double, share: float) -> None:
        super().__init__(scenario, Weather(scenario, stream(scenario.seed, "calm")))
        model = FirstOrderPlant(scenario, self.weather)
        self._pushes: list[Array] = []
        for state, after, command in zip(
            flown.states, flown.states[1:], flown.inputs, strict=False
        ):
            model.x = state.copy()
            model.advance(command)
            self._pushes.append(share * (after - model.x))
        self._steps = 0
        self.x = flown.states[0].copy()

    def advance(self, command: Array) -> None:
        super().advance(command)
        if self._steps < len(self._pushes):
            self.x += self._pushes[self._steps]
        self._steps += 1


class Ground(Endpoint):
    """Port of a vehicle that is in the air from the time `up_ns` of its clock on."""

    def __init__(self, up_ns: int) -> None:
        super().__init__()
        self._up_ns = up_ns
        self.is_up = False

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Ignore the datagram: nobody sends to this port."""

    def wake(self, *, now_ns: int) -> None:
        self.is_up |= now_ns > self._up_ns

    def next_wake_ns(self) -> int | None:
        return None if self.is_up else self._up_ns


class Doubled(SimulatedVehicle):
    """Vehicle in place of a real vehicle; it takes off at the time recorded for that vehicle."""

    drifts = True
    port: Ground

    def take_off(self, *, now_ns: int) -> bool:  # noqa: ARG002
        return self.port.is_up


@VEHICLES
def doubled(
    scenario: Scenario,
    number: int,  # noqa: ARG001
    share: Annotated[float, Meta(ge=0, le=1)] = 1.0,
) -> Doubled:
    """Model of a real vehicle, plus a share of that vehicle's recorded deviation from the model."""
    sensor, (flown,) = Sensor(scenario, stream(scenario.seed, "sensor")), FLOWN
    made = Doubled(scenario.dt_ns, PushedPlant(scenario, flown, share), sensor)
    made.port = Ground(MIDNIGHT_NS + flown.began_ns - 1)
    return made
