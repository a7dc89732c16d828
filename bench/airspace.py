"""Vehicles that fly the server's plans without a network, to measure only the server's work.

Observations arrive some steps late, as over the paper's network, so that the estimator has the same
work. The vehicles are spread along the reference and simulated by the model, with noise.
"""

from collections import deque

import numpy as np

from skytether.server.controller import BLOCK
from skytether.server.endpoint import Server
from skytether.server.mpc.hierarchical import Planner
from skytether.server.planning.desired import Desired
from skytether.server.planning.scheme import empty_foresight
from skytether.server.schemes.horizons import HorizonScheme
from skytether.shared.base.chance import stream
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.law.heartbeat import NUMBERS
from skytether.shared.law.model import Array, Indices, discretise
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire.protocol import (
    NO_HORIZON,
    Hello,
    Mode,
    Observation,
    Welcome,
    ahead_max,
    decode,
    encode,
    stamp_us,
)

NOISE = np.array([0.001, 0.01])
"""Standard deviation of a step's noise on position [m] and velocity [m/s]."""
DELAY_S = 0.44
"""Delay of an observation [s]: the mean of the paper's network."""
START_NS = 20 * SECOND_NS
"""Time of the first tick on the server's clock [ns]."""
PERIOD_S = 27.5
"""Time over which the vehicles are spread along the reference [s]."""


class Vehicles:
    def __init__(self, scenario: Scenario, count: int) -> None:
        self._rng = np.random.default_rng(1)
        self._model = discretise(scenario.true_tau_s, scenario.control.dt)
        spread = round(PERIOD_S / scenario.control.dt)
        self.step: Indices = self._rng.integers(spread, 2 * spread, count)
        """Step k of each vehicle; shape (n,)."""
        self.x: Array = scenario.make_reference()(self.step * scenario.control.dt)
        """State of each vehicle [m, m/s]; shape (n, axes, 2)."""

    def fly(self, u: Array) -> None:
        """Fly one step with these inputs [m/s; shape (n, axes)]."""
        noise = self._rng.standard_normal(self.x.shape) * NOISE
        self.x = self._model.step(self.x, u) + noise
        self.step = self.step + 1


class PlannedFleet:
    """Planner that is given the exact states of its vehicles, and plans in blocks as the server
    does.
    """

    def __init__(self, scenario: Scenario, count: int) -> None:
        terms = scenario.terms()
        desired = Desired(scenario, terms, count, BLOCK)
        self._planner = Planner(scenario.control, terms, desired, count, BLOCK, Stopwatch())
        self._found = empty_foresight(BLOCK, terms.axes, terms.horizon, ahead_max(terms))
        self._vehicles = Vehicles(scenario, count)
        self._blocks = [
            np.arange(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)
        ]

    @property
    def x(self) -> Array:
        return self._vehicles.x

    def plan(self) -> None:
        for rows in self._blocks:
            self._found.start[: len(rows)] = self._vehicles.x[rows]
            self._planner.plan(rows, self._vehicles.step[rows], self._found)

    def fly(self) -> None:
        self._vehicles.fly(self._planner.inputs[:, :, 0])


class Airspace:
    """Server, and vehicles in session with it; the scenario's trigger must send at every step."""

    def __init__(self, scenario: Scenario, count: int, stopwatch: Stopwatch | None = None) -> None:
        self.server = Server(
            scenario,
            boot_id=1,
            entropy=stream(1, "entropy").bytes,
            capacity=count,
            stopwatch=stopwatch,
        )
        self._vehicles = Vehicles(scenario, count)
        self._dt_ns = scenario.dt_ns
        self._late = round(DELAY_S / scenario.control.dt)
        """Age of an observation [steps]."""
        self._past = deque([self._vehicles.x] * (self._late + 1), maxlen=self._late + 1)
        self._due_ns = START_NS
        self._sessions = [self._open(number, scenario) for number in range(1, count + 1)]

    def _open(self, vehicle: int, scenario: Scenario) -> tuple[int, int, Address]:
        address: Address = ("127.0.0.1", 1024 + vehicle)
        hello = Datagram(encode(Hello(vehicle, 1, scenario.terms())), address)
        self.server.receive(hello, now_ns=self._due_ns - self._dt_ns)
        (answer,) = self.server.outbox()
        welcome = decode(answer.payload, scenario.terms())
        assert isinstance(welcome, Welcome)
        return vehicle, welcome.session, address

    def _observe(self) -> None:
        now_ns, late_ns = self._due_ns - MILLISECOND_NS, self._late * self._dt_ns
        step = (self._vehicles.step - self._late).tolist()
        for (vehicle, session, address), k, x in zip(
            self._sessions, step, self._past[0], strict=True
        ):
            # Packets that the server sent at step now - 2 late arrived at now - late.
            backward_us = stamp_us(k * self._dt_ns - self._due_ns + 2 * late_ns)
            observation = Observation(
                vehicle,
                session,
                k,
                NO_HORIZON,
                0,
                backward_us,
                k % NUMBERS,
                Mode.TRACK,
                1,
                x,
                np.zeros(len(x)),
            )
            self.server.receive(Datagram(encode(observation), address), now_ns=now_ns)

    def wake(self) -> None:
        self.server.wake(now_ns=self._due_ns)

    def prepare(self) -> None:
        """Fly the previous step, and send the server an observation of every vehicle."""
        sent = len(self.server.outbox())
        if sent:
            assert sent == len(self._sessions), "no horizon was sent to some vehicle"
            scheme = self.server.controller.scheme
            assert isinstance(scheme, HorizonScheme), "a trajectory is no plan"
            planned = scheme.planner.inputs
            self._vehicles.fly(planned[:sent, :, 0])
            self._past.append(self._vehicles.x)
            self._due_ns += self._dt_ns
        self._observe()
