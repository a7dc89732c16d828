"""Plausibility: observations are accepted if a vehicle can make them, or if they repeat."""

from itertools import count
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skytether.sim.flight
from helpers import packaged
from skytether.client.session import ServerSession
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.server.plausibility import REPEATS, Belief, Plausibility
from skytether.shared.base.units import MILLISECOND_NS as MS
from skytether.shared.base.units import SECOND_NS as S
from skytether.shared.events.flight import ModeChanged, StateDoubted
from skytether.shared.law.heartbeat import NUMBERS
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Reason, Record
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire.drop import Drop
from skytether.shared.wire.protocol import Mode, Observation, stamp_us, stamped_ns
from skytether.sim.flight import fly
from skytether.sim.hosts import Clock

quick = settings(max_examples=30)

TERMS = reading.load("demo-committed").terms()
DT_NS, H = TERMS.dt_ns, TERMS.horizon
HOUR = 3600 * S
DELAY_NS = 440 * MS
BEGAN_NS = 3 * HOUR
BACKWARD_NS = DELAY_NS - BEGAN_NS
"""Field G of a packet that reaches the vehicle after its delay."""


def seen(step: int, changed: dict[str, Any] | None = None) -> Observation:
    """Observation of a vehicle on a circle of 2 m at 0.5 m/s, with some fields changed."""
    angle, pace = 0.25 * step * TERMS.dt_s, 0.5
    x = 2.0 * np.array([[np.cos(angle), 0.0], [np.sin(angle), 0.0]])
    x[:, 1] = -pace * np.sin(angle), pace * np.cos(angle)
    observation = Observation(
        1,
        1,
        step,
        in_force=step - 12,
        since=step - 2,
        backward_us=stamp_us(BACKWARD_NS),
        heard=step % NUMBERS,
        mode=Mode.TRACK,
        takes=1,
        state=x,
        input=np.zeros(2),
    )
    return observation._replace(**changed or {})


def judge(plausibility: Plausibility, told: Observation, *, row: int = 0, step: int = -1) -> Belief:
    now_ns = BEGAN_NS + (told.step if step < 0 else step) * DT_NS + DELAY_NS
    forward_ns = now_ns - told.step * DT_NS
    backward_ns = stamped_ns(told.backward_us, near_ns=-forward_ns)
    return plausibility.judge(row, told, forward_ns, backward_ns)


def after(count: int = 5) -> Plausibility:
    plausibility = Plausibility(TERMS, 2)
    for step in range(100, 100 + count):
        assert judge(plausibility, seen(step)) == Belief.BELIEVED
    return plausibility


def moved(metres: float, speed: float = 0.0) -> np.ndarray:
    return seen(105).state + np.array([[metres, speed], [0.0, 0.0]])


def test_a_predicted_position_may_be_off_by_what_the_velocity_may_over_the_dead_time() -> None:
    """If the model has no dead time, the same position counts as a jump."""
    for dead_time_s, verdict in ((0.0, Belief.JUMP), (0.5, Belief.BELIEVED)):
        terms = TERMS._replace(dead_time_s=(0.0, dead_time_s))
        plausibility = Plausibility(terms, 2)
        for step in range(100, 105):
            judge(plausibility, seen(step))
        assert judge(plausibility, seen(105, {"state": moved(1.8)})) == verdict


