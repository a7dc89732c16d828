"""Algorithm of the server: what is computed at a step of n vehicles, without any datagram.

    observations → x̂(k), x̂(k+d) (`schemes`) → X_p(k+d), U(k+d), V, cost gap, deviation
    (`mpc.hierarchical`) → event? (`trigger`) → what is sent, remembered.

With the schemes "predictive" and "none" d is 0; with "trajectory" nothing is planned, and
`schemes.trajectory`, or on a mission `missions.mission_planner`, stands in place of both. Every
vehicle is planned for at every step, for planning is a small part of what a step costs.
"""

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from skytether.server import missions
from skytether.server.budget import SharedBudget
from skytether.server.common import splines
from skytether.server.common.clock import UNSEEN, ClockMap, Seen, shortest_ns
from skytether.server.common.desired import Desired
from skytether.server.common.scheme import DOUBTS, Batch, Figures, Fleet, Scheme, foresight
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.server.missions.mission_state import MissionState
from skytether.server.schemes import table
from skytether.shared.base.kernel import B1, I1, KERNELS, kernel
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import ControlConfig, Scenario
from skytether.shared.scenario.triggers import KnownArrays, Situation, Verdict, make_trigger
from skytether.shared.wire.protocol import Idle, Observation, committed_max

PLANS, OBSERVATION, DELAY, UNSOLVED = map(int, Idle)
"""Members of `Idle` as plain numbers, for kernels."""
BLOCK = 128
"""Vehicles that are planned for at a time: what belongs to them stays in the cache, and no array is
so large (128 KiB) that the C library would ask the kernel for its memory, and fault it in, anew."""


def _mission(fleet: Fleet) -> Scheme:
    assert fleet.references is not None
    state = MissionState(
        fleet.scenario,
        fleet.terms,
        fleet.capacity,
        fleet.block,
        fleet.references,
        fleet.desired.number,
        fleet.clock,
    )
    return MissionPlanner(fleet, state)


MISSION_KERNELS = (missions, splines)
"""Modules and packages whose kernels are called where vehicles keep apart."""


def other_schemes(scenario: Scenario) -> set[str]:
    """Names of the modules whose kernels are not called where a scenario is flown."""
    own = MISSION_KERNELS if scenario.is_mission else table.kernels(scenario.control.scheme)
    every = {*MISSION_KERNELS}.union(*map(table.kernels, table.OURS))
    names = tuple(f"{each.__name__}." for each in every.difference(own))
    return {each.__module__ for each in KERNELS if f"{each.__module__}.".startswith(names)}


class Decisions(NamedTuple):
    """Decisions on n vehicles at a step; valid until the next decisions are made."""

    batch: Batch
    """The vehicles, what is foreseen of them, and which are sent their plan."""
    figures: Figures
    """Costs of the plans; shape (n,)."""
    planned: Array
    """Planned state x_p(k+d|k-1) [m, m/s]; shape (n, axes, 2)."""
    verdict: Verdict
    """Verdict of the trigger."""
    event: Flags
    """Whether each vehicle is sent its plan; shape (n,)."""
    solve_ns: int
    """Time that planning for all of them took [ns], or -1 where nobody measures it."""


