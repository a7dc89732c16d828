"""Runs that share a server: each equals, to the last bit, the run alone."""

from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from helpers import packaged
from skytether.server.planning.desired import Desired
from skytether.shared.base import chance
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.events.flight import SessionEnded
from skytether.shared.events.ground import NoAnswer
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.wire.protocol import Heartbeat, encode
from skytether.sim import batch, flight
from skytether.sim.batch import COMPANY_MAX, fly_batch
from skytether.sim.flight import fly


def scenario(**changes: Any) -> Scenario:
    return packaged("paper", {"duration": 2.0, "settle": 0.0}, changes)


def assert_as_alone(flown: Scenario, seeds: Sequence[int]) -> list[Record]:
    flights = fly_batch(flown, seeds)
    assert len(flights) == len(seeds)
    for seed, together in zip(seeds, flights, strict=True):
        alone = fly(replace(flown, seed=seed))
        for part in ("client", "server", "netem"):
            assert getattr(together, part).tobytes() == getattr(alone, part).tobytes(), part
        assert together.trace_hash() == alone.trace_hash()
        assert together.failure == alone.failure
        assert together.events == alone.events
    return flights


def test_a_change_in_flight_reaches_every_run_of_a_batch() -> None:
    changes = [(1.0, {"vehicle.wind": 0.3})]
    together = [each.trace_hash() for each in fly_batch(scenario(), (1, 2), changes=changes)]
    alone = [fly(scenario(seed=seed), changes=changes).trace_hash() for seed in (1, 2)]
    assert together == alone
    assert together != [each.trace_hash() for each in fly_batch(scenario(), (1, 2))]


directions = st.builds(
    "{} & loss({})".format,
    st.sampled_from(["none", "constant(0.05)", *(f"paper({s}, 0.02, 2)" for s in (0, 0.1, 0.4))]),
    st.sampled_from([0.0, 0.1, 0.5]),
)

scenarios = st.fixed_dictionaries(
    {
        "control": st.fixed_dictionaries(
            {
                "dt": st.sampled_from([0.05, 0.03]),
                "scheme": st.sampled_from(["predictive", "none", "committed"]),
                "feedback": st.booleans(),
                "trigger": st.sampled_from(
                    ["state_gap", "always", "periodic", "state_gap & budget(5, 2) | silence(0.3)"]
                ),
                "observer_s": st.sampled_from([0.0, 2.0]),
                "solver": st.sampled_from(["exact", "exact", "exact", "osqp"]),
            }
        ).filter(lambda control: not (control["feedback"] and control["scheme"] == "none")),
        "model": st.fixed_dictionaries({"axes": st.sampled_from([2, 3])}),
        "vehicle": st.fixed_dictionaries(
            {"wind": st.sampled_from([0.0, 0.3]), "gust_mps2": st.sampled_from([0.0, 0.5])}
        ),
        "network": st.fixed_dictionaries({"uplink": directions, "downlink": directions}),
        "link": st.just({"heartbeat_s": 0.2, "timeout_s": 0.5}),
        "simulation": st.fixed_dictionaries(
            {
                "compute_s": st.sampled_from([0.0, 0.001, 0.01, 0.03, 0.08]),
                "clock_offset_s": st.sampled_from([0.0, -3600.0]),
                "clock_drift_ppm": st.sampled_from([0.0, 200.0, -1000.0]),
            }
        ),
    }
)
committing = st.builds(
    lambda changes, control: changes | {"control": changes["control"] | control},
    scenarios,
    st.fixed_dictionaries(
        {
            "scheme": st.just("committed"),
            "feedback": st.booleans(),
            "trigger": st.sampled_from(
                ["cost_gap(0.01)", "cost_gap(1)", "deviation & budget(5, 2) | cost_gap(1)"]
            ),
        }
    ),
)
guided = st.builds(
    lambda changes, control, shape: (
        changes | {"control": changes["control"] | control, "reference": {"shape": shape}}
    ),
    scenarios,
    st.fixed_dictionaries(
        {
            "scheme": st.just("trajectory"),
            "feedback": st.just(True),
            "trigger": st.sampled_from(
                ["always", "expected_gap(0.1) | silence(1)", "deviation(0.2) & budget(5, 2)"]
            ),
        }
    ),
    st.sampled_from(["circle", "target"]),
)
"""With trajectories that are sent as splines."""
companies = st.lists(st.integers(0, 2**32 - 1), min_size=2, max_size=4, unique=True)
phases_ms = st.none() | st.lists(st.sampled_from([0, 5, 10, 20]), min_size=4, max_size=4)
"""None leaves the phases to the seeds; the others make events coincide."""


