"""What the theorem of separation assumes, found in recordings: values of a flight, and flights in
which one assumption is broken.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers import packaged
from skytether.__main__ import main
from skytether.cli import recordings, replay
from skytether.client.compensator import Compensator
from skytether.explain import flying
from skytether.explain.cases import FlightCase
from skytether.library.flight import Flight
from skytether.shared.events.flight import FlowOpened
from skytether.shared.missions.events import LeftMotion, LeftTube
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record, trace_hash
from skytether.sim import flight
from skytether.theorem.hypotheses import Hypothesis, broken, flown, hypotheses
from skytether.theorem.judgement import judged
from skytether.theorem.waits import Wait
from skytether.view.recordings import report

WHOLE = {"horizon": 135}
"""Horizon with which every motion is recorded to its end."""
EIGHT = packaged("swap", duration=20.0, reference={"shape": "swap(8)"}, control=WHOLE)
FOUR = packaged("swap", duration=12.0, reference={"shape": "swap(4)"}, control=WHOLE)
TUBE, IN_TIME, ACCEPTED = (
    "each stays in its tube",
    "each step begins in time",
    "motions are accepted in time",
)
TO_THE_END, ALL = "motions are flown to the end", "the server observes all first"


@cache
def eight() -> Record:
    return flight.fly(EIGHT, vehicles=8)


def by_name(record: Record, scenario: Scenario) -> dict[str, Hypothesis]:
    return {each.name: each for each in hypotheses(record, scenario)}


def test_all_hold_in_a_swap_with_these_margins() -> None:
    found = by_name(eight(), EIGHT)
    assert broken([*found.values()]) == []
    margins = {name: each.margin for name, each in found.items()}
    assert margins == {
        "they begin apart": pytest.approx(2.518, abs=1e-3),
        "each begins at its place": pytest.approx(0.139, abs=1e-3),
        TUBE: pytest.approx(0.129, abs=1e-3),
        IN_TIME: pytest.approx(0.1),
        ACCEPTED: pytest.approx(0.1),
        TO_THE_END: np.inf,
        ALL: pytest.approx(1.5),
        "no clock contradicts its bounds": np.inf,
        "they keep apart": pytest.approx(0.470, abs=1e-3),
    }
    assert (found[TUBE].vehicles, found[TUBE].step, found[TUBE].checked) == ((8,), 222, 1.0)


def test_the_server_sees_no_smaller_margins_in_flight() -> None:
    """Its own ones are those of the steps that vehicles report."""
    own, found = eight().figures["server"]["margins"], by_name(eight(), EIGHT)
    assert found[TUBE].margin <= EIGHT.mission.tube_m * (1.0 - own["tube"]) + 1e-6
    assert found[ACCEPTED].margin == pytest.approx(EIGHT.link.join_s * (1.0 - own["join"]))


def test_a_recording_gives_the_same(tmp_path: Path) -> None:
    file = tmp_path / "swap.mcap"
    Flight(EIGHT, eight(), name="swap").save(file)
    assert hypotheses(Flight.load(file).record, EIGHT) == hypotheses(eight(), EIGHT)


def test_over_udp_flows_are_of_no_known_vehicle_and_no_waits_are_given() -> None:
    at_address = [
        each._replace(event=msgspec.structs.replace(each.event, host="127.0.0.1"))
        if isinstance(each.event, FlowOpened)
        else each
        for each in eight().events
    ]
    found = judged(replace(eight(), events=tuple(at_address)), EIGHT)
    assert found.waits == ()
    assert found.hypotheses == hypotheses(eight(), EIGHT)


def test_a_report_and_the_page_of_a_recording_have_the_table(tmp_path: Path) -> None:
    file = tmp_path / "swap.mcap"
    Flight(EIGHT, eight(), name="swap").save(file)
    recorded = recordings.opened(file)
    for html in (report.page(recorded, []), replay.theorem_html(recorded)):
        assert "each stays in its tube" in html
        assert "0.129 m" in html


def test_what_is_flown_after_the_recorded_horizon_is_not_checked() -> None:
    short = packaged("swap", duration=20.0, reference={"shape": "swap(8)"})
    record = flight.fly(short, vehicles=8)
    assert record.client.tobytes() == eight().client.tobytes()
    assert by_name(record, short)[TUBE].checked == pytest.approx(0.741, abs=1e-3)
    assert by_name(replace(record, plan=record.plan[:0]), short)[TUBE].is_held is None


def test_each_motion_begins_as_the_one_before_it_goes_on() -> None:
    """Motions are restored from their inputs: in their first second two of them are the same."""
    for each in flown(EIGHT, eight()):
        known, kept = each.motions, FOUR.terms().join
        taken = np.isin(known.step, each.in_force).nonzero()[0].tolist()
        for one, other in pairwise(taken):
            since = known.step[other] - known.step[one]
            stages = np.arange(since, since + kept + 1).clip(0, known.recorded)
            off = known.position[one][stages] - known.position[other][: kept + 1]
            assert np.abs(off).max() < 1e-3


@given(st.data())
def test_a_vehicle_beside_its_motion_is_found(data: st.DataObject) -> None:
    client = eight().client.copy()
    flying_rows = np.flatnonzero(client["in_force"] >= 0)
    row = int(data.draw(st.sampled_from(flying_rows.tolist())))
    off_m = data.draw(st.floats(2.1 * EIGHT.mission.tube_m, 9.0))
    client["state"][row, 0, 0] += off_m
    found = by_name(replace(eight(), client=client), EIGHT)[TUBE]
    assert found.is_held is False
    assert (found.vehicles, found.step) == ((client["vehicle"][row],), client["step"][row])
    assert found.margin == pytest.approx(-off_m, abs=2.0 * EIGHT.mission.tube_m)


def test_a_tube_that_is_too_narrow_is_found_as_the_server_finds_it() -> None:
    narrow = packaged(
        "swap", duration=12.0, reference={"shape": "swap(4)"}, mission={"tube_m": 0.03}
    )
    record = flight.fly(narrow, vehicles=4)
    assert TUBE in broken(hypotheses(record, narrow))
    assert any(isinstance(each.event, LeftTube) for each in record.events)


def test_a_vehicle_that_accepts_a_motion_too_late_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ablation: it adopts motions at any time, over a network with delays above `link.join_s`."""
    real: Callable[..., None] = Compensator.__init__

    def careless(self: Compensator, *args: Any) -> None:
        real(self, *args)
        self._join = 0

    late = packaged(
        "swap",
        duration=12.0,
        reference={"shape": "swap(4)"},
        network={"uplink": "constant(1.3)", "downlink": "constant(1.3)"},
    )
    assert ACCEPTED not in broken(hypotheses(flight.fly(late, vehicles=4), late))
    monkeypatch.setattr(Compensator, "__init__", careless)
    record = flight.fly(late, vehicles=4)
    found = by_name(record, late)[ACCEPTED]
    assert found.margin == pytest.approx(-0.3, abs=0.1)
    assert record.figures["server"]["counts"]["joined_late"]


