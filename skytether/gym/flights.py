"""Skytether's flights as environments: the agent is the trigger, which decides when to send.

`gymnasium.make("skytether/Target-v0")` is one vehicle that follows a target, and `crowd` is a
parallel environment of PettingZoo with many vehicles on one shared link. Planner, wire format,
netem, vehicle and failsafe are those of `skytether fly`, in virtual time.

A step is a control step. An action takes effect at the server's next tick; the observation is the
server's knowledge at its last tick. The reward is minus the true squared distance from the target
[m²], minus `price` for each packet to the vehicle.
"""

import math
from collections.abc import Mapping
from typing import Any

import gymnasium
import msgspec
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from skytether.gym.networked import number
from skytether.server.endpoint import Server
from skytether.server.triggers.trigger import Figures, Situation, Trigger, Verdict
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.law.model import Indices
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Compared
from skytether.sim.flight import BOOT_ID, MIDNIGHT_NS, PLAIN, SERVER, Run
from skytether.sim.hosts import Clock
from skytether.sim.world import World

SINCE_MAX_S = 60.0
OBSERVED = ("expected_gap", "error_x_m", "error_y_m", "since_sent_s", "heartbeat_due")
"""Elements of an observation: expected additional cost of flying on without a new packet, estimated
distance from the target in x and y, time since the last packet to the vehicle, and whether a
heartbeat is due. All elements are 0 before the first plan."""
_SPACE = Box(-1e9, 1e9, (len(OBSERVED),), np.float32)


class Decided(Trigger):
    """Trigger whose threshold an agent sets, separately for each vehicle.

    Args:
        vehicle: number of the vehicle in each row; shape (capacity,).
        thresholds: threshold of `expected_gap` by vehicle; with an infinite threshold no plan is
            sent, with a threshold below 0 every plan is sent.
    """

    doubts = True

    def __init__(self, vehicle: Indices, thresholds: NDArray[np.float64]) -> None:
        self._vehicle, self._thresholds = vehicle, thresholds
        self.seen = np.zeros((len(thresholds), len(OBSERVED)), dtype=np.float32)
        self.sent_packets = np.zeros(len(thresholds), dtype=np.int64)
        self.ticks = np.zeros(len(thresholds), dtype=np.int64)

    def test(self, situation: Situation) -> Verdict:
        each, figures = self._vehicle[situation.rows] - 1, situation.figures
        error = situation.estimate[:, :2, 0] - situation.desired[:, :2, 0, 0]
        since = np.minimum(situation.since_sent_s, SINCE_MAX_S)
        seen = figures["expected_gap"], *error.T, since, situation.heartbeat_due
        self.seen[each] = np.clip(np.column_stack(seen), _SPACE.low, _SPACE.high)
        self.ticks[each] += 1
        gap, threshold = figures["expected_gap"], self._thresholds[each]
        event = figures["fresh"] | (situation.since_sent_s == np.inf) | (gap > threshold)
        return Verdict(event, gap, threshold, Compared.EXPECTED_GAP)

    def sent(self, rows: Indices, figures: Figures) -> None:  # noqa: ARG002
        self.sent_packets[self._vehicle[rows] - 1] += 1


class Flight:
    """Flight in virtual time that pauses after each step for the agent's decision."""

    def __init__(self, scenario: Scenario, vehicles: int) -> None:
        self._scenario, self._vehicles = scenario, vehicles
        self.world = World(lambda *_: None)
        self.run = Run(self.world, scenario, lambda: 0, lambda _: {}, 0, vehicles, PLAIN)
        self._references = [scenario.make_reference(i + 1) for i in range(vehicles)]
        server = Server(
            scenario,
            boot_id=BOOT_ID,
            entropy=stream(scenario.seed, "entropy").bytes,
            capacity=vehicles,
            references=self._measured,
        )
        compute_ns = seconds_to_ns(scenario.simulation.compute_s)
        self.world.add(SERVER[0], server, clock=Clock(MIDNIGHT_NS), compute_ns=compute_ns)
        self.thresholds = np.zeros(vehicles)
        self.trigger = Decided(server.sessions.vehicle, self.thresholds)
        server.controller.use_trigger(self.trigger)
        self._step_ns = 0

    def __reduce__(self) -> str:
        raise TypeError(
            "a flight cannot be copied or pickled; make the environment again, reset it with the "
            "same seed, and take the same steps"
        )

    def _measured(self, vehicle: int) -> Reference:
        return self._scenario.measured_reference(vehicle)

    @property
    def time_s(self) -> float:
        return self._step_ns / SECOND_NS

    def go(self) -> bool:
        """Fly one control step; returns whether every vehicle still flies."""
        self._step_ns += self._scenario.dt_ns
        self.world.run(lambda: not self.run.flying, limit_ns=self._step_ns)
        return self.run.flying == self._vehicles

    def squares_m2(self) -> NDArray[np.float64]:
        """True squared distance of each vehicle from its target [m²]; 0 before it flies."""
        found = np.zeros(self._vehicles)
        for row in self.run.steps.rows(-2 * self._vehicles):
            vehicle = int(row["vehicle"]) - 1
            at_s = np.array([row["step"] * self._scenario.control.dt])
            desired = self._references[vehicle](at_s)[0, :, 0]
            found[vehicle] = np.sum((row["state"][:, 0] - desired) ** 2)
        return found


