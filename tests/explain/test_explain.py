"""`explain`: answers that are known, because the network is made for them or was looked at."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest

import skytether
from skytether.explain import moments, picture, units
from skytether.explain.cases import Bad, FlightCase, Setting, Stall, UsualDelay, overridden
from skytether.explain.causes import CausePart
from skytether.explain.explanation import Explanation, _chosen, explain, explained
from skytether.explain.flying import CaseOutcome, fly
from skytether.explain.moments import Moment, comes_about
from skytether.explain.words import _counted
from skytether.library import flight as flight_module
from skytether.netem.impairments.outages import Delivered
from skytether.shared.base.errors import ConfigError
from skytether.shared.telemetry.record import DOWNLINK, UPLINK
from skytether.shell.commandline import terminal

BURSTS = "paper(0.4, 0.02, 2.0) & gilbert_elliott(0.1, 2.0)"
SHORT = "constant(0.05)"


def flight(
    name: str, seed: int, uplink: str = "", downlink: str = "", **keys: object
) -> FlightCase:
    if uplink:
        keys |= {"network.uplink": uplink, "network.downlink": downlink or uplink}
    return FlightCase(skytether.load(name, seed=seed, **keys))


def up_to(step: str, own: FlightCase, at_s: float | None = None) -> Explanation:
    """What is known before a step of the explanation."""
    steps = explain(own, "demo", lambda cases: [fly(each) for each in cases], at_s=at_s)
    return next(known for following, known in steps if following == step)


@cache
def two_links() -> Explanation:
    return skytether.fly("demo-two-links", seed=9314).explain()


def test_a_path_that_was_taken_for_dead_is_a_moment() -> None:
    (first, second) = (each for each in two_links().moments if each.kind == "path")
    assert first.says == "vehicle 1 took downlink 1 for dead (100% arrived)"
    assert second.says.startswith("the server took uplink 1 for dead")
    at = second.start_s
    known = up_to("what is needed", flight("demo-two-links", 9314), at)
    assert known.cause is not None
    (part,) = known.cause.parts
    assert isinstance(part.unit, Bad)
    assert part.unit.lane == (1, DOWNLINK, 0)
    assert part.start_s < at < part.end_s + 0.1


def test_two_outages_at_once_are_the_cause_and_each_is_needed() -> None:
    known = two_links()
    assert known.cause
    assert known.moment
    assert known.rescues
    assert known.remedies
    assert (known.moment.kind, round(known.moment.start_s, 1)) == ("brake", 12.1)
    assert known.moment.figure == pytest.approx(1.26, abs=0.005)
    one, other = known.cause.parts
    assert [round(each, 1) for each in (one.start_s, one.end_s)] == [9.4, 16.3]
    assert [round(each, 1) for each in (other.start_s, other.end_s)] == [10.6, 13.6]
    assert [part.unit.lane for part in (one, other) if isinstance(part.unit, Bad)] == [
        (0, UPLINK, 0),
        (1, UPLINK, 0),
    ]
    assert one.is_needed
    assert other.is_needed
    assert max(one.error_m, other.error_m) < 0.05
    assert known.rescues.packets == ()
    assert not any(each.averts for each in known.remedies)


def test_the_cause_holds_in_flights_of_its_own() -> None:
    """Only these losses: the moment. All but these: none."""
    known, own = two_links(), flight("demo-two-links", 9314)
    assert known.cause
    assert known.moment
    here = units.circumstances(own, fly(own), known.cause.since_s, known.moment.end_s + 5.0)
    parts = [part.unit for part in known.cause.parts]
    assert comes_about(known.moment, fly(here.only(parts)))
    assert not comes_about(known.moment, fly(here.without(*parts)))


@pytest.mark.parametrize(
    ("name", "seed", "at_s", "outage_s", "rescues"),
    [
        pytest.param("demo", 9302, 28.2, 1.95, 2, marks=pytest.mark.long),
        ("demo", 9303, 19.0, 1.75, 3),
        pytest.param("target", 9301, 40.9, 1.23, 3, marks=pytest.mark.long),
    ],
)
def test_one_outage_of_the_uplink(
    name: str, seed: int, at_s: float, outage_s: float, rescues: int
) -> None:
    known = up_to("remedies", flight(name, seed, BURSTS))
    assert known.cause
    assert known.moment
    assert known.rescues
    assert known.moment.start_s == pytest.approx(at_s, abs=0.06)
    (part,) = known.cause.parts
    assert part.is_needed
    assert part.end_s - part.start_s == pytest.approx(outage_s, abs=0.01)
    assert len(known.rescues.packets) == rescues
    assert part.shortest_s
    assert 0.9 < part.shortest_s[0] <= part.shortest_s[1] < 1.4


@pytest.mark.long
def test_packets_lost_one_after_another_are_the_cause_together() -> None:
    own = flight("demo", 22, f"{SHORT} & loss(0.85)", SHORT)
    known = up_to("how long an outage must be", own, at_s=37.5)
    assert known.cause
    assert known.rescues
    lost = [part.unit for part in known.cause.parts]
    assert len(lost) > 10
    assert all(isinstance(each, Bad) and each.is_packet and each.lane[1] == UPLINK for each in lost)
    assert len(known.rescues.packets) > 10


KILLED = Stall("server", 15.0, np.inf)


def made() -> dict[str, FlightCase]:
    """Flights in which one known thing is wrong."""
    good = flight("demo", 13, f"{SHORT} & loss(0.05)")

    def other(**keys: object) -> FlightCase:
        return flight("demo", 17, f"{SHORT} & loss(0.05)", **keys)

    gusts = {"vehicle.gust_mps2": 3.0, "vehicle.gust_every_s": 12.0}
    impatient = flight("demo", 13, SHORT, **{"link.timeout_s": 0.3})
    noise = {"sensor.position_noise_m": 0.6, "sensor.filter": "none"}
    return {
        "outage up": flight("demo", 11, f"{SHORT} & outage(14, 3)", SHORT),
        "outage down": flight("demo", 12, SHORT, f"{SHORT} & outage(14, 8)"),
        "server": replace(good, stalls=(Stall("server", 15.0, 3.0),)),
        "client": replace(good, stalls=(Stall("client", 15.0, 1.0),)),
        "killed": replace(good, stalls=(KILLED,)),
        "key": replace(impatient, overridden=overridden(impatient.scenario, "demo")),
        "gain": other(**{"vehicle.gain": 0.4}),
        "gusts": other(**gusts),
        "noise": other(**noise),
        "computing": other(**{"simulation.compute_s": 1.8}),
        "delay": flight("demo-no-compensation", 1),
    }


EXPECTED: dict[str, tuple[object, ...]] = {
    "outage up": (UPLINK,),
    "outage down": (DOWNLINK,),
    "server": (Stall("server", 15.0, 3.0),),
    "client": (Stall("client", 15.0, 1.0),),
    "killed": (KILLED,),
    "key": ("link.timeout_s = 0.3",),
    "gain": ("a vehicle that differs from its model",),
    "gusts": ("gusts",),
    "noise": ("errors of the sensors",),
    "computing": ("the server's computing time",),
    "delay": (UsualDelay(DOWNLINK), UsualDelay(UPLINK)),
}


@pytest.mark.parametrize("what", EXPECTED)
def test_what_was_broken_is_named(what: str) -> None:
    cause = up_to("what is needed", made()[what]).cause
    assert cause
    found = tuple(
        part.unit.lane[1]
        if isinstance(part.unit, Bad)
        else part.unit.name
        if isinstance(part.unit, Setting)
        else part.unit
        for part in cause.parts
    )
    assert found == EXPECTED[what]


def test_what_has_to_go_is_listed_if_other_units_suffice_as_well() -> None:
    """The server is not heard, or hears nothing: either makes the vehicle brake."""
    own = flight("demo", 11, f"{SHORT} & outage(14, 9)")
    known = up_to("what is needed", own)
    assert known.cause
    assert known.moment
    first, second = (
        [part.unit.lane[1] for part in parts if isinstance(part.unit, Bad)]
        for parts in (known.cause.parts, known.cause.averting)
    )
    assert len(first) == 1
    assert sorted(second) == [UPLINK, DOWNLINK]
    assert "Without it, other units suffice. It is averted without one outage of " in str(known)
    assert not known.cause.parts[0].is_needed


def test_a_standby_server_is_a_remedy_when_the_server_was_killed() -> None:
    known = up_to("other seeds", made()["killed"])
    assert known.remedies
    as_flown, *tried = known.remedies
    assert [each.name for each in tried if each.averts] == ["a standby server"]
    assert tried[0].packets_per_s > as_flown.packets_per_s
    assert "Why: death of the server.\n  death of the server  at 15.0 s  without: does not" in str(
        known
    )


def test_keys_of_another_scenario_are_no_cause() -> None:
    """Of a reference, of the network and of what is known of neither."""
    own = skytether.load("target", **{"reference.agility": 0.1, "network.uplink": SHORT})
    assert overridden(own, "target") == ()
    assert overridden(own, "nothing of this name") == ()


def test_without_the_means_to_deliver_no_cause_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ablation: `delivered` does nothing, and the outages cannot be told from the scenario."""
    monkeypatch.setattr(Delivered, "__call__", lambda *_: None)
    own = flight("demo", 11, f"{SHORT} & outage(14, 3)", SHORT)
    cause = up_to("what is needed", own).cause
    assert cause
    assert cause.parts == ()