class Controller:
    """Server's part of the paper's algorithms for up to `room` vehicles.

    Args:
        scenario: what to fly, and how to plan.
        terms: the same, as far as both ends agree on it.
        clock: knows half of the smallest round trip of each vehicle.
        stopwatch: measures the parts; the core has no clock of its own.
        references: see `Desired`.
    """

    def __init__(
        self,
        scenario: Scenario,
        terms: Terms,
        room: int,
        clock: ClockMap,
        stopwatch: Stopwatch,
        references: Callable[[int], Reference] | None = None,
    ) -> None:
        control = scenario.control
        # Arrays of a block are allocated once, and written anew for each block of a tick.
        block = min(room, BLOCK)
        self._age_max = terms.age_max
        self._clock = clock
        most = committed_max(terms)
        self._uplink_max_ns = (most if terms.commits else terms.horizon) * terms.dt_ns
        """Longest delay to a vehicle that a horizon has room for [ns]."""
        if not terms.indexed:
            self._uplink_max_ns = UNSEEN  # whenever it comes, its first input is flown
        self.desired = Desired(scenario, terms, room, block, references)
        """Desired trajectories as far as they are known."""
        self.faults: list[str] = []
        """Tracebacks of plug-ins' mistakes, one for the scheme and each policy, to be told."""
        fleet = Fleet(
            scenario,
            terms,
            room,
            block,
            clock,
            self.desired,
            references,
            stopwatch,
            self.faults.append,
        )
        is_mission = scenario.is_mission and references is not None
        self.scheme = _mission(fleet) if is_mission else table.make(fleet)
        """What is believed of vehicles, planned and sent."""
        self.columns = control.properties.figures
        """Figures of plans that are recorded."""
        self._terms, self._room, self._block = terms, room, block
        self._sent_step = np.full(room, -1, dtype=np.int64)
        """Step at which each vehicle was sent a horizon last, or -1; shape (room,)."""
        self._heartbeat_due: Flags = np.zeros(room, dtype=np.bool_)
        """Whether each vehicle is sent a heartbeat at this tick if nothing else; shape (room,)."""
        self._heartbeats = False
        """Whether any is."""
        self._able = np.zeros(room, dtype=np.bool_)
        """Scratch: whether each of some vehicles is decided on; shape (room,)."""
        self._all, self._none = np.arange(block), np.arange(0)
        """Indices of all vehicles of a block, and of none."""
        self.change_trigger(control)
        self._stopwatch = stopwatch
        self.last_step = np.full(room, -1, dtype=np.int64)
        """Step of each vehicle that was decided last, or -1; shape (room,)."""
        self.observed_step = self.scheme.observed_step
        """Step of the newest observation of each vehicle, or -1; shape (room,)."""
        self.idle = np.zeros(room, dtype=np.int64)
        """Why there was no plan for each vehicle, or none sent, one of `Idle`; shape (room,)."""
        self._takes = np.ones(room, dtype=np.bool_)
        """Whether each vehicle flies horizons, as it said last; shape (room,)."""
        self._counts: Counter[str] = Counter()
        shared = control.shared_bytes_per_s
        self.budget = SharedBudget(shared, clock, room) if shared else None
        """Bytes that all vehicles share, where there is a bound."""

    @property
    def counts(self) -> Counter[str]:
        """Events that were counted, by name."""
        return Counter({**self._counts, **self.scheme.counts})

    def change_trigger(self, control: ControlConfig) -> None:
        """Ask another trigger from the next step on; it knows of nothing that was sent before."""
        terms = self._terms
        self._trigger = make_trigger(control, self._room, self.faults.append)
        doubts = DOUBTS if self._trigger.doubts else 0
        self._found = found = foresight(
            self._block,
            terms.axes,
            terms.planned,
            committed_max(terms),
            doubts,
            splines=terms.splines,
        )
        self._known = KnownArrays(
            model=terms.model,
            dt_s=terms.dt_s,
            planned=terms.planned,
            ahead=found.ahead,
            horizons=found.horizons,
            held=found.held if terms.commits else None,
            sent_step=self._sent_step,
            heartbeat_due=self._heartbeat_due,
            desired=self.desired.states,
        )

    def forget(self, row: int) -> None:
        """Begin anew with a vehicle in this row, or with a new life of it."""
        self.last_step[row] = self._sent_step[row] = -1
        self.idle[row] = Idle.PLANS
        self._takes[row] = True
        self.scheme.forget(row)
        self._trigger.forget(row)
        if self.budget:
            self.budget.forget(row)

    def observe(self, row: int, observation: Observation) -> bool:
        """Keep an observation, unless a newer one is known (E11); whether it was kept."""
        kept = self.scheme.observe(row, observation)
        if kept:
            self._takes[row] = bool(observation.takes)
        return kept

    def note_heartbeats(self, rows: list[int]) -> None:
        """Note the vehicles that are sent a heartbeat at this tick if nothing else."""
        if rows or self._heartbeats:
            self._heartbeat_due[:] = False
            self._heartbeat_due[rows] = True
            self._heartbeats = bool(rows)

    def able(self, rows: Indices, step: Indices) -> tuple[Indices, Indices]:
        """Vehicles to decide on, and their steps: the step is new, and `idle` has no reason."""
        n, able = len(rows), self._able
        if n == _able(
            rows,
            step,
            self.last_step,
            self.observed_step,
            self._age_max,
            self._clock.seen,
            self._uplink_max_ns,
            self.idle,
            able,
        ):
            return rows, step
        return rows[able[:n]], step[able[:n]]

    def decide(self, rows: Indices, step: Indices) -> Decisions:
        """Plan for vehicles that are able, and decide which are sent their horizon.

        Args:
            rows: the vehicles, no more than BLOCK; shape (n,).
            step: k of each; shape (n,).

        Source: algorithms 1, 2.
        """
        n, found, stopwatch = len(rows), self._found, self._stopwatch
        self.scheme.foresee(rows, step, found)  # eq. (13)
        stopwatch.lap("estimate")
        self.scheme.plan(rows, step, found)  # eq. (14), (15)
        figures, planned = self.scheme.figures[:n], self.scheme.planned[:n]
        situation = Situation(rows, figures, found.start[:n], planned, self._known)
        verdict = self._trigger.test(situation)  # eq. (16)
        # A vehicle flies no horizon that was planned before it said that it would.
        event = verdict.event.copy()
        unsolved, events = _withhold(
            rows,
            step,
            found.ahead,
            self.observed_step,
            self._age_max,
            figures,
            self._takes,
            self.last_step,
            self.idle,
            event,
        )
        if self.budget:
            # A trigger that compares nothing, as `periodic`, gives no figure to rank its vehicles
            # by.
            worth = verdict.figure if verdict.compares else figures["cost_gap"]
            # A vehicle without a plan to fly on with cannot wait for bytes.
            urgent = self._heartbeat_due[rows] | figures["fresh"] | (self._sent_step[rows] < 0)
            event = self.budget.choose(rows, event, urgent, worth, situation.since_sent_s)
            events = int(np.count_nonzero(event))
        # After the budget: the committed scheme may replay only what is really sent.
        self.scheme.remember(rows, step, found, event)  # eq. (12)
        _note_sent(rows, step, event, self._sent_step)
        if events == n:  # of one vehicle: all or none
            sent = self._all[:n]
            self._trigger.sent(rows, figures)
        elif events:
            sent = event.nonzero()[0]
            self._trigger.sent(rows[sent], figures[sent])
        else:
            sent = self._none
        counts = self._counts
        counts["steps"] += n
        counts["events"] += events
        counts["unsolved"] += unsolved
        stopwatch.lap("trigger")
        batch = Batch(rows, step, found, sent)
        return Decisions(batch, figures, planned, verdict, event, self.scheme.solve_ns)