ODD: dict[str, tuple[dict[str, Any], Belief]] = {
    "step 2^31": ({"step": 2**31}, Belief.CLOCK),
    "a step from a second and more ahead": ({"step": 124}, Belief.CLOCK),
    "an echo from half an hour ahead": (
        {"backward_us": stamp_us(BACKWARD_NS - HOUR // 2)},
        Belief.CLOCK,
    ),
    "an echo that came before it was sent": (
        {"backward_us": stamp_us(-BEGAN_NS - S)},
        Belief.CLOCK,
    ),
    "a round trip of its own below zero": (
        {"step": 115, "backward_us": stamp_us(BACKWARD_NS - S // 2)},
        Belief.CLOCK,
    ),
    "a horizon from far ahead": ({"in_force": 105 + H + 1}, Belief.HORIZON),
    "a horizon of before": ({"in_force": 91}, Belief.HORIZON),
    "in force since a later step": ({"since": 106}, Belief.HORIZON),
    "in force since long ago": ({"since": 101}, Belief.HORIZON),
    "a jump": ({"state": moved(2.0)}, Belief.JUMP),
    "a jump in speed": ({"state": moved(0.0, 5.0)}, Belief.JUMP),
    "the end of the world": ({"state": moved(1e300, 1e300)}, Belief.JUMP),
}
"""Odd observations at step 105, and the verdict on each."""


@pytest.mark.parametrize(("changed", "verdict"), ODD.values(), ids=ODD)
def test_an_odd_observation_is_not_believed_and_changes_nothing(
    changed: dict[str, Any], verdict: Belief
) -> None:
    for times in (1, 2):
        plausibility = after()
        for _ in range(times):
            assert judge(plausibility, seen(105, changed), step=105) == verdict
        assert judge(plausibility, seen(106)) == Belief.BELIEVED


@pytest.mark.parametrize("row", [0, 1])
def test_a_vehicle_is_known_by_its_own_observations(row: int) -> None:
    expected = Belief.JUMP if row == 0 else Belief.BELIEVED
    assert judge(after(), elsewhere(105), row=row) == expected


def elsewhere(step: int, metres: float = 100.0) -> Observation:
    observation = seen(step)
    return observation._replace(state=observation.state + np.array([[metres, 0.0], [0.0, 0.0]]))


B, J = Belief.BELIEVED, Belief.JUMP
HEARD: dict[str, list[tuple[Observation, Belief]]] = {
    "three that agree begin anew": [
        *((elsewhere(step), J) for step in range(105, 104 + REPEATS)),
        (elsewhere(104 + REPEATS), Belief.ANEW),
        (elsewhere(108), B),
        (seen(110), J),
    ],
    "any number that do not agree": [
        *((elsewhere(105 + n, 100.0 * (n + 1)), J) for n in range(20)),
        (seen(125), B),
    ],
    "two among believed ones are not in a row": [
        each
        for step in range(105, 205, 3)
        for each in ((elsewhere(step), J), (elsewhere(step + 1), J), (seen(step + 2), B))
    ],
    "one that follows from neither begins the row anew": [
        *((elsewhere(step), J) for step in (105, 106)),
        (elsewhere(107, -100.0), J),
        *((elsewhere(step), J) for step in (108, 109)),
        (elsewhere(110), Belief.ANEW),
    ],
    "a late one tells of the clocks alone": [
        (seen(90), B),
        (seen(105), B),
        (seen(90, {"backward_us": stamp_us(BACKWARD_NS - S)}), Belief.CLOCK),
        (seen(104, {"in_force": -1, "state": moved(50.0)}), B),
        (seen(106), B),
    ],
}
"""Observations after those up to step 104, and the verdict on each."""


@pytest.mark.parametrize("heard", HEARD.values(), ids=HEARD)
def test_a_row_of_observations_is_judged_by_those_before(
    heard: list[tuple[Observation, Belief]],
) -> None:
    plausibility = after()
    assert [judge(plausibility, observation) for observation, _ in heard] == [
        verdict for _, verdict in heard
    ]


def test_a_forgotten_vehicle_is_believed_whatever_it_says_first() -> None:
    plausibility = after()
    assert judge(plausibility, seen(100), row=1) == Belief.BELIEVED
    plausibility.forget(0)
    assert judge(plausibility, elsewhere(3)) == Belief.BELIEVED
    assert judge(plausibility, elsewhere(101), row=1) == Belief.JUMP


def test_an_odd_first_observation_is_forgotten_after_three() -> None:
    plausibility = Plausibility(TERMS, 1)
    assert judge(plausibility, elsewhere(100)) == Belief.BELIEVED
    verdicts = [judge(plausibility, seen(step)) for step in range(101, 105)]
    assert verdicts == [Belief.JUMP, Belief.JUMP, Belief.ANEW, Belief.BELIEVED]


@quick
@given(
    st.integers(0, 2**32 - 1),
    st.integers(-300, 300),
    st.integers(0, 3000),
    st.lists(st.integers(1, 60), max_size=30),
)
def test_whatever_a_vehicle_may_say_is_believed(
    seed: int, drift_ppm: int, jitter_ms: int, gaps: list[int]
) -> None:
    rng, plausibility, step = np.random.default_rng(seed), Plausibility(TERMS, 1), 100
    for gap in gaps:
        step += gap
        observation = seen(step)
        observation = observation._replace(
            state=observation.state + rng.normal(scale=0.1, size=(2, 2))
        )
        up_ns, down_ns = (int(rng.integers(jitter_ms * MS + 1)) for _ in range(2))
        # The server's clock drifts against the vehicle's.
        drift_ns = (step - 100) * DT_NS * drift_ppm // 1_000_000
        forward_ns = BEGAN_NS + drift_ns + down_ns
        backward_us = stamp_us(up_ns - BEGAN_NS - drift_ns)
        backward_ns = stamped_ns(backward_us, near_ns=-forward_ns)
        assert plausibility.judge(0, observation, forward_ns, backward_ns) == Belief.BELIEVED


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("backward_us", [0, 2**31, 2**32 - 1])
def test_the_largest_step_on_the_wire_overflows_nothing(backward_us: int, *, first: bool) -> None:
    """As the first of its session it is believed, because nothing contradicts it."""
    plausibility = Plausibility(TERMS, 1) if first else after()
    last = seen(105)._replace(step=2**32 - 1, in_force=-1, since=0, backward_us=backward_us)
    verdict = judge(plausibility, last, step=105)
    assert verdict == Belief.CLOCK or (first and verdict == Belief.BELIEVED)


@pytest.mark.parametrize(
    ("steps", "metres", "speed"), [(1, 1.06, 4.4), (10, 7.2, 26.9), (40, 100.9, 101.9)]
)
def test_how_far_a_vehicle_may_have_come_grows_with_the_time_since_the_last_one(
    steps: int, metres: float, speed: float
) -> None:
    """Noise, and 50 m/s² for 0.05 s a step: that far is believed, a fifth more is a jump."""
    for p, v in ((metres, 0.0), (0.0, speed)):
        for share, verdict in ((1.0, Belief.BELIEVED), (1.2, Belief.JUMP)):
            plausibility = Plausibility(TERMS, 1)
            still = {"state": np.zeros((2, 2))}
            assert judge(plausibility, seen(100, still)) == Belief.BELIEVED
            # A change of velocity moves the vehicle by the mean velocity.
            gone = share * np.array([p + 0.5 * v * steps * TERMS.dt_s, v])
            observation = seen(100 + steps, {"state": np.array([gone, [0.0, 0.0]])})
            assert judge(plausibility, observation) == verdict


@quick
@given(st.integers(0, 3), st.integers(0, 63))
def test_a_flipped_bit_of_a_state_is_a_jump_or_as_good_as_none(number: int, bit: int) -> None:
    observation = seen(105)
    state = observation.state.copy()
    state.view(np.uint64).ravel()[number] ^= np.uint64(1 << bit)
    if (
        np.isfinite(state).all()
        and judge(after(), observation._replace(state=state)) == Belief.BELIEVED
    ):
        assert np.abs(state - observation.state).max() < 5.0
    else:
        assert np.abs(state - observation.state).max() > 0.9 or not np.isfinite(state).all()


# -- in flight -------------------------------------------------------------------------------------


def scenario(**changes: Any) -> Scenario:
    reports = {"vehicle": {"report": "always"}, "link": {"heartbeat_s": 0.1, "timeout_s": 1.0}}
    return packaged("demo-committed", reports, changes)


LOSSLESS = {"uplink": {"loss": 0.0}, "downlink": {"loss": 0.0}}


def believe(*_: Any) -> Belief:
    """Ablation: a check that accepts every observation."""
    return Belief.BELIEVED


def oddly(
    monkeypatch: pytest.MonkeyPatch, number: int, field: str, value: int, *, feedback: bool = True
) -> Record:
    """Flight with a changed field in one observation, by its number from 0."""
    send, said = ServerSession.send, iter(range(10**9))

    def lie(self: ServerSession, message: Any, *, now_ns: int) -> None:
        if isinstance(message, Observation) and next(said) == number:
            message = message._replace(**{field: getattr(message, field) + value})
        send(self, message, now_ns=now_ns)

    monkeypatch.setattr(ServerSession, "send", lie)
    keys = {"control": {"feedback": feedback}, "network": LOSSLESS}
    return fly(scenario(duration=20.0, settle=5.0, **keys))


@pytest.mark.parametrize(
    ("number", "field", "value", "drop"),
    [
        (0, "step", 16, None),
        (300, "step", 2**20, Drop.IMPLAUSIBLE_CLOCK),
        (300, "since", -200, Drop.IMPLAUSIBLE_HORIZON),
    ],
)
def test_one_odd_observation_costs_a_few_steps_at_most(
    number: int, field: str, value: int, drop: Drop | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = oddly(monkeypatch, number, field, value)
    assert flight.failure is None
    assert flight.figures["server"]["dropped"] == ({drop: 1} if drop else {})
    steps = flight.server["step"]
    steps = steps[steps < 2**19]
    assert steps[0] <= 12 + REPEATS + 1
    assert np.diff(steps).max() <= 9  # one within the round trip, of 0.88 s, is believed
    error = summarise(scenario(settle=5.0), "test", flight.client).error_max
    assert error < 0.5


def test_believed_one_odd_observation_leaves_the_vehicle_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ablation: no observation is newer than step 2^20, so no horizon is for the present.

    Without feedback: with it the server would predict 2^20 steps along its plan.
    """
    monkeypatch.setattr(Plausibility, "judge", believe)
    flight = oddly(monkeypatch, 300, "step", 2**20, feedback=False)
    error = summarise(scenario(settle=5.0), "test", flight.client).error_max
    assert flight.failure is not None or (error or 0.0) > 0.5


class Stepped(NamedTuple):
    """Clock that is set by an hour while it runs."""

    clock: Clock
    at_ns: int
    by_ns: int

    def local(self, time_ns: int) -> int:
        return self.clock.local(time_ns) + self.by_ns * (time_ns >= self.at_ns)

    def world(self, local_ns: int) -> int:
        before_ns = self.clock.world(local_ns)
        if before_ns < self.at_ns:
            return before_ns
        return max(self.at_ns, self.clock.world(local_ns - self.by_ns))


@pytest.mark.parametrize("by_ns", [HOUR, -HOUR])
def test_a_server_whose_clock_steps_goes_on_planning(
    by_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By an hour, in flight: the vehicle is without a plan while a session is opened.

    No observation from before the step agrees with those after it.
    """
    ours = iter([False, True])

    def clock(*numbers: int) -> Clock | Stepped:
        made = Clock(*numbers)
        return Stepped(made, 6 * S, by_ns) if next(ours) else made

    monkeypatch.setattr(skytether.sim.flight, "Clock", clock)
    flight = fly(scenario(network=LOSSLESS, duration=30.0))
    assert flight.failure is None
    covered = flight.client["covered"]
    assert covered[-150:].all()
    assert np.linalg.norm(flight.client["state"][:, :, 0], axis=1).max() < 3.0


def test_a_state_that_leaps_is_said_at_both_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """300 m in a step: the vehicle hovers from then on, and the server rejects the state."""
    advance, steps = FirstOrderPlant.advance, count()

    def leaping(self: FirstOrderPlant, command: Array) -> None:
        advance(self, command)
        if next(steps) == 200:
            self.x[:, 0] += 300.0

    monkeypatch.setattr(FirstOrderPlant, "advance", leaping)
    flight = fly(packaged("demo-committed", duration=20.0))
    said = [event for _, _, event in flight.events]
    assert StateDoubted(vehicle=1) in said
    changes = [(each.after, each.reason) for each in said if isinstance(each, ModeChanged)]
    why = str(Reason.LEAPT)
    assert changes[-2:] == [("brake", why), ("hover", why)]
    assert np.abs(flight.client["input"][-1]).max() == 0.0


def test_observations_of_long_ago_do_not_begin_a_vehicle_anew_though_a_clock_drifts() -> None:
    plausibility, later = Plausibility(TERMS, 1), 20_000
    # By then the vehicle's clock is ahead by 100 ppm of 1000 s, and its packets take no time.
    drifted = {"backward_us": stamp_us(BACKWARD_NS + 100 * MS)}
    ahead = (DELAY_NS + 100 * MS) // DT_NS + 1
    for step in range(later, later + 5):
        judge(plausibility, seen(step, drifted), step=step - ahead)
    at_once = {"backward_us": stamp_us(BACKWARD_NS - DELAY_NS)}
    verdicts = {judge(plausibility, seen(step, at_once), step=later) for step in range(100, 105)}
    assert verdicts == {Belief.BELIEVED}
