"""`explain.units` and the impairment `delivered`: what is taken out of a flight, and what stays."""

from dataclasses import replace
from functools import cache

import msgspec
import pytest

import skytether
from skytether.explain import units
from skytether.explain.cases import Bad, FlightCase, Setting, Stall, Stretch, overridden
from skytether.explain.flying import CaseOutcome, fly
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.shared.scenario import reading
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.telemetry.record import DOWNLINK, UPLINK

LOSSY = "constant(0.05) & loss(0.1) & outage(6, 2)"


@cache
def case() -> FlightCase:
    keys = {"network.uplink": LOSSY, "network.downlink": "constant(0.05)", "duration": 12}
    return FlightCase(skytether.load("demo", seed=7, **keys))


@cache
def flown() -> CaseOutcome:
    return fly(case())


def fates(text: str, flow: int = 0) -> list[tuple[bool, int]]:
    lane = Fates(impairments(text), 1, "uplink", flow)
    each = [lane.at(slot) for slot in range(4000)]
    return [(fate.lost, fate.delay_ns) for fate in each]


def test_delivered_changes_the_fates_in_its_stretches_alone() -> None:
    text = "paper(0.4, 0.02, 2.0) & loss(0.3)"
    before, after = fates(text), fates(f"{text} & delivered(0, 1, 0.5, 0.41, 0, 3, 0.001, 1)")
    assert [*before[:1000], *before[1500:3000], *before[3001:]] == [
        *after[:1000],
        *after[1500:3000],
        *after[3001:],
    ]
    assert after[1000:1500] == [
        (False, min(delay_ns, 410_000_000)) for _, delay_ns in before[1000:1500]
    ]
    assert after[3000] == (False, before[3000][1])


def test_delivered_is_for_one_flow() -> None:
    text = "loss(0.3)"
    assert fates(f"{text} & delivered(1, 0, 4, 0)") == fates(text)
    assert not any(lost for lost, _ in fates(f"{text} & delivered(1, 0, 4, 0)", flow=1))


@pytest.mark.parametrize("text", ["delivered()", "delivered(0, 1, 2)", "delivered(0, 1, 2, 3, 4)"])
def test_delivered_needs_four_numbers_a_stretch(text: str) -> None:
    with pytest.raises(GrammarError, match="four numbers for each period"):
        impairments(text)


def test_a_case_without_changes_is_the_flight_of_its_scenario() -> None:
    record = skytether.fly(case().scenario).record
    outcome = flown()
    assert outcome.trace == fly(replace(case(), until_s=None)).trace
    assert len(outcome.packets.time_s) == len(record.netem)
    assert outcome.packets.lost.sum() == record.netem["lost"].sum()
    assert int(outcome.packets.is_plan.sum()) == int(record.server["event"].sum())


def test_a_flight_that_ends_early_is_the_beginning_of_the_whole() -> None:
    early = fly(replace(case(), until_s=7.0))
    (track,), (whole,) = early.tracks, flown().tracks
    assert 6.9 < track.time_s[-1] < 8.1
    assert (track.error_m == whole.error_m[: len(track.error_m)]).all()


def test_the_fate_of_each_packet_is_that_of_its_slot() -> None:
    packets = flown().packets
    for lane, slot, lost in zip(packets.lane, packets.slot.tolist(), packets.lost, strict=True):
        assert case().fates(lane).at(slot).lost == lost


def test_an_outage_is_found_to_the_millisecond_and_losses_by_chance_packet_by_packet() -> None:
    here = units.circumstances(case(), flown(), 5.0, 9.0)
    up = [each for each in here.units if isinstance(each, Bad) and each.lane[1] == UPLINK]
    outage, *others = [each for each in up if not each.is_packet]
    assert others == []
    assert (outage.first, outage.end) == (6000, 8000)
    packets = flown().packets
    began_s = flown().began_s[0, UPLINK, 0]
    lost = {
        int(packets.slot[number])
        for number, lane in enumerate(packets.lane)
        if lane[1] == UPLINK and packets.lost[number] and 5.0 <= packets.time_s[number] < 9.0
    }
    assert {each.first for each in up if each.is_packet} == {
        slot for slot in lost if not 6000 <= slot < 8000
    }
    assert began_s < 1.0
    assert Setting("wind", here.units[0].keys) == here.units[0]  # type: ignore[union-attr]


def test_keys_that_belong_together_are_one_unit() -> None:
    """A trigger of another scheme cannot be undone without the scheme."""
    one, other = (
        skytether.load("demo", **keys)
        for keys in (
            {"control.horizon": 60, "link.heartbeat_s": 0.4},
            {"control.scheme": "predictive", "control.trigger": "state_gap(0.1, 1.0)"},
        )
    )
    for scenario, count in ((one, 2), (other, 1)):
        keys = overridden(scenario, "demo")
        here = units.circumstances(FlightCase(scenario, overridden=keys), flown(), 5.0, 9.0)
        found = [each for each in here.units if isinstance(each, Setting) and each.name != "wind"]
        assert len(found) == count
        assert tuple(key for each in found for key in each.keys) == keys


def test_only_the_kept_units_lose_packets_in_the_window() -> None:
    here = units.circumstances(case(), flown(), 5.0, 9.0)
    (outage,) = (each for each in here.units if isinstance(each, Bad) and not each.is_packet)
    packets = fly(here.only([outage])).packets
    slots = packets.slot[packets.lost & (packets.time_s > 5.1) & (packets.time_s < 8.9)]
    assert len(slots)
    assert ((slots >= outage.first) & (slots < outage.end)).all()
    bare = fly(here.only(())).packets
    assert not bare.lost[(bare.time_s > 5.1) & (bare.time_s < 8.9)].any()


def test_without_a_unit_the_rest_stays_as_it_was_until_then() -> None:
    here = units.circumstances(case(), flown(), 5.0, 9.0)
    (outage,) = (each for each in here.units if isinstance(each, Bad) and not each.is_packet)
    (healed,), (whole,) = fly(here.without(outage)).tracks, flown().tracks
    before = whole.step_s < 5.0
    assert (healed.error_m[before[: len(healed.error_m)]] == whole.error_m[before]).all()


def test_the_perfect_flight_keeps_wind_and_loses_nothing() -> None:
    noisy = skytether.load(case().scenario, **{"sensor.position_noise_m": 0.1})
    perfect = units.perfect(FlightCase(noisy, stalls=(Stall("server", 5.0, 1.0),)))
    flies = perfect.flown()
    assert (flies.vehicle.wind, flies.sensor.position_noise_m) == (noisy.vehicle.wind, 0.0)
    assert perfect.stalls == ()
    outcome = fly(perfect)
    assert not outcome.packets.lost.any()
    assert not outcome.packets.delay_s.any()


def test_each_path_is_changed_by_itself() -> None:
    two = FlightCase(
        reading.load("demo-two-links"),
        delivered=((Stretch((1, DOWNLINK, 0), 100, 300), 0.1),),
    )
    paths = two.flown().network.paths
    assert paths[1].downlink.endswith(" & delivered(0, 0.100, 0.200, 0.100000)")
    assert msgspec.structs.replace(paths[1], downlink=paths[0].downlink) == paths[0]


def test_a_process_that_stands_still_is_a_unit() -> None:
    stall = Stall("client", 5.0, 1.0)
    stalled = fly(replace(case(), stalls=(stall,)))
    assert (stalled.tracks[0].reason == 13).any()
    here = units.circumstances(replace(case(), stalls=(stall,)), stalled, 0.0, 9.0)
    assert stall in here.units
    assert fly(replace(here.without(stall), until_s=None)).trace == flown().trace
