"""Tracker of what was sent to vehicles: what is in force, in flight, or lost.

Plans (horizons or trajectories) are numbered from 0 in the order of sending, and the newest lie in
a ring. An observation names the plan in force by the step that it was made for; here that becomes
its number again. What was made later is under way until it is due, by the delay bound d
(`schemes.delay_bound`), and lost from then on.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.common.clock import Seen, half_trip_ns, shortest_ns
from skytether.server.schemes import delay_bound as delay
from skytether.server.schemes.delay_bound import (
    DelayBound,
    acknowledge,
    at_least,
    begin,
    delay_bound,
)
from skytether.shared.base.kernel import I1, part, record, records
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.wire.protocol import NO_HORIZON

HOVERS, UNKNOWN = -1, -2
"""Number of a plan where there is none (the vehicle brakes and stands still), and where it was sent
in an earlier life of the server, or dropped aboard."""
MARGIN = 2
"""Steps on top of half a round trip, until a plan has been acknowledged."""
LOSS, LEARNED = 0.1, 0.05
"""Share of lost plans that is assumed at first, and by how much of itself each plan that has come
into force, or is lost, moves it."""


class Heard:
    """Record: what a vehicle has said of the plans that were sent to it."""

    in_force: int
    """Step that the plan in force at its newest observation was made for, or NO_HORIZON."""
    since: int
    """First step flown with it."""
    acknowledged: int
    """Step that the plan last seen to have come into force was made for, or NO_HORIZON."""
    judged: int
    """Step up to which plans were seen in force, lost or overtaken."""
    sent: int
    """Number of plans sent so far."""
    first: int
    """Number of the first that may be held: those before were dropped aboard."""
    loss: float
    """Share of plans that were lost lately."""


class SentPlan:
    """Record: a plan that was sent."""

    step: int
    """Step that it was made for."""
    due: int
    """Step at which it is in force, or lost."""


HEARD, SENT_PLAN = record(Heard), record(SentPlan)


class Sent(NamedTuple):
    """What was sent to each vehicle, and what it has said of that."""

    observed: I1
    """Step of its newest observation, or -1; shape (capacity,)."""
    heard: Annotated[NDArray[np.void], records(HEARD, 1)]
    """Shape (capacity,)."""
    plans: Annotated[NDArray[np.void], records(SENT_PLAN, 2)]
    """Newest plans, a ring: number n has index n modulo `ring`; shape (capacity, ring)."""
    bound: DelayBound
    """Delay bound d."""
    dt_ns: int
    """Length of a step [ns]."""


def nothing_sent(capacity: int, ring: int, terms: Terms, control: ControlConfig, most: int) -> Sent:
    """Tracker of vehicles to which nothing was sent.

    Args:
        capacity: number of vehicles.
        ring: number of plans that are remembered of each.
        terms: the rule of flight.
        control: `delay_bound`.
        most: largest d, what a plan has room for.
    """
    fixed_s = None if control.delay_bound == "auto" else control.delay_bound
    sent = Sent(
        observed=np.full(capacity, -1, dtype=np.int64),
        heard=np.zeros(capacity, dtype=HEARD),
        plans=np.zeros((capacity, ring), dtype=SENT_PLAN),
        bound=delay_bound(capacity, terms.dt_s, most, fixed_s),
        dt_ns=terms.dt_ns,
    )
    for row in range(capacity):
        forget(sent, row)
    return sent


def forget(sent: Sent, row: int) -> None:
    """Begin anew with a vehicle."""
    sent.observed[row] = -1
    sent.heard[row] = (NO_HORIZON, 0, NO_HORIZON, -1, 0, 0, LOSS)
    delay.forget(sent.bound, row)


@part
def judge(sent: Sent, clock: Seen, row: int) -> int:
    """Take what the newest observation of a vehicle says of delays and losses.

    Returns:
        how many plans are newly known to be lost.
    """
    heard, bound, observed = sent.heard[row], sent.bound, sent.observed[row]
    # No sample yet: half a round trip, rounded up, and a margin.
    if bound.steps[row] == 0:
        begin(bound, row, -(-half_trip_ns(clock, row) // sent.dt_ns) + MARGIN)
    at_least(bound, row, -(-shortest_ns(clock, row) // sent.dt_ns))
    # Those that were due and are not in force have been overtaken, or are lost. They stay in the
    # ring, and are counted once.
    lost = 0
    for number in range(first_after(sent, row, heard.in_force), heard.sent):
        if heard.judged < sent.plans[row, number % sent.plans.shape[1]].due <= observed:
            lost += 1
            heard.loss += LEARNED * (1.0 - heard.loss)
    heard.judged = observed
    if heard.in_force != heard.acknowledged and number_of(sent, row, heard.in_force) >= 0:
        heard.loss -= LEARNED * heard.loss
        acknowledge(bound, row, heard.since - heard.in_force)
        heard.acknowledged = heard.in_force
    return lost


@part
def note(sent: Sent, row: int, step: int, d: int) -> int:
    """Take note that the plan made for a step is sent, due d steps later; its index in the ring."""
    heard = sent.heard[row]
    slot = heard.sent % sent.plans.shape[1]
    heard.sent += 1
    plan = sent.plans[row, slot]
    plan.step, plan.due = step, step + d
    return slot


@part
def oldest(sent: Sent, row: int) -> int:
    """Number of the oldest plan that is remembered, and may be held."""
    return max(sent.heard[row].first, sent.heard[row].sent - sent.plans.shape[1])


@part
def number_of(sent: Sent, row: int, made_for: int) -> int:
    """Number of the plan made for a step; HOVERS of none, UNKNOWN of one that is not remembered."""
    if made_for < 0:
        return HOVERS
    # From the newest down: the plan in force is mostly one of the last few.
    number = first_after(sent, row, made_for) - 1
    if number < oldest(sent, row):
        return UNKNOWN
    return number if sent.plans[row, number % sent.plans.shape[1]].step == made_for else UNKNOWN


@part
def first_after(sent: Sent, row: int, step: int) -> int:
    """Number of the first plan made for a later step."""
    ring, least, number = sent.plans.shape[1], oldest(sent, row), sent.heard[row].sent
    while number > least and sent.plans[row, (number - 1) % ring].step > step:
        number -= 1
    return number


@part
def first_under_way(sent: Sent, row: int, in_force: int, observed: int) -> int:
    """Number of the first plan made after the one in force that is not due yet when observed."""
    ring, least, number = sent.plans.shape[1], oldest(sent, row), sent.heard[row].sent
    while number > least:
        plan = sent.plans[row, (number - 1) % ring]
        if plan.step <= in_force or plan.due <= observed:
            break
        number -= 1
    return number
