"""Dead reckoning: what is sent in place of a plan, when, and where both ends expect the target."""

from collections.abc import Sequence
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from skytether.client.compensator import Compensator
from skytether.server.control.dead_reckoning import Reckoning
from skytether.server.control.desired import Desired
from skytether.server.control.gain import stationary_gain
from skytether.server.control.scheme import Foresight, foresight
from skytether.shared.base.errors import ConfigError
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import UPLINK, Record
from skytether.shared.telemetry.summary import position_error
from skytether.shared.wire.protocol import (
    FEEDBACK,
    VERSION,
    Horizon,
    Mode,
    Observation,
    ProtocolError,
    decode,
    encode,
)
from skytether.sim.flight import fly, fly_batch

Floats = NDArray[np.float32]

SECONDS = 20.0
LINE = {"shape": "waypoints", "points_m": [[0.0, 0.0], [80.0, 60.0]], "speed_mps": 1.0}
"""A target of constant velocity, 0.8 and 0.6 m/s."""
STILL: dict[str, Any] = {"delay": "none", "loss": 0.0}
FAR: dict[str, Any] = {"delay": "constant", "minimum_s": 0.4, "loss": 0.0}


def scenario(**sections: Any) -> Scenario:
    """Steps of 0.1 s without wind, along LINE, over a network of no delay."""
    table: dict[str, Any] = {
        "duration": SECONDS,
        "settle": 12.0,
        "control": {
            "dt": 0.1,
            "scheme": "dead_reckoning",
            "feedback": True,
            "trigger": "tolerance(0.01)",
        },
        "reference": LINE,
        "network": {"uplink": STILL, "downlink": STILL},
        "link": {"age_max_s": 60.0},
    }
    for section, keys in sections.items():
        table[section] = (
            table[section] | keys if section in table and isinstance(keys, dict) else keys
        )
    return reading.check(table, "test")


def sent_steps(flight: Record) -> list[int]:
    """Steps at which the server sent."""
    steps: list[int] = flight.server["step"][flight.server["event"]].tolist()
    return steps


def rmse_m(flown: Scenario, flight: Record) -> float:
    """Root mean square of the distance, from `settle` on [m]."""
    late = flight.client["step"] * flown.control.dt >= flown.settle
    squares = (position_error(flown, flight.client)[late] ** 2).sum(axis=1)
    return float(np.sqrt(squares.mean()))


# -- what is sent, and when ------------------------------------------------------------------


class Moved(Desired):
    """What is known of targets that are moved by hand."""

    states = np.zeros((2, 2, 2))

    def now(self, rows: Indices, steps: Indices) -> Array:  # noqa: ARG002
        """Where they are."""
        return self.states[rows]


class Server:
    """A server's part of dead reckoning."""

    def __init__(self, flown: Scenario, capacity: int = 1) -> None:
        self.terms = flown.terms()
        self.desired = Moved(flown, self.terms, capacity, capacity)
        gain = stationary_gain(self.terms.model, flown.control)
        self.scheme = Reckoning(self.terms, gain, self.desired, capacity, capacity)
        self.found: Foresight = foresight(capacity, 2, self.terms.planned, 1)

    def observe(self, step: int, *, row: int = 0, takes: int = 1) -> None:
        """An observation of a vehicle at rest."""
        at = (step, 0, -1, 0, 0, 0, Mode.TRACK, takes)
        self.scheme.observe(row, Observation(1, 1, *at, np.zeros((2, 2)), np.zeros(2)))

    def at(self, step: int, *states: Sequence[float], send: bool = False) -> tuple[Any, ...]:
        """Fresh, left_m, moved_m of one vehicle whose target has come to a state, of each axis."""
        if states:
            self.desired.states = np.array([states, states])
        rows, steps = np.array([0]), np.array([step])
        self.scheme.foresee(rows, steps, self.found)
        self.scheme.plan(rows, steps, self.found)
        self.scheme.remember(rows, steps, self.found, np.array([send]))
        figures = self.scheme.figures[0]
        return bool(figures["fresh"]), float(figures["left_m"]), float(figures["moved_m"])


