"""The flight of an experiment: an endpoint around a vehicle, without a server.

It takes off, flies what the experiment says, and lands. What keeps a vehicle from following a plan
ends the flight at once; one that a pilot has taken is left to him.
"""

from typing import Any

import numpy as np

from skytether.client.endpoint import VEHICLE_SOCKET
from skytether.client.navigation import Navigation
from skytether.client.vehicle import Measurement, Vehicle
from skytether.lab.identify.steps import Experiment
from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.endpoint import Datagram, Endpoint
from skytether.shared.core.events import Failure
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason

BLIND_NS = SECOND_NS
"""Time for which the vehicle's state may be unknown [ns]."""
FLOWN_MAX_NS = 3600 * SECOND_NS
"""Longest flight [ns]: what is kept of it stays bounded."""


class Identifying(Endpoint):
    """One vehicle on an experiment.

    Args:
        scenario: the vehicle's own.
        flies: what flies.
        experiment: what it flies.
    """

    def __init__(self, scenario: Scenario, flies: Vehicle, experiment: Experiment) -> None:
        super().__init__()
        self._dt_ns, self._flies, self._port = scenario.dt_ns, flies, flies.port
        self._navigation = Navigation(scenario)
        self.experiment = experiment
        self._epoch_ns: int | None = None
        self._next_ns = 0
        self._step = -1
        self._known_ns = 0
        """Time at which its state was known last."""
        self._input = np.zeros(scenario.model.axes)
        self._ends: Reason | str | None = None
        self.inputs: list[tuple[int, list[float]]] = []
        """Times at which an input was flown from, and the input of each axis [m/s]."""
        self.measured: list[Measurement] = []
        """All that was measured."""

    @property
    def failure(self) -> Failure | None:
        """Event for which it cannot fly."""
        return self._flies.failure

    @property
    def why(self) -> str:
        """Why the flight ended before its time; empty where it did not."""
        return "" if self.experiment.is_over or self._ends is None else str(self._ends)

    @property
    def is_over(self) -> bool:
        """Whether nothing is flown any more."""
        return self._ends is not None

    @property
    def flown_s(self) -> float:
        """Time of flight so far [s]."""
        return 0.0 if self._epoch_ns is None else (self._step + 1) * self._dt_ns / SECOND_NS

    @property
    def finished(self) -> bool:
        """Whether the flight has ended and the vehicle is down, or cannot begin."""
        if self._ends is Reason.TAKEN:
            return True
        return (self._ends is not None or self.failure is not None) and self._flies.is_down

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Hand on what comes from the vehicle's own hardware."""
        if self._port is not None and datagram.socket == VEHICLE_SOCKET:
            self._port.receive(datagram, now_ns=now_ns)
            self._attend()

    def next_wake_ns(self) -> int | None:
        """Begin of the next step, or when the vehicle's port wants to be woken."""
        if self.finished:
            return None
        due_ns = None if self._ends is not None else self._next_ns
        port_ns = self._port.next_wake_ns() if self._port is not None else None
        return min((each for each in (due_ns, port_ns) if each is not None), default=None)

    def wake(self, *, now_ns: int) -> None:
        """Fly the step that is due."""
        if self._port is not None:
            port_ns = self._port.next_wake_ns()
            if port_ns is not None and port_ns <= now_ns:
                self._port.wake(now_ns=now_ns)
        if self._ends is None and self._next_ns <= now_ns and self.failure is None:
            self._go_on(now_ns)
        self._attend()

    def _go_on(self, now_ns: int) -> None:
        """Fly a step, or see whether the first can be flown."""
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
        """Fly what the experiment says, or end."""
        known, hindrance = self._navigation, self._flies.hindrance(now_ns=now_ns)
        if known.is_known:
            self._known_ns = now_ns
        elif now_ns - self._known_ns > BLIND_NS:
            hindrance = hindrance or Reason.NOT_FINITE
        if known.leapt:
            hindrance = hindrance or Reason.LEAPT
        if hindrance is not None:
            self._end(hindrance)
            return
        chosen = [0.0] * len(self._input)
        if known.is_known:
            chosen = self.experiment.choose(known.predicted, now_ns=now_ns)
        self._input = np.array(chosen)
        self._flies.fly(self._input)
        self.inputs.append((now_ns, chosen))
        if self.experiment.is_over:
            self._end("everything is flown")
        elif now_ns - (self._epoch_ns or 0) > FLOWN_MAX_NS:
            self._end("it takes too long")

    def _end(self, why: Reason | str) -> None:
        """Fly no more; the vehicle lands by itself, unless a pilot has it."""
        self._ends = why
        if why is not Reason.TAKEN:
            self._flies.fly(np.zeros(len(self._input)))
            self._flies.land()

    def _attend(self) -> None:
        """Hand on what the vehicle's port wants sent and said."""
        if self._port is not None:
            self._out += [
                Datagram(said, peer, VEHICLE_SOCKET) for said, peer, _ in self._port.outbox()
            ]
            self._events += self._port.events()

    def close(self, *, now_ns: int) -> None:
        """Let the vehicle land by itself, whose process ends."""
        if self._port is not None:
            self._port.close(now_ns=now_ns)
            self._attend()
        if self._ends is None:
            self._ends = "interrupted"

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`."""
        return {"steps": len(self.experiment.steps), "measured": len(self.measured)}
