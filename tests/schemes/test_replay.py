"""Committed scheme: the server knows the vehicle's inputs, and predicts its state with them."""

from typing import Any

import numpy as np
import pytest

from helpers import packaged
from skytether.client.compensator import Compensator
from skytether.server.mpc.hierarchical import Planner
from skytether.server.planning.clock import ClockMap
from skytether.server.planning.scheme import Foresight, empty_foresight
from skytether.server.schemes.committed import Replay
from skytether.server.schemes.feedback import feedback_gain
from skytether.server.schemes.sent import LOSS_WEIGHT
from skytether.shared.law import rule
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import UPLINK, Record
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire.protocol import NO_HORIZON, Horizon, Mode, Observation
from skytether.sim.batch import fly_batch
from skytether.sim.flight import fly

H, BOUND, MOST = 6, 4, 50
ROW = np.array([0])
HORIZON_BYTES = 300
"""Larger than any heartbeat [B]."""


def scenario(name: str = "paper", **changes: Any) -> Scenario:
    return packaged(name, {"control": {"scheme": "committed"}}, changes)


TOLD_M = 2e-7
"""Resolution of float32 for positions of some metres [m]."""


def lossy(loss: float, down: float = 0.1) -> dict[str, Any]:
    return {"uplink": {"loss": loss}, "downlink": {"loss": down}}


# -- artificial observations ---------------------------------------------------------------------


def small(exhausted: str = "brake", age_max_s: float = 5.0, **control: Any) -> Scenario:
    """Six stages of 0.1 s, with a delay of up to four."""
    return scenario(
        model={"tau_s": [0.81, 0.3], "u_max": [1.8, 0.9]},
        control={"dt": 0.1, "horizon": H, "delay_bound": 0.1 * BOUND, **control},
        vehicle={"exhausted": exhausted, "brake_mps2": 2.0},
        network={"uplink": "loss(0.1)", "downlink": "loss(0.1)"},
        link={"age_max_s": age_max_s},
    )


def make(flown: Scenario) -> Replay:
    clock, gain = ClockMap(1, flown.dt_ns), feedback_gain(flown)
    return Replay(flown.terms(), flown.control, gain, 1, clock)


def see(
    replay: Replay,
    step: int,
    state: Array,
    in_force: int,
    since: int = 0,
    flown: Array | None = None,
    takes: int = 1,
) -> bool:
    """Receive an observation; the vehicle flies by the rule unless `flown` is given."""
    u = by_rule(replay, step, in_force) if flown is None else flown
    observed = Mode.TRACK, takes, state, u
    return replay.observe(0, Observation(1, 1, step, in_force, since, 0, 0, *observed))


def by_rule(replay: Replay, step: int, in_force: int) -> Array:
    """Input prescribed at a step by a sent horizon; zero without one, or with an unknown one."""
    memory, brake = replay._memory, replay._settings.brake
    bounds = replay._settings.laws["bound"].tolist()
    plans = memory.sent.plans["step"][0].tolist()
    for slot, made_for in enumerate(plans[: int(memory.sent.delivery["sent"][0])]):
        length, speed = memory.horizons[0, slot].tolist()
        if made_for == in_force:
            stage = step - made_for
            inputs = memory.inputs[0, slot, :, rule.entry(stage, length)].tolist()
            share = rule.remaining(stage, length, speed, brake)
            return np.array(
                [
                    rule.flown(stage, share * rule.bounded(u, bound), 0.0, bound)
                    for u, bound in zip(inputs, bounds, strict=True)
                ]
            )
    return np.zeros(2)


def foresee(replay: Replay, step: int) -> Foresight:
    found = empty_foresight(1, 2, H, MOST)
    replay.foresee(ROW, np.array([step]), found)
    return found


def send(replay: Replay, step: int, inputs: Array, feedback: Array | None = None) -> None:
    """Send a horizon of d + H inputs, from the newest observation [inputs: (axes, d + H)]."""
    if replay.observed_step[0] < 0:
        see(replay, step - 1, np.zeros((2, 2)), NO_HORIZON)
    found, length = empty_foresight(1, 2, H, MOST), inputs.shape[1]
    found.ahead[:], found.horizons[0, :, :length] = length - H, inputs
    if feedback is not None:
        found.feedback[0] = feedback
    replay.remember(ROW, np.array([step]), found, np.array([True]))


def plans(seed: int, *lengths: int) -> list[Array]:
    """Random inputs, some at the bound as rounded to float32, slightly beyond it."""
    rng = np.random.default_rng(seed)
    bound = np.array([1.8, 0.9])[:, None]
    return [(rng.uniform(-1.3, 1.3, (2, n)) * bound).clip(-bound, bound) for n in lengths]