@pytest.mark.long
@settings(max_examples=15)
@given(st.one_of(scenarios, committing, guided), companies, phases_ms)
def test_a_run_in_a_batch_equals_the_same_run_alone(
    changes: dict[str, Any], seeds: list[int], phases: list[int] | None
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        if phases:
            given_ns = {
                seed: phase * MILLISECOND_NS for seed, phase in zip(seeds, phases, strict=False)
            }
            patch.setattr(flight, "stream", lambda seed, *names: Drawn.of(given_ns, seed, *names))
        assert_as_alone(scenario(**changes), seeds)


class Drawn:
    """Random generator with a given phase."""

    def __init__(self, phase_ns: int) -> None:
        self._phase_ns = phase_ns

    def integers(self, _: int) -> int:
        return self._phase_ns

    @classmethod
    def of(cls, given_ns: dict[int, int], seed: int, *names: str | int) -> Any:
        """The stream of these names, except for the phase."""
        return cls(given_ns[seed]) if names == ("phase",) else chance.stream(seed, *names)


def test_runs_are_equal_in_another_order_and_in_a_larger_batch() -> None:
    flown = scenario(vehicle={"wind": 0.3})
    few = fly_batch(flown, range(3, 8))
    many = fly_batch(flown, range(9, 1, -1))
    assert [run.trace_hash() for run in few] == [run.trace_hash() for run in many[2:7]][::-1]
    assert len({run.trace_hash() for run in many}) == 8


@pytest.mark.parametrize("preview", ["none", "all"])
def test_each_run_follows_the_target_of_its_own_seed(
    preview: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown = scenario(reference={"shape": "target", "preview": preview})
    runs = assert_as_alone(flown, (3, 1, 2))
    monkeypatch.setattr(Desired, "assign", lambda self, row, _: self._number.put(row, 1))
    same = [run.trace_hash() for run in fly_batch(flown, (3, 1, 2))]
    assert [run.trace_hash() == other for run, other in zip(runs, same, strict=True)] == [
        True,
        False,
        False,
    ]


def test_a_session_expires_at_the_same_time_alone_and_in_a_batch() -> None:
    """After 30 s of silence a lone server stops ticking, one with further runs continues.

    The server looks for expired sessions on the grid of its own clock.
    """
    rare = {"downlink": "loss(0.93)", "uplink": ""}
    control, link = {"dt": 1.0, "horizon": 3}, {"connect_s": 60.0}
    flown = scenario(duration=240.0, control=control, network=rare, link=link)
    flights = assert_as_alone(flown, range(3))
    ended = [sum(event == SessionEnded(vehicle=1) for *_, event in run.events) for run in flights]
    assert sum(ended) >= 2
    assert flights[0].figures["server"]["dropped"]["unknown session"] > 0


def test_a_run_that_finds_no_server_leaves_the_others_alone() -> None:
    """Five packets in six are lost: some vehicles give up, at different times, and some fly."""
    deaf = {"uplink": {"loss": 0.85}, "downlink": {"loss": 0.5}}
    flights = assert_as_alone(scenario(network=deaf, link={"connect_s": 5.0}), range(6))
    gave_up = [isinstance(run.failure, NoAnswer) for run in flights]
    assert 0 < sum(gave_up) < 6
    assert [len(run.client) == 0 for run in flights] == gave_up


def test_a_flight_whose_trajectory_is_looked_up_anew_is_as_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A full store of reference pages is emptied for the first flight that needs a page."""
    made: list[Desired] = []
    init = Desired.__init__

    def crowded(self: Desired, *given: Any) -> None:
        init(self, *given)
        self._keys[3:] = 2**62
        made.append(self)

    monkeypatch.setattr(Desired, "__init__", crowded)
    quiet = "constant(0.0)"
    flown = scenario(
        duration=6.0,
        control={"dt": 0.02, "horizon": 2},
        network={"uplink": quiet, "downlink": quiet},
        simulation={"compute_s": 0.0},
    )
    assert_as_alone(flown, (1, 2))
    assert [2**62 in each._keys for each in made] == [False] * 3


def test_vehicles_and_sessions_take_as_many_bytes_in_any_run() -> None:
    sizes = {
        len(encode(Heartbeat(vehicle, number, 2**31, 0, 0)))
        for vehicle in (1, COMPANY_MAX)
        for number in (2**31, 2**32 - 1)
    }
    assert len(sizes) == 1


def test_more_runs_than_share_a_server_are_flown_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "COMPANY_MAX", 3)
    flown = scenario(duration=0.2)
    flights = fly_batch(flown, range(4))
    assert len(flights) == 4
    assert flights[-1].trace_hash() == fly(replace(flown, seed=3)).trace_hash()
    assert fly_batch(flown, ()) == []


def test_a_batch_can_be_broken_off() -> None:
    seconds: list[int] = []
    flown = scenario(duration=60.0)
    runs = fly_batch(flown, range(3), on_second=seconds.append, stopped=lambda: len(seconds) >= 4)
    assert seconds == [1, 2, 3, 4]
    assert 0 < max(len(run.client) for run in runs) < 80