def test_a_good_flight_has_no_moment() -> None:
    known = explained(flight("demo", 1), "demo")
    assert (known.moments, known.moment, known.cause) == ((), None, None)
    assert str(known).startswith("Nothing went wrong")
    with pytest.raises(ConfigError, match="nothing went wrong"):
        picture.drawn(known)


def test_a_long_explanation_shows_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[float, str]] = []

    @contextmanager
    def progress(title: str, total: float, unit: str) -> Iterator[terminal.Bar]:
        assert (title, total, unit) == ("explaining demo", 6, "steps")
        yield lambda done, text="": seen.append((done, text))

    monkeypatch.setattr(terminal, "progress", progress)
    monkeypatch.setattr(flight_module, "QUIET_S", 0.0)
    uplink = {"network.uplink": f"{SHORT} & outage(9, 3)", "network.downlink": SHORT}
    skytether.fly("demo", seed=11, duration=16, **uplink).explain()
    assert seen == sorted(seen, key=lambda each: each[0])
    assert [*dict.fromkeys(text for _, text in seen)] == [
        "what went wrong",
        "what suffices",
        "what is needed",
        "single packets",
        "how long an outage must be",
        "remedies",
    ]


def test_late_packets_are_named_by_their_direction() -> None:
    late = "lognormal(0.02, 0.1, 0.1)"
    own = flight("demo", 11, f"{late} & outage(9, 3)", late, duration=16)
    cause = up_to("single packets", own).cause
    assert cause
    innocent = {name for name, _ in cause.innocent}
    assert {"late packets of the uplink", "late packets of the downlink"} <= innocent


