"""Tracker of the plans sent to vehicles: in force, in flight, or lost.

Plans (horizons or trajectories) are numbered from 0 in the order of sending; the newest are stored
in a ring. An observation identifies the plan in force by the step that it was made for. A later
plan is in flight until it is due, d steps after the step it was made for (`schemes.delay_bound`).
If it is not in force by then, it is lost.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.planning.clock import Seen, half_trip_ns, shortest_ns
from skytether.server.schemes import delay_bound as delay
from skytether.server.schemes.delay_bound import (
    DelayBound,
    add_sample,
    delay_bound,
    raise_to,
    set_first,
)
from skytether.shared.base.kernel import I1, part, record, records
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.wire.protocol import NO_HORIZON

HOVERS, UNKNOWN = -1, -2
"""Values in place of a plan's number. HOVERS: no plan is in force; the vehicle brakes and hovers.
UNKNOWN: the plan is not stored; it was sent before a restart of the server or dropped aboard."""
MARGIN = 2
"""Steps added to half a round trip for the first delay bound, before any acknowledgement."""
FIRST_LOSS, LOSS_WEIGHT = 0.1, 0.05
"""Loss rate assumed initially, and weight of each new plan in the rate's exponential average."""


class Delivery:
    """Numpy record: delivery of the plans sent to a vehicle, as its observations report it."""

    in_force: int
    """Step that the plan in force at the newest observation was made for, or NO_HORIZON."""
    since: int
    """First step flown with the plan in force."""
    acknowledged: int
    """Step that the newest plan with a delay sample was made for, or NO_HORIZON."""
    judged: int
    """Step up to which every due plan has been counted as arrived or as lost."""
    sent: int
    """Number of plans sent so far."""
    first: int
    """Number of the first plan that the vehicle may still have; all earlier plans are dropped."""
    loss: float
    """Loss rate of recent plans, from 0 to 1."""


class SentPlan:
    step: int
    due: int
    """Step at which the plan is either in force or lost."""


DELIVERY, SENT_PLAN = record(Delivery), record(SentPlan)


class Sent(NamedTuple):
    """Plans sent to each vehicle, and their delivery."""

    observed: I1
    """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
    delivery: Annotated[NDArray[np.void], records(DELIVERY, 1)]
    plans: Annotated[NDArray[np.void], records(SENT_PLAN, 2)]
    """Newest plans, in a ring: plan n has index n modulo `ring`; shape (capacity, ring)."""
    bound: DelayBound
    dt_ns: int


def nothing_sent(capacity: int, ring: int, terms: Terms, control: ControlConfig, most: int) -> Sent:
    """Tracker before any plan is sent; `most`: largest value of the delay bound d [steps]."""
    fixed_s = None if control.delay_bound == "auto" else control.delay_bound
    sent = Sent(
        observed=np.full(capacity, -1, dtype=np.int64),
        delivery=np.zeros(capacity, dtype=DELIVERY),
        plans=np.zeros((capacity, ring), dtype=SENT_PLAN),
        bound=delay_bound(capacity, terms.dt_s, most, fixed_s),
        dt_ns=terms.dt_ns,
    )
    for row in range(capacity):
        forget(sent, row)
    return sent


def forget(sent: Sent, row: int) -> None:
    sent.observed[row] = -1
    sent.delivery[row] = (NO_HORIZON, 0, NO_HORIZON, -1, 0, 0, FIRST_LOSS)
    delay.forget(sent.bound, row)


@part
def update_delay_and_loss(sent: Sent, clock: Seen, row: int) -> int:
    """Update delay bound and loss rate from the newest observation; returns the number of plans
    lost.
    """
    delivery, bound, observed = sent.delivery[row], sent.bound, sent.observed[row]
    # Before the first sample the bound is half a round trip, rounded up, plus a margin.
    if bound.steps[row] == 0:
        set_first(bound, row, -(-half_trip_ns(clock, row) // sent.dt_ns) + MARGIN)
    raise_to(bound, row, -(-shortest_ns(clock, row) // sent.dt_ns))
    # A plan that was made after the plan in force and is due by now is lost. Lost plans stay in the
    # ring, and `judged` prevents counting them twice.
    lost = 0
    for number in range(first_after(sent, row, delivery.in_force), delivery.sent):
        if delivery.judged < sent.plans[row, number % sent.plans.shape[1]].due <= observed:
            lost += 1
            delivery.loss += LOSS_WEIGHT * (1.0 - delivery.loss)
    delivery.judged = observed
    if delivery.in_force != delivery.acknowledged and number_of(sent, row, delivery.in_force) >= 0:
        delivery.loss -= LOSS_WEIGHT * delivery.loss
        add_sample(bound, row, delivery.since - delivery.in_force)
        delivery.acknowledged = delivery.in_force
    return lost


@part
def add_plan(sent: Sent, row: int, step: int, d: int) -> int:
    """Store a sent plan, made for a step and due d steps later; return its index in the ring."""
    delivery = sent.delivery[row]
    slot = delivery.sent % sent.plans.shape[1]
    delivery.sent += 1
    plan = sent.plans[row, slot]
    plan.step, plan.due = step, step + d
    return slot


@part
def oldest(sent: Sent, row: int) -> int:
    """Number of the oldest plan that is stored and that the vehicle may still have."""
    return max(sent.delivery[row].first, sent.delivery[row].sent - sent.plans.shape[1])


@part
def number_of(sent: Sent, row: int, made_for: int) -> int:
    """Number of the plan made for a step; HOVERS if the step is negative, UNKNOWN if not stored."""
    if made_for < 0:
        return HOVERS
    # Search from the newest plan backwards: the plan in force is usually one of the last few.
    number = first_after(sent, row, made_for) - 1
    if number < oldest(sent, row):
        return UNKNOWN
    return number if sent.plans[row, number % sent.plans.shape[1]].step == made_for else UNKNOWN


@part
def first_after(sent: Sent, row: int, step: int) -> int:
    ring, least, number = sent.plans.shape[1], oldest(sent, row), sent.delivery[row].sent
    while number > least and sent.plans[row, (number - 1) % ring].step > step:
        number -= 1
    return number


@part
def first_in_flight(sent: Sent, row: int, in_force: int, observed: int) -> int:
    """Number of the first plan after the plan in force that is not yet due at an observation."""
    ring, least, number = sent.plans.shape[1], oldest(sent, row), sent.delivery[row].sent
    while number > least:
        plan = sent.plans[row, (number - 1) % ring]
        if plan.step <= in_force or plan.due <= observed:
            break
        number -= 1
    return number