def test_target_is_sent_with_its_velocity_and_the_gain_of_the_weights() -> None:
    """One input on each axis, and where it leads on from."""
    flown = scenario()
    server = Server(flown)
    server.observe(7)
    server.at(8, (1.0, 0.5), (-2.0, -0.25))
    gain = stationary_gain(flown.terms().model, flown.control)
    np.testing.assert_array_equal(server.found.horizons[0, :, :1], [[0.5], [-0.25]])
    np.testing.assert_array_equal(
        server.found.feedback[0],
        np.array([[1.0, 0.5, 0.0, *gain[0]], [-2.0, -0.25, 0.0, *gain[1]]], np.float32),
    )
    assert server.found.ahead.tolist() == [0]


def test_a_target_faster_than_the_bound_is_sent_at_the_bound() -> None:
    """Both ends expect it no faster than the vehicle can fly; the server sees it get away."""
    server = Server(scenario(model={"u_max": [1.5]}))
    server.observe(0)
    server.at(1, (0.0, 2.0), (0.0, -3.0), send=True)
    assert server.found.horizons[0, :, 0].tolist() == [1.5, -1.5]
    assert server.found.feedback[0, :, 1].tolist() == [1.5, -1.5]
    _, left_m, _ = server.at(11, (2.0, 2.0), (-3.0, -3.0))
    assert left_m == pytest.approx(np.hypot(0.5, 1.5))


def test_distances_are_from_where_it_is_expected_and_from_where_it_was_sent() -> None:
    """Sent at (1, 2) m with (0.5, -1) m/s; 0.8 s later it is expected at (1.4, 1.2)."""
    server = Server(scenario())
    server.observe(0)
    assert server.at(2, (1.0, 0.5), (2.0, -1.0)) == (True, 0.0, 0.0)
    assert server.at(2, (1.0, 0.5), (2.0, -1.0), send=True) == (True, 0.0, 0.0)
    fresh, left_m, moved_m = server.at(10, (1.7, 0.5), (1.6, -1.0))
    assert (fresh, left_m, moved_m) == (
        False,
        pytest.approx(0.5),
        pytest.approx(np.hypot(0.7, 0.4)),
    )
    np.testing.assert_allclose(server.scheme.planned[0], [[1.4, 0.5], [1.2, -1.0]], atol=1e-6)
    server.at(10, (1.7, 0.5), (1.6, -1.0), send=True)
    assert server.at(11, (1.75, 0.5), (1.5, -1.0)) == (
        False,
        pytest.approx(0.0, abs=1e-6),
        pytest.approx(np.hypot(0.05, 0.1)),
    )


def test_a_vehicle_has_nothing_to_fly_until_it_is_sent_something_and_once_that_is_too_old() -> None:
    """Observed at step 10, the packet of step 12 is flown up to step 15."""
    server = Server(scenario(link={"age_max_s": 0.5}))
    server.observe(10)
    assert server.at(11)[0]
    assert server.at(12, send=True)[0]
    assert [server.at(step)[0] for step in (13, 15, 16)] == [False, False, True]


def test_a_vehicle_that_takes_nothing_holds_nothing() -> None:
    """It has dropped what it had: once it takes packets again it gets one at once."""
    server = Server(scenario())
    server.observe(0)
    server.at(1, send=True)
    assert not server.at(2)[0]
    server.observe(2, takes=0)
    server.observe(3)
    server.observe(1)  # older, and overtaken
    assert server.scheme.observed_step.tolist() == [3]
    assert server.at(4)[0]


def test_a_new_life_forgets_what_the_old_one_was_sent() -> None:
    """Its steps count from 0 again."""
    server = Server(scenario(), capacity=2)
    server.observe(1000)
    server.at(1001, send=True)
    server.scheme.forget(0)
    assert server.scheme.observed_step.tolist() == [-1, -1]
    server.observe(0)
    assert server.at(1)[0]