def test_several_units_of_a_kind_are_in_the_plural() -> None:
    late = [
        CausePart(Bad((0, UPLINK, 0), first, first + 9, is_late=True), 0.0, 1.0, True, 0.1)
        for first in (0, 20)
    ]
    lost = replace(late[0], unit=Bad((0, UPLINK, 0), 40, 41, is_packet=True))
    assert _counted([*late, lost]) == [
        "2 periods of late packets of the uplink",
        "one lost packet of the uplink",
    ]


def test_of_two_moments_at_once_the_one_that_begins_then_is_meant() -> None:
    first, second = (
        Moment("brake", vehicle, start_s, 20.0, "braked", 1.0, 0.0, 1.0, 0.0)
        for vehicle, start_s in ((1, 10.0), (2, 12.111))
    )
    assert _chosen([first, second], 12.11) is second
    assert _chosen([first, second], 10.4) is first
    assert _chosen([first, second], 18.0) is second
    other = replace(first, vehicle=2)
    assert _chosen([first, other, second], 10.4, 2) is other
    with pytest.raises(ConfigError, match="vehicle: got 3, expected one of 1, 2"):
        _chosen([first, other], None, 3)


def test_a_flight_that_is_always_bad_does_not_hide_itself() -> None:
    own = flight("demo-no-compensation", 1)
    (moment,) = moments.moments(fly(own), fly(units.perfect(own)), own.scenario)
    assert moment.kind == "error"
    assert moment.figure > 1.0
    assert moment.usual < 0.1