def _scenario(name: str, keys: Mapping[str, Any], seed: int) -> Scenario:
    table = reading.to_table(reading.load(name))
    set_keys(dict(keys) | {"seed": seed, "control.trigger": "expected_gap | heartbeat"}, table)
    return reading.check(table, name)


class Target(gymnasium.Env[NDArray[np.float32], Any]):
    """Environment with one vehicle that follows a target, which only the server sees.

    Args:
        action: "send": 1 sends a plan, 0 does not; "threshold": a plan is sent if the expected cost
            of not sending exceeds the action.
        price: cost of a packet to the vehicle [m²].
        scenario: name of a scenario with a trigger that computes `expected_gap`.
        keys: keys of the scenario, as in `skytether.load`.

    Raises:
        ConfigError: the scenario cannot be flown.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - gymnasium's own form

    def __init__(
        self,
        action: str = "send",
        price: float = 0.01,
        scenario: str = "target",
        keys: Mapping[str, Any] | None = None,
    ) -> None:
        if action not in ("send", "threshold"):
            raise ConfigError(f"action: got {action!r}, expected 'send' or 'threshold'")
        self.observation_space = _SPACE
        is_sending = action == "send"
        self.action_space = Discrete(2) if is_sending else Box(0.0, 1e3, (1,), np.float32)
        self._is_sending, self._price = is_sending, number("price", price, 0.0, math.inf)
        self._flight: Flight | None = None
        self._config = _scenario(scenario, keys or {}, 1)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed, options=options)
        config = msgspec.structs.replace(
            self._config, seed=int(self.np_random.integers(2**32, dtype=np.uint64))
        )
        self._flight = Flight(config, 1)
        return self._flight.trigger.seen[0].copy(), self._info(self._flight)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        flight = self._flight
        if flight is None:
            raise ResetNeeded("step: called before reset, which gives the first observation")
        value = float(np.asarray(action).reshape(-1)[0])
        flight.thresholds[0] = (-1.0 if value else np.inf) if self._is_sending else value
        before = int(flight.trigger.sent_packets[0])
        flies = flight.go()
        sent = int(flight.trigger.sent_packets[0]) - before
        reward = -float(flight.squares_m2()[0]) - self._price * sent
        over = not flies or flight.time_s >= self._config.duration
        return flight.trigger.seen[0].copy(), reward, False, over, self._info(flight)

    def _info(self, flight: Flight) -> dict[str, Any]:
        return {"time_s": flight.time_s, "packets": int(flight.trigger.sent_packets[0])}


class Crowd(ParallelEnv):  # type: ignore[misc]  # it ships no types
    """Environment with many vehicles on one shared link; an agent per vehicle decides when to send.

    Args:
        vehicles: number of vehicles.
        price: cost of a packet to a vehicle [m²].
        scenario: name of a scenario; its network needs a finite rate for vehicles to compete.
        keys: keys of the scenario, as in `skytether.load`.
    """

    metadata = {"name": "skytether/Crowd-v0", "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        vehicles: int = 8,
        price: float = 0.01,
        scenario: str = "crowd",
        keys: Mapping[str, Any] | None = None,
    ) -> None:
        self.possible_agents = [f"vehicle_{number}" for number in range(1, vehicles + 1)]
        self.agents: list[str] = []
        self._price = number("price", price, 0.0, math.inf)
        self._config = _scenario(scenario, keys or {}, 1)
        self._spaces = {agent: Discrete(2) for agent in self.possible_agents}
        self._seen = {agent: Box(-1e9, 1e9, _SPACE.shape, np.float32) for agent in self._spaces}
        self._rng = np.random.default_rng(0)
        self._flight: Flight | None = None

    def observation_space(self, agent: str) -> Box:
        return self._seen[agent]

    def action_space(self, agent: str) -> "Discrete[Any]":  # a generic type since gymnasium 1.3
        return self._spaces[agent]

    def reset(
        self,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        drawn = int(self._rng.integers(2**32, dtype=np.uint64))
        config = msgspec.structs.replace(self._config, seed=drawn)
        self.agents = list(self.possible_agents)
        self._flight = Flight(config, len(self.agents))
        return self._observations(self._flight), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[Any, Any, Any, Any, Any]:
        flight = self._flight
        if flight is None:
            raise ResetNeeded("step: called before reset, which gives the first observation")
        for index, agent in enumerate(self.possible_agents):
            flight.thresholds[index] = -1.0 if actions.get(agent) else np.inf
        before = flight.trigger.sent_packets.copy()
        flies = flight.go()
        sent = flight.trigger.sent_packets - before
        rewards = -flight.squares_m2() - self._price * sent
        over = not flies or flight.time_s >= self._config.duration
        agents, observations = self.agents, self._observations(flight)
        self.agents = [] if over else agents
        return (
            observations,
            {agent: float(reward) for agent, reward in zip(agents, rewards, strict=True)},
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, over),
            {
                agent: {"packets": int(count)}
                for agent, count in zip(agents, flight.trigger.sent_packets, strict=True)
            },
        )

    def _observations(self, flight: Flight) -> dict[str, NDArray[np.float32]]:
        seen = flight.trigger.seen
        return {agent: seen[i].copy() for i, agent in enumerate(self.possible_agents)}


gymnasium.register("skytether/Target-v0", entry_point="skytether.gym.flights:Target")