@kernel
def _able(
    rows: I1,
    steps: I1,
    last_step: I1,
    observed_step: I1,
    age_max: int,
    seen: Seen,
    uplink_max: int,
    idle: I1,
    able: B1,
) -> int:
    """Fill in `able`, and `idle` of vehicles whose step is new; returns how many are able."""
    count = 0
    for i in range(len(rows)):
        row, step = rows[i], steps[i]
        able[i] = False
        if step <= last_step[row] or observed_step[row] < 0:
            continue
        idle[row] = PLANS
        if step - observed_step[row] > age_max:
            idle[row] = OBSERVATION
        elif shortest_ns(seen, row) > uplink_max:
            # Such a horizon would be over, or refused as too late, before it could be flown.
            idle[row] = DELAY
        able[i] = idle[row] == PLANS
        count += able[i]
    return count


@kernel
def _withhold(
    rows: I1,
    steps: I1,
    ahead: I1,
    observed_step: I1,
    age_max: int,
    figures: Figures,
    takes: B1,
    last_step: I1,
    idle: I1,
    event: B1,
) -> tuple[int, int]:
    """Take back events whose plan is none, with the reason in `idle`; note that k is decided.

    A plan that would begin when its observation has become too old is not flown. Neither is one
    that was made before its vehicle said that it would fly it.

    Returns:
        number of vehicles whose plan is unsolved, and of events that are left.
    """
    unsolved, events = 0, 0
    for i in range(len(rows)):
        row = rows[i]
        last_step[row] = steps[i]
        event[i] = event[i] and takes[row]
        if not figures[i].solved:
            unsolved += 1
            idle[row] = UNSOLVED
            event[i] = False
        elif steps[i] + ahead[i] - observed_step[row] > age_max:
            idle[row] = OBSERVATION
            event[i] = False
        events += event[i]
    return unsolved, events


@kernel
def _note_sent(rows: I1, steps: I1, event: B1, sent_step: I1) -> None:
    """Note the step at which vehicles are sent a horizon."""
    for i in range(len(rows)):
        if event[i]:
            sent_step[rows[i]] = steps[i]