def test_a_time_without_a_moment_is_refused_with_those_there_are() -> None:
    with pytest.raises(
        ConfigError, match=r"at: got 25, expected one of 10\.0, 12\.1, 29\.6, at which"
    ):
        explained(flight("demo-two-links", 9314), "demo", at_s=25.0)
    with pytest.raises(ConfigError, match="nothing went wrong in this flight"):
        explained(flight("demo", 1), "demo", at_s=30.0)


def test_a_record_that_does_not_come_about_again_is_refused() -> None:
    flown = skytether.fly("demo", seed=1, duration=10)
    other = skytether.Flight(skytether.load("demo", seed=2, duration=10), flown.record, name="mine")
    with pytest.raises(ConfigError, match="mine: its flight cannot be reproduced"):
        other.explain()


def test_text_json_and_picture_say_what_is_known(tmp_path: Path) -> None:
    known = two_links()
    text = str(known)
    assert "Why: 2 outages of the uplink, together." in text
    assert "nothing tried helps" in text
    assert max(map(len, text.splitlines())) < 160
    told = msgspec.json.decode(known.to_json())
    assert [part["packets"] for part in told["cause"]["parts"]] == [13, 10]
    assert told["rescues"] == {"packets": [], "tried": 11}
    picture.drawn(known).savefig(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 20_000


def test_whoever_interrupts_keeps_what_is_known_by_then() -> None:
    flights = 0

    def fly_some(cases: Sequence[FlightCase]) -> list[CaseOutcome]:
        nonlocal flights
        flights += len(cases)
        if flights > 16:
            raise KeyboardInterrupt
        return [fly(each) for each in cases]

    told: list[Explanation] = []

    def keep_all() -> None:
        for _, known in explain(flight("demo-two-links", 9314), "demo", fly_some):
            told.append(known)

    with pytest.raises(KeyboardInterrupt):
        keep_all()
    assert told[-1].cause
    assert told[-1].remedies is None
    assert "Why: 2 outages" in str(told[-1])


def test_two_vehicles_that_come_too_close_are_a_moment() -> None:
    scenario = skytether.load("swap", duration=20)
    outcome = fly(FlightCase(scenario, vehicles=4))
    near = replace(outcome, separation_m=outcome.separation_m.copy())
    bound_m = scenario.mission.separation_m
    assert moments.moments(outcome, outcome, scenario) == []
    near.separation_m[100:120] = 0.9 * bound_m
    (moment,) = moments.moments(near, outcome, scenario)
    assert (moment.kind, moment.figure) == ("separation", 0.9 * bound_m)
    assert moment.start_s == pytest.approx(outcome.separation_s[100])
    assert comes_about(moment, near)
    assert not comes_about(moment, outcome)


def test_many_plans_in_a_second_are_a_moment() -> None:
    own = flight("paper", 3, BURSTS)
    outcome, perfect = fly(own), fly(units.perfect(own))
    wasted = [
        each for each in moments.moments(outcome, perfect, own.scenario) if each.kind == "packets"
    ]
    assert max(each.figure for each in wasted) > 15.0
    assert all(np.isfinite(each.usual) for each in wasted)
