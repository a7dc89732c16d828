"""Several paths of a session in virtual time, each with a netem of its own."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import pytest

from helpers import packaged
from skytether.client import paths
from skytether.client.endpoint import Client
from skytether.client.paths import SeveralPaths
from skytether.client.several import Several
from skytether.netem.fate import Fates
from skytether.netem.impairments.draws import SLOT_NS
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import FlowOpened
from skytether.shared.events.paths import PathDied, PathHealed
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Record
from skytether.shared.telemetry.summary import summarise
from skytether.shell.commandline.terminal import summary_rows
from skytether.sim import flight
from skytether.sim.batch import fly_batch
from skytether.sim.flight import fly

SLOTS_PER_S = SECOND_NS // SLOT_NS
BLACK_HOLE = {"uplink": "loss(1)", "downlink": "loss(1)"}
GOOD = {"uplink": "constant(0.1) & loss(0.2)", "downlink": "constant(0.05)", "price": 3.0}


def two_paths(*each: dict[str, Any], **changes: Any) -> Scenario:
    network = {"network": {"paths": list(each or (BLACK_HOLE, GOOD))}}
    return packaged("paper", network, {"duration": 3.0, "settle": 0.0}, changes)


class OnSecondPath(Client):
    """Client that uses its second path alone."""

    def __init__(self, *args: Any, server: Several, **options: Any) -> None:
        super().__init__(*args, server=server.addresses[1], **options)


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> Record:
    monkeypatch.setattr(flight, "Client", OnSecondPath)
    return fly(two_paths())


def test_a_client_gets_the_address_and_the_price_of_each_path(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = []

    class Noted(SeveralPaths):
        def __init__(
            self, addresses: Sequence[Address], *args: Any, prices: Sequence[float], **options: Any
        ) -> None:
            given.append((addresses, prices))
            super().__init__(addresses, *args, prices=prices, **options)

    monkeypatch.setattr(paths, "SeveralPaths", Noted)
    fly(two_paths())
    assert given == [([("netem 1", 0), ("netem 1/2", 0)], [1.0, 3.0])]


def test_a_vehicle_on_one_of_two_paths_reaches_its_netem_alone(flown: Record) -> None:
    assert len(flown.client)
    opened = [each for each in flown.events if isinstance(each.event, FlowOpened)]
    assert [(each.host, each.process) for each in opened] == [("netem 1/2", "netem")]


def test_packets_of_a_path_meet_its_network(flown: Record) -> None:
    rows = flown.netem
    assert set(rows["path"].tolist()) == {1}
    up, down = (rows[rows["direction"] == each] for each in (UPLINK, DOWNLINK))
    assert set(up["delay_ns"].tolist()) == {100_000_000}
    assert set(down["delay_ns"].tolist()) == {50_000_000}
    assert 0.05 < up["lost"].mean() < 0.5


@pytest.mark.long
def test_the_links_of_the_demo_are_out_a_tenth_of_the_time_and_independently() -> None:
    scenario = packaged("demo-two-links")
    out = []
    for each in (scenario.on_path(0), scenario.on_path(1)):
        fates = Fates(each.uplink, each.seed, "uplink", 0)
        out.append([fates.at(slot).lost for slot in range(0, 40_000 * SLOTS_PER_S, SLOTS_PER_S)])
    one, other = np.array(out)
    assert (one.mean(), other.mean()) == (pytest.approx(0.1, abs=0.015),) * 2
    assert (one & other).mean() == pytest.approx(0.01, abs=0.005)


def test_figures_count_all_paths_together_and_each_alone(flown: Record) -> None:
    netem, rows = flown.figures["netem"], flown.netem
    assert set(netem["by_path"]) == {"1", "2"}
    assert netem["by_path"]["1"]["uplink"]["packets"] == 0
    for way, direction in (("uplink", UPLINK), ("downlink", DOWNLINK)):
        own = netem["by_path"]["2"][way]
        assert netem[way]["bytes"] == own["bytes"]
        assert netem[way]["packets"] == own["packets"] >= (rows["direction"] == direction).sum()
        assert netem[way]["delays_ms"] == own["delays_ms"]
    summary = summarise(two_paths(), "two", flown.client, flown.server, rows, figures=flown.figures)
    assert summary.uplink_packets == (rows["direction"] == UPLINK).sum()
    assert summary.paths == [(0, 0), (summary.uplink_packets, summary.downlink_packets)]
    assert summary.drops is not None
    assert summary.drops["netem"]["uplink lost"] == netem["uplink"]["lost"]


def test_a_summary_counts_the_packets_of_each_path_if_there_are_several(flown: Record) -> None:
    summary = summarise(two_paths(), "two", flown.client, flown.server, flown.netem)
    up, down = summary.uplink_packets, summary.downlink_packets
    assert ("paths: packets up, down", f"0, 0; {up}, {down}") in summary_rows(summary)
    one = summarise(two_paths(GOOD), "one", flown.client, flown.server, flown.netem)
    assert one.paths is None
    assert not any("paths" in name for name, _ in summary_rows(one))


def test_a_change_of_impairments_reaches_every_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight, "Client", OnSecondPath)
    record = fly(two_paths(), changes=[(1.0, {"network.downlink": "constant(0.2)"})])
    down = record.netem[record.netem["direction"] == DOWNLINK]
    later = down["arrived_ns"] > 1_000_000_000
    assert set(down["delay_ns"][later].tolist()) == {200_000_000}


def test_a_run_of_a_batch_with_paths_equals_the_same_run_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(flight, "Client", OnSecondPath)
    scenario = two_paths()
    together = fly_batch(scenario, (1, 2))
    for seed, record in zip((1, 2), together, strict=True):
        alone = fly(msgspec.structs.replace(scenario, seed=seed))
        assert record.trace_hash() == alone.trace_hash()


def test_a_changed_network_of_a_run_in_a_batch_has_the_runs_own_seed() -> None:
    scenario = packaged("paper", {"duration": 3.0, "settle": 0.0})
    changes = [(1.0, {"network.uplink": "constant(0.2) & loss(0.3)"})]
    together = fly_batch(scenario, (1, 2), changes=changes)
    for seed, record in zip((1, 2), together, strict=True):
        alone = fly(msgspec.structs.replace(scenario, seed=seed), changes=changes)
        assert record.trace_hash() == alone.trace_hash()


def test_the_demo_with_two_links_flies_over_both() -> None:
    record = fly(packaged("demo-two-links", duration=10.0, settle=0.0))
    assert np.unique(record.netem["path"]).tolist() == [0, 1]
    assert record.client["covered"][-1]


def test_both_ends_say_when_a_path_dies_and_is_well_again_and_which_it_is() -> None:
    events = fly(packaged("demo-two-links", duration=12.0)).events
    for process, via in (
        ("client", {"netem 1:0", "netem 1/2:0"}),
        ("server", {"netem 1:1", "netem 1/2:1"}),
    ):
        for kind in (PathDied, PathHealed):
            found = [
                each.event
                for each in events
                if isinstance(each.event, kind) and each.process == process
            ]
            assert found
            assert {each.via for each in found} <= via