def test_a_vehicle_that_leaves_its_motion_is_found() -> None:
    record = flight.fly(FOUR, vehicles=4, changes=[(6.0, {"armed": False})])
    found = by_name(record, FOUR)[TO_THE_END]
    assert found.is_held is False
    (left, *_) = (each.event for each in record.events if isinstance(each.event, LeftMotion))
    assert -found.margin == pytest.approx(left.left_s, abs=1.0)


def test_a_step_that_begins_too_late_is_found() -> None:
    host = f"client {FOUR.seed}.2"
    actions = [(5.0, lambda world: world.freeze(host)), (5.32, lambda world: world.thaw(host))]
    found = by_name(flight.fly(FOUR, vehicles=4, actions=actions), FOUR)[IN_TIME]
    assert found.vehicles == (2,)
    assert -0.22 <= found.margin < -0.17
    assert found.step is not None


def test_a_vehicle_that_the_server_has_not_observed_is_found() -> None:
    server = eight().server
    found = by_name(replace(eight(), server=server[server["vehicle"] != 3]), EIGHT)[ALL]
    assert found.is_held is False
    assert found.vehicles == (3,)


def test_vehicles_that_are_too_near_are_found() -> None:
    wide = packaged(
        "swap", duration=20.0, reference={"shape": "swap(8)"}, mission={"separation_m": 0.98}
    )
    assert broken(hypotheses(eight(), wide)) == ["they keep apart"]


