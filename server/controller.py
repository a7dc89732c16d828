"""Algorithm of the server: everything that it computes at a step for n vehicles; no networking.

    observations → x̂(k), x̂(k+d) (`schemes`) → X_p(k+d), U(k+d), V, cost gap, deviation
    (`mpc.hierarchical`) → event? (`trigger`) → plans are sent and remembered.

The schemes "predictive" and "none" have d = 0. With "trajectory", `schemes.trajectory` plans the
spline that the vehicle follows; on a mission, `missions.mission_planner` plans motions. The server
plans for every vehicle at every step, because planning takes a small part of a step's time.
"""

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from skytether.server.planning.clock import ClockMap, Seen, shortest_ns
from skytether.server.planning.desired import Desired
from skytether.server.planning.scheme import (
    Batch,
    Figures,
    Fleet,
    Planning,
)
from skytether.server.schemes import table
from skytether.server.triggers.trigger import (
    Situation,
    SituationArrays,
    Trigger,
    Verdict,
    make_trigger,
)
from skytether.shared.base.kernel import B1, I1, kernel
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.schema import ControlConfig, Scenario
from skytether.shared.wire.protocol import Idle, Observation, RoomMessage

if TYPE_CHECKING:
    from skytether.server.budget import SharedBudget

PLANS, OBSERVATION, DELAY, UNSOLVED, OTHER_SERVER = map(int, Idle)
BLOCK = 128
"""Number of vehicles planned for together. Their data fit into the cache, and each array is below
128 KiB; for a larger array the C library requests new memory from the kernel at each allocation."""


class Decisions(msgspec.Struct, frozen=True):
    """Plans and decisions for n vehicles at a step; valid until the next decisions are made."""

    batch: Batch
    """The vehicles, their predictions, and the indices of the vehicles to which a plan is sent."""
    figures: Figures
    planned: Array
    """Planned state x_p(k+d|k-1) [m, m/s]; shape (n, axes, 2)."""
    verdict: Verdict
    event: Flags
    """Whether a plan is sent to each vehicle; shape (n,)."""
    solve_ns: int
    """Time of planning for all n vehicles [ns], or -1 if not measured."""


