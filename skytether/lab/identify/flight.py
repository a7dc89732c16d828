"""Flight of an experiment: an endpoint that flies a vehicle without a server.

The vehicle takes off, flies the experiment, and lands. Any event that would prevent a vehicle from
following a plan ends the flight at once; a pilot who takes over keeps control of the vehicle.
"""

from typing import Any

import numpy as np

from skytether.client.endpoint import VEHICLE_SOCKET
from skytether.client.navigation import Navigation
from skytether.client.vehicle import Measurement, Vehicle
from skytether.lab.identify.steps import Experiment
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.events.flight import Failure
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Reason

BLIND_NS = SECOND_NS
"""Longest time without the vehicle's state, after which the flight ends [ns]."""
FLOWN_MAX_NS = 3600 * SECOND_NS
"""Longest flight [ns]. The limit bounds the memory for measurements."""


class Identifying(Endpoint):
    """Endpoint that flies an experiment with a vehicle."""

    def __init__(self, scenario: Scenario, flies: Vehicle, experiment: Experiment) -> None:
        super().__init__()
        self._dt_ns, self._flies, self._port = scenario.dt_ns, flies, flies.port
        self._navigation = Navigation(scenario)
        self.experiment = experiment
        self._epoch_ns: int | None = None
        self._next_ns = 0
        self._step = -1
        self._known_ns = 0
        """Newest time at which the vehicle's state was known [ns]."""
        self._input = np.zeros(scenario.model.axes)
        self._ends: Reason | str | None = None
        self.inputs: list[tuple[int, list[float]]] = []
        """Times of changes of the input [ns], and the input of each axis from then on [m/s]."""
        self.measured: list[Measurement] = []

    @property
    def failure(self) -> Failure | None:
        return self._flies.failure

    @property
    def why(self) -> str:
        """Reason why the flight ended early; empty otherwise."""
        return "" if self.experiment.is_over or self._ends is None else str(self._ends)

    @property
    def is_over(self) -> bool:
        return self._ends is not None

    @property
    def flown_s(self) -> float:
        return 0.0 if self._epoch_ns is None else (self._step + 1) * self._dt_ns / SECOND_NS

    @property
    def finished(self) -> bool:
        """Whether the flight has ended on the ground or cannot begin, or a pilot has taken over."""
        if self._ends is Reason.TAKEN:
            return True
        return (self._ends is not None or self.failure is not None) and self._flies.is_down

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        if self._port is not None and datagram.socket == VEHICLE_SOCKET:
            self._port.receive(datagram, now_ns=now_ns)
            self._attend()

    def next_wake_ns(self) -> int | None:
        if self.finished:
            return None
        due_ns = None if self._ends is not None else self._next_ns
        port_ns = self._port.next_wake_ns() if self._port is not None else None
        return min((each for each in (due_ns, port_ns) if each is not None), default=None)

    def wake(self, *, now_ns: int) -> None:
        if self._port is not None:
            port_ns = self._port.next_wake_ns()
            if port_ns is not None and port_ns <= now_ns:
                self._port.wake(now_ns=now_ns)
        if self._ends is None and self._next_ns <= now_ns and self.failure is None:
            self._go_on(now_ns)
        self._attend()

    def _go_on(self, now_ns: int) -> None:
        """Fly a step; before the first step, take off once the vehicle is ready."""
        if self._epoch_ns is None:
            if not (self._flies.is_ready and self._flies.take_off(now_ns=now_ns)):
                self._next_ns = now_ns + self._dt_ns
                return
            self._epoch_ns = self._known_ns = now_ns
        present = (now_ns - self._epoch_ns) // self._dt_ns
        for step in range(self._step + 1, present + 1):
            began_ns = self._epoch_ns + step * self._dt_ns
            measured = self._flies.measurements(now_ns=began_ns)
            self._navigation.advance(measured, self._input, now_ns=began_ns)
            self.measured += measured
        self._step, self._next_ns = present, self._epoch_ns + (present + 1) * self._dt_ns
        self._fly(now_ns)

    def _fly(self, now_ns: int) -> None:
        navigation, hindrance = self._navigation, self._flies.hindrance(now_ns=now_ns)
        if navigation.is_known:
            self._known_ns = now_ns
        elif now_ns - self._known_ns > BLIND_NS:
            hindrance = hindrance or Reason.NOT_FINITE
        if navigation.leapt:
            hindrance = hindrance or Reason.LEAPT
        if hindrance is not None:
            self._end(hindrance)
            return
        chosen = [0.0] * len(self._input)
        if navigation.is_known:
            chosen = self.experiment.choose(navigation.predicted.tolist(), now_ns=now_ns)
        self._input = np.array(chosen)
        self._flies.fly(self._input)
        self.inputs.append((now_ns, chosen))
        if self.experiment.is_over:
            self._end("the experiment is complete")
        elif now_ns - (self._epoch_ns or 0) > FLOWN_MAX_NS:
            self._end("it has reached the longest flight time")

    def _end(self, why: Reason | str) -> None:
        """End the flight. The vehicle lands, unless a pilot has taken over."""
        self._ends = why
        if why is not Reason.TAKEN:
            self._flies.fly(np.zeros(len(self._input)))
            self._flies.land()

    def _attend(self) -> None:
        if self._port is not None:
            self._out += [
                Datagram(said, peer, VEHICLE_SOCKET) for said, peer, _ in self._port.outbox()
            ]
            self._events += self._port.events()

    def close(self, *, now_ns: int) -> None:
        if self._port is not None:
            self._port.close(now_ns=now_ns)
            self._attend()
        if self._ends is None:
            self._ends = "interrupted"

    def figures(self) -> dict[str, Any]:
        return {"steps": len(self.experiment.steps), "measured": len(self.measured)}
