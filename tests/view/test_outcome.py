"""The first screen of a report: who arrived, how near vehicles came, what failed and took over."""

import re
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from helpers import packaged
from skytether.cli import recorder
from skytether.cli.join import join
from skytether.cli.report import report
from skytether.shared.events.paths import PathDied, PathHealed
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import FlightEvent, Record
from skytether.shared.telemetry.summary import summarise
from skytether.shell.commandline import command
from skytether.sim.flight import SERVER, fly
from skytether.view.recordings.outcome import Outcome, listed
from skytether.view.recordings.recorded import read

DIED_S, HEALED_S, STOPPED_S = 20.0, 35.0, 9.0


@cache
def flown(duration: float) -> tuple[Scenario, Record]:
    """Four vehicles that change places; the leading server dies at STOPPED_S, and one path of two
    vehicles from DIED_S to HEALED_S.
    """
    scenario = packaged("swap", {"duration": duration}, reference={"shape": "swap(4)"})
    dies = [(STOPPED_S, lambda world: world.stop(SERVER[0]))]
    record = fly(scenario, vehicles=4, standby=True, actions=dies)
    heard = [
        FlightEvent(
            round((at_s + 0.1 * vehicle) * 1e9), "client", kind(vehicle=vehicle, path=1, via="lte")
        )
        for vehicle in (1, 2)
        for at_s, kind in ((DIED_S, PathDied), (HEALED_S, PathHealed))
    ]
    events = tuple(sorted((*record.events, *heard), key=lambda each: each.time_ns))
    record = replace(record, events=events)
    return scenario, record


def recorded(folder: Path, duration: float = 50.0) -> Path:
    scenario, record = flown(duration)
    path = folder / "flight.mcap"
    summary = summarise(scenario, "swap", record.client, record.server, record.netem)
    assert recorder.write(path, scenario, "swap", record, summary) is None
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("flown"))


def outcome(path: Path) -> Outcome:
    back = read(path)
    client = back.parts["client"]
    begin_ns = int(back.times_ns["client"][0]) - int(client["step"][0]) * back.scenario.dt_ns
    return Outcome(back, begin_ns)


def test_a_mission_is_judged_by_its_goals_and_distances(recording: Path) -> None:
    found = outcome(recording)
    _, record = flown(50.0)
    at_ends = {
        number: record.client[record.client["vehicle"] == number]["state"][-1, :2, 0]
        for number in found.numbers
    }
    # all have changed places with the vehicle across
    for number, place in at_ends.items():
        begin = record.client[record.client["vehicle"] == number]["state"][0, :2, 0]
        assert np.linalg.norm(place + begin) < 0.3
    assert all(map(found.arrived, found.ended))
    assert "4 of 4 recorded vehicles arrived" in found.verdict
    least_m = min(apart_m for apart_m, _ in found.least.values())
    assert set(found.least) == set(combinations(found.numbers, 2))
    assert found.scenario.mission.separation_m < least_m < 1.2
    assert f"{least_m:.3f} m" in found.verdict
    assert min(each.nearest_m or np.inf for each in found.ended) == least_m


def test_vehicles_that_are_under_way_at_the_end_have_not_arrived(tmp_path: Path) -> None:
    found = outcome(recorded(tmp_path, 26.0))
    assert not any(map(found.arrived, found.ended))
    assert "0 of 4 recorded vehicles arrived, not 1 to 4" in found.verdict


def test_what_failed_is_told_once_for_all_vehicles(recording: Path) -> None:
    found = outcome(recording)
    happened = {text: (at_s, who) for at_s, who, text in found.happened}
    (leads,) = (each for each in happened if "leads it now" in each)
    assert happened[leads][1] == (1, 2, 3, 4)
    (died,) = (each for each in happened if "nothing arrives over path 1" in each)
    (healed,) = (each for each in happened if "path 1 (lte) works again" in each)
    assert happened[died][1] == happened[healed][1] == (1, 2)
    assert not any("waits for" in each for each in happened)
    spans = found.dead_paths[1]
    assert [(who, pytest.approx(end_s - begin_s)) for who, begin_s, end_s in spans] == [
        (1, HEALED_S - DIED_S),
        (2, HEALED_S - DIED_S),
    ]
    assert {who for who, _ in found.new_leaders()} == {1, 2, 3, 4}


@pytest.mark.usefixtures("unpainted")
def test_the_report_begins_with_the_outcome(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    argv = [str(recording), "--html", str(out)]
    assert command.main(report, argv, "report") == 0
    first, _, folded = out.read_text().partition("<details>")
    for shown in (
        "4 of 4 recorded vehicles arrived",
        "0.5 m required",
        "leads it now",
        'id="course"',
    ):
        assert shown in first
    rows = first[first.index('id="vehicles"') :].partition("</table>")[0]
    assert re.findall(r"<tr><td>(\d)</td>", rows) == ["1", "2", "3", "4"]
    assert 'id="summary"' in folded
    assert 'id="events"' in folded


def test_two_servers_of_one_name_are_told_apart(recording: Path, tmp_path: Path) -> None:
    """Each process that was started by hand calls itself `server`."""
    files = [recording, tmp_path / "second.mcap"]
    files[1].write_bytes(recording.read_bytes())
    out = tmp_path / "joined.mcap"
    assert command.main(join, [*map(str, files), "--record", str(out)], "join") == 0
    processes = {process for _, process, _ in read(out).frames}
    assert {"server", "server 2", "client", "client 2"} <= processes


def test_numbers_in_words() -> None:
    assert listed([5, 1, 2, 4, 9, 6]) == "1, 2, 4 to 6, 9"
    assert listed([3]) == "3"
    assert not listed(())