speeds = st.floats(-2.0, 2.0)
places = st.floats(-1e3, 1e3)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(places, places),
    st.tuples(speeds, speeds),
    st.integers(0, 10_000),
    st.integers(0, 500),
)
def test_both_ends_expect_the_target_in_the_same_place(
    position: tuple[float, float], velocity: tuple[float, float], step: int, since: int
) -> None:
    """A vehicle that is where the server expects the target flies with it, and is led nowhere."""
    flown = scenario(model={"u_max": [1.5]}, vehicle={"exhausted": "hold"})
    server, compensator = Server(flown), Compensator(flown.terms())
    server.observe(step)
    server.at(step + 1, *zip(position, velocity, strict=True), send=True)
    told = horizon(step + 1, server.found.horizons[0, :, :1], server.found.feedback[0])
    read = decode(encode(told), server.terms)
    assert isinstance(read, Horizon)
    compensator.offer(read, step + 1, step)
    server.at(step + 1 + since)
    u = np.array(compensator.choose(step + 1 + since, server.scheme.planned[0].tolist()))
    np.testing.assert_allclose(u, read.inputs[:, 0], atol=1e-9)


# -- the wire --------------------------------------------------------------------------------


def horizon(step: int, inputs: Floats, feedback: Floats) -> Horizon:
    """What the server sends at a step."""
    return Horizon(1, 2**32 - 1, step, 2**47, 2**47, inputs, feedback, 2**15, 300)


def wire(count: int) -> bytes:
    """The datagram of a HORIZON with so many inputs on each of two axes."""
    datagram: bytes = msgpack.packb([VERSION, 4, 1, 2, 5, 9, 9, bytes(8 * count), bytes(40), 3, 9])
    return datagram


@pytest.mark.parametrize("count", [0, 2, 40, 41])
def test_any_other_number_of_inputs_than_one_is_refused(count: int) -> None:
    """It is the peer's mistake, and no plan."""
    terms = scenario().terms()
    assert isinstance(decode(wire(1), terms), Horizon)
    with pytest.raises(ProtocolError, match=r"^shape$"):
        decode(wire(count), terms)


def test_a_single_input_is_refused_by_a_vehicle_that_flies_plans() -> None:
    """The schemes differ in what a HORIZON may be."""
    terms = scenario().terms()._replace(scheme="committed")
    assert isinstance(decode(wire(terms.horizon), terms), Horizon)
    with pytest.raises(ProtocolError, match=r"^shape$"):
        decode(wire(1), terms)


def test_a_packet_is_small() -> None:
    """At most 90 bytes in the plane, where a plan of 40 inputs has 403."""
    told = horizon(2**20, np.zeros((2, 1), np.float32), np.zeros((2, FEEDBACK), np.float32))
    assert len(encode(told)) == 90
    assert len(encode(told._replace(inputs=np.zeros((2, 40), np.float32)))) == 403


# -- flights ---------------------------------------------------------------------------------


def test_a_target_of_constant_velocity_takes_one_packet() -> None:
    """Nothing is left to say after the first, and the vehicle is where the target is."""
    flown = scenario()
    flight = fly(flown)
    assert len(sent_steps(flight)) == 1
    assert rmse_m(flown, flight) < 1e-3
    assert flight.server["left_m"].max() < 1e-5
    assert set(flight.server["threshold"]) == {0.01}
    first = sent_steps(flight)[0]
    sizes = flight.netem["bytes"][flight.netem["direction"] == UPLINK]
    assert first < 30
    assert 70 < sizes[sizes != sizes.max()].max() < 90  # beside WELCOME and heartbeats


def test_far_away_it_is_no_worse() -> None:
    """Half a second late the vehicle knows where the target has gone meanwhile."""
    flown = scenario(network={"uplink": FAR, "downlink": FAR})
    flight = fly(flown)
    assert len(sent_steps(flight)) == 1
    assert rmse_m(flown, flight) < 1e-3