class Controller:
    """The paper's algorithms on the server, for up to `capacity` vehicles."""

    def __init__(
        self,
        scenario: Scenario,
        terms: Terms,
        capacity: int,
        clock: ClockMap,
        stopwatch: Stopwatch,
        references: Callable[[int], Reference] | None = None,
        planning: Planning | None = None,
    ) -> None:
        control = scenario.control
        # Arrays of a block are allocated once and reused for each block of a tick.
        block = min(capacity, BLOCK)
        self._age_max = terms.age_max
        self._clock = clock
        self.desired = Desired(scenario, terms, capacity, block, references)
        self.faults: list[str] = []
        """Traceback of the first error of each plug-in, until it is reported."""
        fleet = Fleet(
            scenario,
            terms,
            capacity,
            block,
            clock,
            self.desired,
            references,
            stopwatch,
            self._note_plugin_error,
            planning,
        )
        self.scheme = table.make(fleet)
        self.columns = control.properties.figures
        """Names of the recorded figures of plans."""
        self._computes = control.properties.computes
        self._terms, self._capacity = terms, capacity
        self._sent_step = np.full(capacity, -1, dtype=np.int64)
        """Step of the newest horizon sent to each vehicle, or -1; shape (capacity,)."""
        self._heartbeat_due: Flags = np.zeros(capacity, dtype=np.bool_)
        """Whether a heartbeat to each vehicle is due at this tick; shape (capacity,)."""
        self._heartbeats = False
        self._able = np.zeros(capacity, dtype=np.bool_)
        """Scratch array of `able`: whether to plan for a vehicle; shape (capacity,)."""
        self._all, self._none = np.arange(block), np.arange(0)
        self.change_trigger(control)
        self._stopwatch = stopwatch
        self.last_step = np.full(capacity, -1, dtype=np.int64)
        """Latest step of each vehicle for which a decision was made, or -1; shape (capacity,)."""
        self.observed_step = self.scheme.observed_step
        """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
        self.idle = np.zeros(capacity, dtype=np.int64)
        """Reason why each vehicle gets no plan, as a value of `Idle`; shape (capacity,)."""
        self._is_own = np.ones(capacity, dtype=np.bool_)
        """Whether this server plans for each vehicle; shape (capacity,)."""
        self._plans_due: dict[int, int] = {}
        """Number of plans still to be sent to a vehicle whatever the trigger says, by row."""
        self._takes = np.ones(capacity, dtype=np.bool_)
        """Whether each vehicle accepts horizons, by its newest observation; shape (capacity,)."""
        self._counts: Counter[str] = Counter()
        shared = control.shared_bytes_per_s
        self._budget: SharedBudget | None = None
        self.charge: Callable[..., None] | None = None
        """`SharedBudget.charge`, called with the row and the datagrams of each packet; None unless
        all vehicles share a rate."""
        if shared:
            module = load("skytether.server.budget", "control.shared_bytes_per_s")
            self._budget = module.SharedBudget(shared, capacity)
            self.charge = self._budget.charge

    @property
    def counts(self) -> Counter[str]:
        return Counter({**self._counts, **self.scheme.counts})

    def change_trigger(self, control: ControlConfig) -> None:
        """Use the trigger of a scenario from the next step on, see `use_trigger`."""
        self.use_trigger(make_trigger(control, self._capacity, self._note_plugin_error))

    def _note_plugin_error(self, count: str, fault: str) -> None:
        self._counts[count] += 1
        self.faults += filter(None, [fault])

    def use_trigger(self, trigger: Trigger) -> None:
        """Use another trigger from the next step on. The new trigger knows no earlier plans."""
        terms, self._trigger = self._terms, trigger
        self.doubts = trigger.doubts
        """Whether the trigger needs the costs for the cases that horizons in flight are lost."""
        self._foresight = self.scheme.make_foresight(doubts=trigger.doubts)
        self._trigger_inputs = SituationArrays(
            model=terms.model,
            dt_s=terms.dt_s,
            planned=terms.planned,
            foresight=self._foresight,
            computes=self._computes,
            sent_step=self._sent_step,
            heartbeat_due=self._heartbeat_due,
            desired=self.desired.states,
        )

    def forget(self, row: int) -> None:
        self.last_step[row] = self._sent_step[row] = -1
        self.idle[row] = Idle.PLANS
        self._takes[row] = True
        self.scheme.forget(row)
        self._trigger.forget(row)
        self._plans_due.pop(row, None)
        if self._budget:
            self._budget.forget(row)

    def begin(self, row: int, vehicle: int) -> None:
        """Assign a new vehicle to a free row."""
        self.desired.assign(row, vehicle)

    def restart(self, row: int) -> bool:
        """Note that the client of a vehicle has restarted without its state; see `Scheme`."""
        return self.scheme.restart(row)

    def assign(
        self, row: int, message: RoomMessage | None, *, is_own: bool = True, plans_due: int = 0
    ) -> None:
        """Note whether this server plans for a vehicle. If so, the server sends a plan at once,
        even an unchanged plan. See `assignment.Decider`.
        """
        self._is_own[row] = is_own
        if is_own:
            self._sent_step[row] = -1
            self._trigger.forget(row)
        if plans_due:
            self._plans_due[row] = plans_due
        else:
            self._plans_due.pop(row, None)
        self.scheme.follow(row, message)

    def figures(self) -> dict[str, Any]:
        """Figures of all vehicles together, in addition to the server's own."""
        figures = self.scheme.fleet_figures()
        return figures | {"budget": self._budget.figures()} if self._budget else figures

    def observe(self, row: int, observation: Observation) -> bool:
        """Store an observation unless a newer one is stored (E11); True if stored."""
        is_stored = self.scheme.observe(row, observation)
        if is_stored:
            self._takes[row] = bool(observation.takes)
        return is_stored

    def begin_tick(self, tick_ns: int, now_ns: int, due: list[int]) -> None:
        """Begin the tick of the time `tick_ns`. `due` has the rows of the vehicles that get a
        heartbeat at this tick unless they get a plan.
        """
        self.desired.tick(tick_ns)
        if self._budget:
            self._budget.fill(now_ns)
        if due or self._heartbeats:
            self._heartbeat_due[:] = False
            self._heartbeat_due[due] = True
            self._heartbeats = bool(due)

    def able(self, rows: Indices, step: Indices) -> tuple[Indices, Indices]:
        """Vehicles to plan for, and their steps: those with a new step and no reason in `idle`."""
        n, able = len(rows), self._able
        if n == _able(
            rows,
            step,
            self.last_step,
            self.observed_step,
            self._age_max,
            self._clock.seen,
            self.scheme.uplink_max_ns,
            self._is_own,
            self.idle,
            able,
        ):
            return rows, step
        return rows[able[:n]], step[able[:n]]

    def decide(self, rows: Indices, step: Indices) -> Decisions:
        """Plan for at most BLOCK vehicles from `able`, and decide to which a horizon is sent.

        Source: algorithms 1, 2.
        """
        n, predicted, stopwatch = len(rows), self._foresight, self._stopwatch
        self.scheme.foresee(rows, step, predicted)  # eq. (13)
        stopwatch.lap("estimate")
        self.scheme.plan(rows, step, predicted)  # eq. (14), (15)
        figures, planned = self.scheme.figures[:n], self.scheme.planned[:n]
        situation = Situation(rows, figures, predicted.start[:n], planned, self._trigger_inputs)
        verdict = self._trigger.test(situation)  # eq. (16)
        event = verdict.event.copy()
        if self._plans_due:
            event |= np.isin(rows, list(self._plans_due))
        unsolved, events = _withhold(
            rows,
            step,
            predicted.ahead,
            self.observed_step,
            self._age_max,
            figures,
            self._takes,
            self.last_step,
            self.idle,
            event,
        )
        if self._budget:
            # A trigger without a threshold, such as `periodic`, has no figure to rank vehicles by.
            compared = verdict.figure if verdict.compares else figures["cost_gap"]
            # A vehicle without a plan must not wait for the budget.
            urgent = self._heartbeat_due[rows] | figures["fresh"] | (self._sent_step[rows] < 0)
            event = self._budget.choose(rows, event, urgent, compared, situation.since_sent_s)
            events = int(np.count_nonzero(event))
        # After the budget's choice: the scheme "committed" must replay only horizons that are sent.
        self.scheme.remember(rows, step, predicted, event)  # eq. (12)
        _note_sent(rows, step, event, self._sent_step)
        if events == n:  # plans go to all vehicles: no selection, which would copy arrays
            sent = self._all[:n]
            self._trigger.sent(rows, figures)
        elif events:
            sent = event.nonzero()[0]
            self._trigger.sent(rows[sent], figures[sent])
        else:
            sent = self._none
        if self._plans_due:
            self._pay(rows[sent])
        counts = self._counts
        counts["steps"] += n
        counts["events"] += events
        counts["unsolved"] += unsolved
        stopwatch.lap("trigger")
        batch = Batch(rows, step, predicted, sent)
        return Decisions(batch, figures, planned, verdict, event, self.scheme.solve_ns)

    def _pay(self, sent: Indices) -> None:
        for row in self._plans_due.keys() & set(sent.tolist()):
            self._plans_due[row] -= 1
            if not self._plans_due[row]:
                del self._plans_due[row]


@kernel
def _able(
    rows: I1,
    steps: I1,
    last_step: I1,
    observed_step: I1,
    age_max: int,
    seen: Seen,
    uplink_max: int,
    is_own: B1,
    idle: I1,
    able: B1,
) -> int:
    """Fill in `able`, and `idle` of vehicles with a new step; returns how many are able."""
    count = 0
    for i in range(len(rows)):
        row, step = rows[i], steps[i]
        able[i] = False
        if step <= last_step[row] or observed_step[row] < 0:
            continue
        idle[row] = PLANS
        if not is_own[row]:
            idle[row] = OTHER_SERVER
        elif step - observed_step[row] > age_max:
            idle[row] = OBSERVATION
        elif shortest_ns(seen, row) > uplink_max:
            # A horizon would end before it arrives, or the vehicle would refuse it as too late.
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
    """Cancel events whose plan cannot be used, and set `last_step` to the present step.

    An event is cancelled if its plan has no solution, if the plan's observation would be too old at
    the plan's start, or if the vehicle does not accept horizons. `idle` gets the first two reasons.

    Returns:
        number of vehicles without a solution, and of remaining events.
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
    for i in range(len(rows)):
        if event[i]:
            sent_step[rows[i]] = steps[i]