def test_a_vehicle_in_a_zone_is_found() -> None:
    """A zone of which the server did not know."""
    walled = packaged(
        "swap",
        duration=20.0,
        reference={"shape": "swap(8)"},
        mission={"zones": "cylinder(0, 0, 1.5)"},
    )
    assert "they keep out of zones" not in by_name(eight(), EIGHT)
    assert broken(hypotheses(eight(), walled)) == ["they keep out of zones"]
    found = by_name(eight(), walled)["they keep out of zones"]
    assert -1.5 <= found.margin < -0.5


# -- waits -----------------------------------------------------------------------------------------


def waits(kind: str, vehicles: int, duration: float, **keys: Any) -> list[Wait]:
    reference = {"shape": f"swap({vehicles})"}
    scenario = packaged("swap", duration=duration, reference=reference, **keys)
    outcome = flying.fly(FlightCase(scenario, vehicles))
    assert outcome.judgement is not None
    assert str(outcome.judgement)
    return [each for each in outcome.judgement.waits if each.kind == kind]


def test_motions_that_are_lost_are_what_a_vehicle_waits_for() -> None:
    outage = {"uplink": "constant(0.05) & outage(6, 2)", "downlink": "constant(0.05)"}
    found = waits("acknowledgement", 4, 14.0, network=outage)
    lost = [each for each in found if each.lost]
    assert {each.vehicle for each in lost} == {1, 2, 3, 4}
    assert all(each.plans[0] for each in found)
    for each in lost:
        assert each.reports[1] == 0
        assert 6.0 < each.start_s < 9.0
        assert each.for_s > 1.0
    usual = [each.for_s for each in found if not each.lost]
    assert max(usual) == pytest.approx(0.15, abs=0.06)


def test_all_wait_for_the_last_to_begin() -> None:
    found = waits("to begin", 4, 14.0)
    assert len({each.other for each in found}) == 1
    (last,) = {each.other for each in found}
    assert {each.vehicle for each in found} <= {1, 2, 3, 4} - {last}
    assert len({round(each.end_s, 6) for each in found}) == 1


def test_the_server_says_who_is_in_the_way() -> None:
    lossy = {"uplink": "paper(0.4, 0.02, 2.0) & loss(0.3)"}
    lossy["downlink"] = lossy["uplink"]
    found = waits("way", 16, 24.0, network=lossy)
    assert found
    assert all(each.other and each.other != each.vehicle for each in found)
    assert any(each.lost for each in found)


def test_the_explanation_of_a_mission_ends_with_both() -> None:
    known = Flight(FOUR, flight.fly(FOUR, vehicles=4), name="swap").explain()
    said = str(known)
    assert "  2          each stays in its tube           yes   " in said
    assert "  all for vehicle " in said
    written = msgspec.json.decode(known.to_json())
    assert len(written["judgement"]["hypotheses"]) == 9
    assert written["judgement"]["waits"][0]["kind"] in ("to begin", "acknowledgement")


def test_a_recorded_mission_over_udp_is_judged_without_another_flight(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "swap.mcap"
    Flight(EIGHT, eight(), name="swap").save(file)
    recorded = recordings.opened(file)
    about = msgspec.structs.replace(recorded.about, began="2026-11-29T22:00:00Z")
    monkeypatch.setattr(recordings, "opened", lambda _: replace(recorded, about=about))
    assert main(["explain", str(file)]) == 0
    said = capsys.readouterr().out
    assert "each stays in its tube           yes   0.129 m  8           222" in said
    assert main(["explain", str(file), "--seeds", "3"]) == 2
    assert "--seeds: got it with a flight over UDP" in capsys.readouterr().err


def test_asking_changes_nothing_in_a_flight_and_each_plan_has_its_packet() -> None:
    outcome = flying.fly(FlightCase(EIGHT, 8))
    assert outcome.trace == trace_hash(eight().client)
    assert outcome.packets.is_plan.sum() == eight().server["event"].sum()