def test_what_was_observed_is_recorded_as_it_is() -> None:
    """The estimate of the record is the newest observation."""
    flight = fly(scenario(network={"uplink": FAR, "downlink": FAR}))
    rows = flight.server
    observed = {int(row["step"]): row["state"] for row in flight.client}
    for row in rows[:: len(rows) // 20]:
        np.testing.assert_array_equal(row["estimate"], observed[int(row["observed_step"])])
        assert row["observed_step"] <= row["step"] - 4


def test_delta_sends_whenever_the_target_has_moved_so_far() -> None:
    """At 1 m/s, 0.25 m take three steps of 0.1 s."""
    flight = fly(scenario(control={"trigger": "delta(0.25)"}))
    assert set(np.diff(sent_steps(flight))) == {3}
    quiet = ~flight.server["event"]
    assert flight.server["moved_m"][quiet].max() == pytest.approx(0.2, abs=1e-5)


def test_a_key_stands_in_for_the_number_of_either_policy() -> None:
    """So that a search can move it."""
    for name, count in (("tolerance", 1), ("delta", 32)):
        flown = scenario(control={"trigger": name, "tolerance_m": 0.55})
        flight = fly(flown)
        assert len(sent_steps(flight)) == pytest.approx(count, abs=1)
        assert set(flight.server["threshold"]) == {0.55}


def test_silence_is_as_long_as_is_said() -> None:
    """However short the horizon is of which a plan would be half gone."""
    flown = scenario(control={"trigger": "tolerance(0.01) | silence(3)", "horizon": 4})
    assert set(np.diff(sent_steps(fly(flown)))) == {30}


@pytest.mark.parametrize("renewed", [True, False])
def test_a_packet_that_has_become_too_old_is_replaced(
    renewed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though the target is where it is expected: without that the vehicle stands still."""
    flown = scenario(link={"age_max_s": 2.0})
    if not renewed:
        forgetful = Reckoning.__init__

        def init(self: Reckoning, *args: Any) -> None:
            forgetful(self, *args)
            self._age_max = 10**6

        monkeypatch.setattr(Reckoning, "__init__", init)
    flight = fly(flown)
    assert len(sent_steps(flight)) == (9 if renewed else 1)
    assert (flight.client["mode"][-1] == Mode.HOVER) == (not renewed)
    assert (rmse_m(flown, flight) < 0.5) == renewed


@pytest.mark.parametrize("reach", ["age bound", "horizon"])
def test_how_far_a_packet_reaches_is_no_matter_of_the_horizon(
    reach: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a horizon of 0.2 s, packets of 0.4 s ago are not late; a plan of 0.2 s would be over."""
    if reach == "horizon":
        monkeypatch.setattr(Terms, "reach", property(lambda terms: terms.horizon))
    network = {"uplink": FAR, "downlink": FAR}
    flown = scenario(network=network, control={"horizon": 2, "trigger": "always"})
    flight = fly(flown)
    braked = flight.client["mode"] == Mode.BRAKE
    assert braked.any() == (reach == "horizon")


def test_only_with_feedback() -> None:
    """Nothing else would lead the vehicle to the target."""
    flown = reading.to_table(scenario())
    flown["control"]["feedback"] = False
    with pytest.raises(
        ConfigError, match=r"control.feedback: got false, expected true with control\.scheme"
    ):
        reading.check(flown, "test")


def test_a_lost_packet_is_made_good_by_the_next_one() -> None:
    """Nothing is acknowledged: the tolerance alone waits until what it sent is too old."""
    lossy = STILL | {"loss": 0.3}
    covered = {}
    for trigger in ("tolerance(0.01)", "tolerance(0.01) | silence(0.5)"):
        flown = scenario(
            duration=10.0, settle=0.0, network={"uplink": lossy}, control={"trigger": trigger}
        )
        covered[trigger] = [
            flight.client["covered"].mean() for flight in fly_batch(flown, (5, 14, 23))
        ]
    alone, repeated = covered.values()
    assert max(alone) == 0.0
    assert min(repeated) > 0.5