def test_a_horizon_in_flight_is_in_force_when_it_had_its_time() -> None:
    """The previous horizon is flown until then, and the state predicted accordingly."""
    flown = small()
    old, new = plans(1, 2 * H, BOUND + H)
    replay, x = make(flown), np.array([[1.0, 0.2], [-1.0, 0.1]])
    send(replay, 100, old)
    send(replay, 103, new)
    see(replay, 104, x, 100)
    seen = foresee(replay, 106)
    for u in old[:, 4:6].T:  # of steps 104 and 105
        x = flown.terms().model.step(x, np.float64(np.float32(u)))
    np.testing.assert_allclose(seen.estimate[0], x, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(seen.committed[0, :, 0], np.float32(old[:, 6]))
    np.testing.assert_array_equal(seen.committed[0, :, 1], np.float32(new[:, 4]))


@pytest.mark.parametrize("under_way", [0, 2, 3, 6])
def test_each_doubt_is_what_is_flown_without_the_newest_horizons(under_way: int) -> None:
    """Weighted with the probability that exactly these are lost; the last covers all others."""
    loss, given = 0.2, plans(3, *[BOUND + H] * (under_way + 1))

    def foreseen(count: int) -> Foresight:
        """Prediction with a number of horizons under way."""
        replay = make(small())
        send(replay, 100, given[0])
        see(replay, 103, np.array([[1.0, 0.2], [-1.0, 0.1]]), 100)
        for number, inputs in enumerate(given[1 : count + 1]):
            send(replay, 103 + number, inputs)
        replay._memory.sent.delivery["loss"] = loss / (1.0 - LOSS_WEIGHT)  # one has arrived since
        found = empty_foresight(1, 2, H, MOST, loss_cases=3)
        replay.foresee(ROW, np.array([110]), found)
        return found

    found, cases = foreseen(under_way), 3
    expected = [loss ** (j + 1) * (1.0 - loss) for j in range(min(under_way, cases))]
    if expected:
        expected[-1] = loss ** len(expected)
    assert found.loss_probability[0].tolist() == pytest.approx(
        expected + [0.0] * (cases - len(expected))
    )
    for j in range(len(expected)):
        without = foreseen(under_way - j - 1)
        np.testing.assert_array_equal(found.inputs_if_lost[0, j], without.held[0])
        np.testing.assert_array_equal(found.start_if_lost[0, j], without.start[0])


def test_a_horizon_that_had_its_time_and_is_not_in_force_is_lost() -> None:
    """Counted once, and ignored until it arrives after all."""
    old, lost, late = plans(2, 2 * H, BOUND + H, BOUND + H)
    replay = make(small())
    send(replay, 100, old)
    send(replay, 102, lost)
    send(replay, 103, late)
    see(replay, 106, np.zeros((2, 2)), 100)
    seen = foresee(replay, 106)
    np.testing.assert_array_equal(seen.committed[0, :, 0], np.float32(old[:, 6]))
    np.testing.assert_array_equal(seen.committed[0, :, 1], np.float32(late[:, 4]))
    assert replay.counts["horizons_lost"] == 1
    foresee(replay, 107)
    assert replay.counts["horizons_lost"] == 1
    see(replay, 108, np.zeros((2, 2)), 103, 108)
    seen = foresee(replay, 108)
    np.testing.assert_array_equal(seen.committed[0, :, 0], np.float32(late[:, 5]))
    assert replay.counts["horizons_lost"] == 1


def test_a_vehicle_without_a_horizon_hovers() -> None:
    replay = make(small())
    see(replay, 5, np.array([[0.0, 1.0], [0.0, 0.0]]), NO_HORIZON)
    seen = foresee(replay, 40)
    assert not seen.committed.any()
    assert 0.0 <= seen.estimate[0, 0, 1] < 0.02


def test_a_horizon_of_an_earlier_life_is_taken_for_flying_on() -> None:
    """Its inputs are unknown, so the reported input is held."""
    replay = make(small())
    see(replay, 50, np.array([[0.0, 1.0], [0.0, -0.5]]), 45, flown=np.array([1.0, -0.5]))
    seen = foresee(replay, 60)
    np.testing.assert_allclose(seen.estimate[0, :, 1], [1.0, -0.5], atol=1e-12)
    np.testing.assert_allclose(seen.estimate[0, :, 0], [1.0, -0.5], atol=1e-12)


def test_the_newest_observation_counts() -> None:
    replay, x = make(small()), np.zeros((2, 2))
    kept = [see(replay, step, x + step, NO_HORIZON) for step in (5, 3, 7, 7)]
    assert kept == [True, False, True, False]
    assert replay.observed_step.tolist() == [7]
    np.testing.assert_array_equal(foresee(replay, 7).estimate[0], x + 7)
    replay.forget(0)
    assert replay.observed_step.tolist() == [-1]
    assert see(replay, 0, x, NO_HORIZON)


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("ahead", [1, BOUND, 10**12])
def test_an_observation_from_ahead_is_taken_as_it_is(ahead: int, *, feedback: bool) -> None:
    """Clocks may differ by any amount: nothing is predicted backwards."""
    replay, x = make(small(feedback=feedback)), np.array([[1.0, 0.3], [-2.0, -0.1]])
    send(replay, 100, np.ones((2, 2 * H)))
    see(replay, 100 + ahead, x, 100)
    seen = foresee(replay, 100)
    np.testing.assert_array_equal(seen.estimate[0], x)
    if ahead >= BOUND:
        np.testing.assert_array_equal(seen.start[0], x)


def test_many_horizons_are_kept_and_no_more() -> None:
    sent = plans(3, *[BOUND + H] * 40)

    def told(in_force: int) -> list[float]:
        """Known input at step 40, with that horizon in force."""
        replay = make(small(age_max_s=1.0))  # a ring of 16
        for step, inputs in enumerate(sent):
            see(replay, max(step - 1, 0), np.zeros((2, 2)), NO_HORIZON)
            send(replay, step, inputs)
        known = 40 - in_force < 16
        still = None if known else np.full(2, 0.5)
        see(replay, 40, np.full((2, 2), 0.5), in_force, flown=still)
        return foresee(replay, 40).committed[0, :, 0].tolist()

    assert told(36) == np.float32(sent[36][:, 4]).tolist()
    assert told(31) == np.float32(sent[31][:, 9]).tolist()
    assert told(23) == [0.5, 0.5]


def test_what_is_flown_is_believed_and_not_what_the_rule_says() -> None:
    """A vehicle's own limit holds for the reported step; afterwards the rule applies again."""
    flown = small(observer_s=0.0)
    (inputs,), x = plans(5, 2 * H), np.array([[1.0, 0.2], [-1.0, 0.1]])
    replay, own = make(flown), np.array([0.3, -0.2])
    send(replay, 100, inputs)
    see(replay, 102, x, 100, flown=own)
    seen = foresee(replay, 104)
    x = flown.terms().model.step(x, own)
    x = flown.terms().model.step(x, np.float64(np.float32(inputs[:, 3])))
    np.testing.assert_allclose(seen.estimate[0], x, rtol=0, atol=1e-12)


def test_a_vehicle_that_takes_no_horizon_brakes_and_stands_still() -> None:
    """Horizons under way count again once the vehicle reports that it accepts horizons."""
    flown = small(observer_s=0.0)
    old, new = plans(6, 2 * H, BOUND + H)
    replay, x = make(flown), np.array([[1.0, 0.6], [-1.0, 0.0]])
    send(replay, 100, old)
    send(replay, 103, new)
    see(replay, 104, x, NO_HORIZON, flown=np.array([0.6, 0.0]), takes=0)
    seen = foresee(replay, 104)
    braked = [0.6, 0.4, 0.2, 0.0]  # 2 m/s² in steps of 0.1 s
    np.testing.assert_allclose(seen.committed[0, 0, :BOUND], braked, rtol=0, atol=1e-7)
    np.testing.assert_allclose(seen.held[0], 0.0, rtol=0, atol=1e-12)
    see(replay, 105, x, NO_HORIZON, flown=np.zeros(2))
    seen = foresee(replay, 105)
    np.testing.assert_array_equal(seen.committed[0, :, 2], np.float32(new[:, 4]))


# -- feedback aboard, artificial observations ----------------------------------------------------


def test_it_makes_no_difference_when_a_horizon_with_feedback_arrives() -> None:
    """After an unforeseen disturbance, the vehicle flies the same with the previous horizon."""
    flown = small(feedback=True, observer_s=0.0, input_weight=1.0)
    (inputs,), x = plans(4, 2 * H), np.array([[1.0, 0.2], [-1.0, 0.1]])
    inputs = 0.3 * inputs
    terms, replay = flown.terms(), make(flown)
    before, after = Compensator(terms), Compensator(terms)
    gain = feedback_gain(flown)
    feedback = np.concatenate([x, np.zeros((2, 1)), gain], axis=1).astype(np.float32)
    before.offer(Horizon(1, 1, 100, 0, 0, inputs.astype(np.float32), feedback), 100, 99)
    send(replay, 100, inputs, feedback)
    x = x + 0.05  # a gust
    see(replay, 102, x, 100)
    seen = foresee(replay, 103)
    horizon = seen.committed[0].astype(np.float32)
    horizon[:, BOUND:] = 0.0
    np.testing.assert_array_equal(seen.feedback[0, :, 3:], gain.astype(np.float32))
    after.offer(Horizon(1, 1, 103, 0, 0, horizon, seen.feedback[0]), 103, 102)
    for step in range(103, 103 + BOUND):
        x = x + 0.03  # another
        told = np.array(before.choose(step, x, np.zeros(2), np.zeros(2))[0])
        assert np.abs(told - inputs[:, step - 100]).max() > 0.03
        again, _ = after.choose(step, x, np.zeros(2), np.zeros(2))
        np.testing.assert_allclose(again, told, rtol=0, atol=1e-6)


# -- in flight -----------------------------------------------------------------------------------


def estimate_error(flight: Record) -> Array:
    """|x̂ - x| at every tick whose step was flown, the largest of all axes [m, m/s]."""
    true = {int(row["step"]): row["state"] for row in flight.client}
    known = [row for row in flight.server if int(row["step"]) in true]
    return np.array([np.abs(row["estimate"] - true[int(row["step"])]).max() for row in known])


def settled(flight: Record, bound: int) -> Array:
    """Ticks at which every horizon has arrived, or is known to be lost."""
    sent = flight.server["step"][flight.server["event"]]
    last = np.array([sent[sent < step].max(initial=-1) for step in flight.server["step"]])
    return flight.server["observed_step"] >= last + bound


@pytest.fixture(scope="module")
def sparse() -> tuple[Scenario, Record]:
    """Flight with a horizon every three seconds, of which a third is lost."""
    flown = scenario(
        control={"trigger": "periodic(60)", "delay_bound": 0.8, "horizon": 70},
        network=lossy(0.33),
        duration=40.0,
    )
    return flown, fly(flown)


def test_the_estimate_is_exact_once_every_horizon_has_arrived_or_is_known_lost(
    sparse: tuple[Scenario, Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exact to the resolution of reports without noise; not without acknowledgements."""
    flown, flight = sparse
    certain = settled(flight, 16)
    assert certain.sum() > 150
    assert flight.figures["server"]["counts"]["horizons_lost"] > 3
    assert estimate_error(flight)[certain].max() <= TOLD_M
    assert estimate_error(flight).max() > 1e-3  # at other ticks it cannot be exact

    sent: list[int] = []
    remember, observe = Replay.remember, Replay.observe

    def note(self: Replay, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        sent.extend(step[event].tolist())
        remember(self, rows, step, found, event)

    def believe(self: Replay, row: int, observation: Observation) -> bool:
        arrived = [step for step in sent if step + 9 <= observation.step]
        newest = max([observation.in_force, *arrived])
        return observe(self, row, observation._replace(in_force=newest))

    monkeypatch.setattr(Replay, "remember", note)
    monkeypatch.setattr(Replay, "observe", believe)
    blind = fly(flown)
    assert estimate_error(blind)[settled(blind, 16)].max() > 1e-3


def test_a_packet_at_every_step_hides_what_is_lost() -> None:
    """All horizons begin with the same committed inputs, so the state is always known."""
    flown = scenario(control={"trigger": "always", "delay_bound": 0.8}, duration=20.0)
    flight = fly(flown)
    assert flight.netem["lost"].sum() > 50
    assert estimate_error(flight)[40:].max() <= TOLD_M


def test_every_lost_horizon_is_counted(sparse: tuple[Scenario, Record]) -> None:
    _, flight = sparse
    netem = flight.netem[flight.netem["direction"] == UPLINK]
    horizons = netem[netem["bytes"] > HORIZON_BYTES]
    old = horizons[horizons["arrived_ns"] < horizons["arrived_ns"].max() - 2_000_000_000]
    counted = flight.figures["server"]["counts"]["horizons_lost"]
    assert old["lost"].sum() <= counted <= horizons["lost"].sum()


TIGHT = {
    "state_weight": [10.0, 0.01],
    "terminal_weight": [10.0, 1.0],
    "input_weight": 1e-3,
    "change_weight": 0.0,
}
"""Tight weights, for a scheme that knows the vehicle's state; S = 0."""


FIRM = {
    "state_weight": [7.1, 1.0],
    "terminal_weight": [50.0, 20.0],
    "input_weight": 0.01,
    "change_weight": 0.0,
}
"""Less tight weights, for wind."""


def rmse(flown: Scenario, flight: Record) -> float:
    error = summarise(flown, "test", flight.client).rmse_xy
    assert error is not None
    return error


def test_it_is_stable_without_the_s_term_where_the_papers_scheme_is_not() -> None:
    errors = {}
    for scheme in ("predictive", "committed"):
        flown = scenario(control={"scheme": scheme, "trigger": "always", **TIGHT}, duration=20.0)
        errors[scheme] = rmse(flown, fly(flown))
    assert errors["committed"] < 0.002
    assert errors["predictive"] > 0.5


def test_every_step_is_planned_whatever_the_trigger(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also a step that is not sent, so that the worth of a packet is always known."""
    planned = 0
    plan = Planner.plan

    def count(self: Planner, rows: Indices, step: Indices, found: Foresight) -> None:
        nonlocal planned
        planned += len(rows)
        plan(self, rows, step, found)

    monkeypatch.setattr(Planner, "plan", count)
    flight = fly(scenario(control={"trigger": "periodic(10)"}, duration=10.0))
    assert planned == len(flight.server) > 150
    assert flight.server["event"].mean() < 0.2


@pytest.mark.long
def test_a_mean_loss_of_half_each_way_is_flown_through() -> None:
    """With the cost gap, under twice the error at a loss of 0.1."""
    errors = {}
    for loss in (0.1, 0.5):
        control = {"trigger": "cost_gap(0.5)", **FIRM}
        flown = scenario(
            control=control, network=lossy(loss, loss), vehicle={"wind": 0.1}, settle=5.0
        )
        errors[loss] = np.mean([rmse(flown, flight) for flight in fly_batch(flown, range(1, 5))])
    assert errors[0.5] < 2.0 * errors[0.1]


@pytest.mark.long
def test_feedback_aboard_flies_in_wind_with_a_packet_a_second() -> None:
    """A third of the error without feedback, with fewer packets; no effect with gain 0."""
    errors, packets = {}, {}
    for feedback in (False, True):
        control = {
            "feedback": feedback,
            "trigger": "cost_gap(1) | silence(1)",
            **FIRM,
        }
        flown = scenario(control=control, vehicle={"wind": 0.1}, settle=5.0)
        flights = fly_batch(flown, range(1, 3))
        errors[feedback] = np.mean([rmse(flown, flight) for flight in flights])
        packets[feedback] = np.mean([flight.server["event"].mean() for flight in flights])
    assert errors[True] < errors[False] / 3.0
    assert packets[True] < packets[False]


def test_with_feedback_aboard_the_estimate_is_as_exact() -> None:
    """Exact to the resolution of reports, once each horizon has arrived or is lost."""
    control = {
        "scheme": "committed",
        "feedback": True,
        "trigger": "periodic(60)",
        "delay_bound": 0.8,
        "horizon": 70,
    }
    flown = scenario(control=control, network=lossy(0.33), duration=40.0)
    flight = fly(flown)
    assert flight.figures["server"]["counts"]["horizons_lost"] > 3
    assert estimate_error(flight)[settled(flight, 16)].max() <= TOLD_M


def test_the_observer_sees_past_feedback_aboard() -> None:
    """Feedback against steady wind is no disturbance, and the wind's estimate stays."""
    reference = {"shape": "hover", "points_m": [[0.0, 0.0]]}
    control = {
        "scheme": "committed",
        "feedback": True,
        "trigger": "cost_gap(1) | silence(1)",
        "observer_s": 2.0,
    }
    vehicle = {"steady_wind_mps": [0.3, -0.2], "gain": 0.8}
    flown = scenario(control=control | FIRM, reference=reference, vehicle=vehicle, duration=45.0)
    flight = fly(flown)
    away = np.abs(flight.client["state"][-400:, :, 0])
    assert away.max() < 0.005
    # At rest the input compensates wind and gain: 0.8 u + w = 0.
    np.testing.assert_allclose(flight.client["input"][-1], [-0.375, 0.25], atol=0.01)


def test_the_vehicle_says_which_horizon_it_flies_and_since_when() -> None:
    """A horizon was first flown at `since`; the delay bound lies above that delay."""
    flown = scenario(control={"trigger": "always"}, duration=20.0)
    flight = fly(flown)
    client = flight.client[flight.client["in_force"] >= 0]
    first = {}
    for row in client:
        first.setdefault(int(row["in_force"]), int(row["step"]))
    delays = np.array([since - stamp for stamp, since in first.items()])
    ahead = flight.server["ahead"][100:]
    assert ahead.min() >= np.quantile(delays, 0.9)
    assert ahead.max() <= delays.max() + 2
