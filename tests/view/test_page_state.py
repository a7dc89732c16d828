"""State of a page: values of a flight in virtual time, and bounds."""

import re
from dataclasses import dataclass
from functools import cache
from html import unescape
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from skytether.figures.colours import MODE_COLOURS
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Changed, Event, ModeChanged
from skytether.shared.scenario import reading
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.feed import FeedError, Figures, Frame, Opened, Rows, Said, described
from skytether.shared.telemetry.record import (
    DOWNLINK,
    PACKET_COLUMNS,
    UPLINK,
    Reason,
    Record,
    client_columns,
)
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire.protocol import Mode
from skytether.sim import flight
from skytether.view.frames import of_flight
from skytether.view.page import changes, plots, scene, words
from skytether.view.page.changes import Mark
from skytether.view.page.network import BINS, DELAY_BINS, SPAN_S
from skytether.view.page.state import SAID_MAX, SLOTS_MAX, VEHICLES_MAX, State
from skytether.view.rows import planned


@dataclass(frozen=True)
class Shown:
    scenario: Scenario
    flown: Record
    frames: tuple[tuple[int, str, Frame], ...]
    state: State

    @property
    def now_ns(self) -> int:
        """Time of its last frame, plus a bin of the network."""
        return self.state.newest_ns + SECOND_NS // 4


@cache
def demo(
    cut_s: float = 0.0, vehicles: int = 1, name: str = "demo-committed", duration_s: float = 12.0
) -> Shown:
    """Some seconds of the demo with plans of inputs, whose link may be cut."""
    scenario = msgspec.structs.replace(reading.load(name), duration=duration_s, settle=0.0)
    lost = {"network.uplink.loss": 1.0, "network.downlink.loss": 1.0}
    changes = [(cut_s, lost)] if cut_s else []
    flown = flight.fly(scenario, vehicles=vehicles, changes=changes)
    frames = tuple(of_flight(scenario, "demo", flown))
    return Shown(scenario, flown, frames, state_of(frames))


def brief() -> Shown:
    """A second of the demo, for tests of words that need a vehicle."""
    return demo(duration_s=1.0)


def state_of(frames: tuple[tuple[int, str, Frame], ...]) -> State:
    state = State()
    for _, process, frame in frames:
        state.take(process, frame)
    return state


def shown_of(state: State, vehicle: int, now_ns: int, title: str = "") -> str:
    """All words about a vehicle."""
    given = state, vehicle, now_ns, title
    return words.status(*given) + words.figures(*given)


def test_the_curves_of_a_vehicle_are_its_record() -> None:
    shown = demo()
    track, client, server = shown.state.vehicles[1], shown.flown.client, shown.flown.server
    dt = shown.scenario.control.dt
    curves = track.curves(1201)  # a grid of the steps themselves
    assert track.time_s == pytest.approx(client["step"][-1] * dt, abs=dt)
    steps = np.round(curves.time_s / dt).astype(int)
    both, here, there = np.intersect1d(steps, server["step"], return_indices=True)
    here, there = here[both >= 100], there[both >= 100]
    assert len(here) > 100
    flown, planned = client[np.searchsorted(client["step"], steps[here])], server[there]
    np.testing.assert_array_equal(flown["step"], planned["step"])
    np.testing.assert_allclose(curves.position[here], flown["state"][..., 0])
    np.testing.assert_allclose(curves.reference[here], planned["reference"][..., 0])
    np.testing.assert_array_equal(curves.figure[here], planned["cost_gap"])
    np.testing.assert_array_equal(curves.threshold[here], planned["threshold"])
    aged = flown["age_ns"] >= 0
    np.testing.assert_array_equal(curves.age_s[here][aged], flown["age_ns"][aged] / SECOND_NS)
    summary = summarise(shown.scenario, "demo", client, server)
    assert track.sent == (summary.uplink_above, summary.uplink_due)
    assert sum(track.sent) == server["event"].sum()
    text = unescape(re.sub("<[^>]*>", " ", shown_of(shown.state, 1, shown.now_ns)))
    found = re.search(r"plans sent\D*(\d+)\D*(\d+)", text)
    assert found is not None
    assert tuple(map(int, found.groups())) == track.sent


def test_a_cut_link_is_a_gap_in_all_that_nobody_knows_meanwhile() -> None:
    """In age and reference, from the moment the texts show a dash; the vehicle is still shown."""
    shown = demo(cut_s=6.0)
    track, client, server = shown.state.vehicles[1], shown.flown.client, shown.flown.server
    curves, dt = track.curves(1201), shown.scenario.control.dt  # a grid of the steps themselves
    steps = np.round(curves.time_s / dt).astype(int)
    aged = {int(row["step"]) for row in client if row["age_ns"] >= 0}
    planned = {int(row["step"]) for row in server}
    flown = range(int(client["step"][-1]) + 1)
    assert max(aged) < flown[-1] - 30
    assert max(planned) < flown[-1] - 30
    for step, age_s, goal, position in zip(
        steps.tolist(), curves.age_s, curves.reference[:, 0], curves.position[:, 0], strict=True
    ):
        assert np.isnan(age_s) == (step not in aged), step
        assert np.isnan(goal) == (step not in planned), step
        assert np.isnan(position) == (step not in flown), step
    assert np.isnan(track.age_s)
    assert track.goal(1.0) is None
    assert track.goal(SPAN_S) is not None
    look = plots.Look(shown.state, curves, shown.now_ns)
    for direction in (UPLINK, DOWNLINK):
        delays_s = plots._delays(direction)(look)
        assert np.isnan(delays_s[-40:]).all()
        assert not np.isnan(delays_s[-200:-170]).any()


@pytest.mark.parametrize("cut_s", [0.0, 5.0])
def test_state_link_and_error_of_the_last_minute_are_those_of_each_moment(cut_s: float) -> None:
    """The newest colours are those of the words; before a cut they are those before it."""
    shown = demo(cut_s=cut_s)
    track, now_ns = shown.state.vehicles[1], shown.now_ns
    curves = track.curves(plots.POINTS)
    links = shown.state.links(curves, now_ns)
    assert links[-1] == shown.state.link(1, now_ns).colour
    assert curves.mode[-1] == track.mode
    known = links[~np.isnan(curves.mode) & (curves.mode > Mode.INIT)]
    assert "" not in known
    if cut_s:
        before = (curves.time_s > 4.0) & (curves.time_s < cut_s)
        assert set(links[before]) <= {"green", "amber"}
        assert set(links[curves.time_s > 9.0]) == {"red"}
        assert (curves.mode[before] == Mode.TRACK).all()
    error_m = curves.error_m[~np.isnan(curves.error_m)]
    assert np.sqrt((error_m**2).mean()) == pytest.approx(track.error_m(60.0), rel=0.1)


def test_plots_share_a_time_axis_and_mark_what_was_changed() -> None:
    shown = demo(cut_s=5.0)
    look = plots.Look(shown.state, shown.state.vehicles[1].curves(400), shown.now_ns, 1)
    timed = [
        [plot.grid(look), *(line.values(look) for line in plot.lines)]
        for plot in (*plots.of_flight(), *plots.more(2, solves=False))
        if plot.timed
    ]
    assert len({len(data[0]) for data in timed}) > 1
    together = plots.on_one_axis(timed)
    for data in together:
        np.testing.assert_array_equal(data[0], together[0][0])
        lines = dict(zip(plots.MARKS, plots.marked(data, shown.state.marks), strict=True))
        at = np.flatnonzero(~np.isnan(lines[Mark.CUT]))
        assert data[0][at] == pytest.approx(shown.state.marks[-1][0], abs=0.2)
        assert np.isnan(lines[Mark.HEALED]).all()
        assert lines[Mark.CUT][at].tolist() == [np.nanmin(data[1:]), np.nanmax(data[1:])]
    old = [(-3.0, Mark.CUT), (1e6, Mark.HEALED)]
    assert np.isnan(plots.marked(together[0], old)).all()


def test_packets_are_plotted_as_a_rate_both_ways() -> None:
    """At every step a line at the top, and none before the flight."""
    shown = demo()
    look = plots.Look(shown.state, shown.state.vehicles[1].curves(400), shown.now_ns)
    (packets,) = (each for each in plots.of_flight() if each.title == "Packets in a second")
    every_step, up, down = (line.values(look) for line in packets.lines)
    seconds = packets.grid(look)
    assert set(every_step) == {20.0}
    for direction, rates in ((UPLINK, up), (DOWNLINK, down)):
        known = ~np.isnan(rates)
        assert (known == (seconds > -1.0)).all()
        assert rates[known].sum() == (shown.flown.netem["direction"] == direction).sum()
    colours = {line.rgb for line in packets.lines}
    assert len(colours) == 3


def test_a_flight_longer_than_the_servers_scenario_is_as_long_as_the_clients() -> None:
    scenario = reading.load("demo")
    longer = msgspec.structs.replace(scenario, duration=60.0)
    state = State()
    for process, flown in (("server", scenario), ("client", longer), ("netem", scenario)):
        state.take(process, opened(process, {}, flown))
    assert state.duration_s == 60.0


@pytest.mark.parametrize("is_here", [True, False])
def test_a_mission_whose_table_is_on_another_machine_is_shown(is_here: bool) -> None:
    """If the table is on this machine, the map shows all of its places."""
    mission = reading.load("warehouse")
    if not is_here:
        away = msgspec.structs.replace(mission.reference, file="/nowhere/warehouse.csv")
        mission = msgspec.structs.replace(mission, reference=away)
    state = State()
    state.take("client", opened("client", {}, mission))
    assert state.name
    assert (scene.extent([state.scenario])[1] > 1.0) == is_here


def test_the_error_is_that_of_the_record() -> None:
    shown = demo()
    away = (
        shown.flown.client["state"][-100:, :, 0]
        - shown.scenario.make_reference()(
            shown.flown.client["step"][-100:] * shown.scenario.control.dt
        )[..., 0]
    )
    assert shown.state.vehicles[1].error_m(5.0) == pytest.approx(
        float(np.sqrt((away**2).sum(axis=1).mean())), rel=0.05
    )


def test_the_plan_leads_on_from_where_the_vehicle_is() -> None:
    shown = demo()
    track = shown.state.vehicles[1]
    ahead = track.ahead()
    assert len(ahead) > 20
    steps = np.linalg.norm(np.diff(ahead, axis=0), axis=1)
    fastest = np.linalg.norm(shown.scenario.u_max) * shown.scenario.control.dt
    assert steps.max() <= fastest * 1.001
    assert np.linalg.norm(ahead[0] - track.trail()[-1]) < 1.0
    newest = shown.flown.plan[-1]
    assert newest["disturbance"].any()
    np.testing.assert_array_equal(ahead, planned(shown.scenario, newest)[-len(ahead) :])


@pytest.mark.parametrize(("name", "least"), [("demo-committed", 320), ("demo", 50)])
def test_loss_and_rates_are_those_of_the_packets(name: str, least: int) -> None:
    """Counted in bins, they equal netem's record; packets with a plan are the long ones."""
    shown = demo(name=name)
    packets, network = shown.flown.netem, shown.state.network
    for direction in (UPLINK, DOWNLINK):
        own = packets[packets["direction"] == direction]
        assert network.rates(direction, shown.now_ns).sum() == len(own)
        assert network.histogram(direction, shown.now_ns).sum() == (~own["lost"]).sum()
        last = own[
            np.maximum.accumulate(packets["arrived_ns"])[packets["direction"] == direction]
            >= (shown.now_ns // (SECOND_NS // 4) - 40) * SECOND_NS // 4
        ]
        traffic = network.traffic(direction, 10.0, shown.now_ns)
        assert traffic.loss == pytest.approx(last["lost"].mean())
        assert traffic.bytes_per_s == pytest.approx(last["bytes"].sum() / 10.0)
        through_ms = own["delay_ns"][~own["lost"]] / 1e6
        assert network.traffic(direction, 60.0, shown.now_ns).delay_ms_p50 == pytest.approx(
            float(np.median(through_ms)), abs=20.0
        )
    up = packets[(packets["direction"] == UPLINK) & (packets["bytes"] >= least)]
    assert network.horizon_bytes(shown.now_ns) == pytest.approx(up["bytes"].mean())
    assert shown.state.every_step == 20.0


def test_a_cut_link_is_said_in_words_and_colour() -> None:
    shown = demo(cut_s=5.0)
    state, number = shown.state, 1
    assert state.link(number, shown.now_ns).word == "CUT"
    assert state.link(number, shown.now_ns).colour == "red"
    does = state.vehicles[number].does
    assert (does.word, does.colour) == ("HOVER", "blue")
    assert does.text == f"hovers: {Reason.LOST}"
    said = [each.text for each in state.said]
    assert f"vehicle 1 brakes: {Reason.LOST}" in said
    assert said.index(f"vehicle 1 brakes: {Reason.LOST}") < said.index(
        f"vehicle 1 hovers: {Reason.LOST}"
    )
    assert len(state.vehicles[number].ahead()) == 0, "a plan is drawn that nobody flies"
    page = shown_of(state, number, shown.now_ns)
    assert "HOVER" in page
    assert "link cut" in page
    good = demo()
    assert good.state.link(1, good.now_ns).word == "GOOD"
    assert good.state.vehicles[1].mode is Mode.TRACK


PAPER = "paper(0.4, 0.02, 2.0) & loss(0.1)"


def turned(key: str, before: object, after: object) -> Changed:
    return Changed(
        key=key,
        before=msgspec.json.encode(before).decode(),
        after=msgspec.json.encode(after).decode(),
    )


@pytest.mark.parametrize(
    ("key", "before", "after", "said"),
    [
        ("network.uplink", PAPER, PAPER.replace("0.1", "0.3"), "Loss 10 → 30 %"),
        ("network.uplink", PAPER, "paper(0.5, 0.02, 2) & loss(0.1)", "Delay 400 → 500 ms"),
        (
            "network.uplink",
            PAPER,
            f"{PAPER} & rate(5000)",
            "network.uplink nothing → rate(5000)",
        ),
        ("network.uplink", PAPER, f"{PAPER} & loss(1)", str(Mark.CUT.value)),
        ("network.uplink", f"{PAPER} & loss(1)", PAPER, str(Mark.HEALED.value)),
        ("vehicle.steady_wind_mps", [], [0.2, 0.0], "Steady wind x 0 → 0.2 m/s"),
        ("control.trigger", "cost_gap | silence(1)", "always", "cost_gap | silence(1) → always"),
        ("control.trigger", "periodic", "periodic(3)", "10 → 3"),
        ("armed", True, False, "armed true → false"),
        ("of another version", "a(", 3, "a( → 3"),
        ("network.uplink", "unknown(3) & loss(0.1)", "unknown(3) & loss(0.2)", "loss(0.2)"),
    ],
)
def test_a_change_is_told_by_what_differs(key: str, before: Any, after: Any, said: str) -> None:
    text = changes.in_words(turned(key, before, after))
    assert said.lower() in text.lower()
    assert len(text) < 60


def changing(*told: tuple[float, str, Event]) -> State:
    """State of a flight that hears of events at times of flight [s] from processes."""
    state = state_of(brief().frames)
    state.said.clear()
    begin_ns = state.newest_ns
    for time_s, process, event in told:
        state.take(process, Said(time_ns=begin_ns + round(time_s * SECOND_NS), event=event))
    return state


def test_a_dragged_slider_is_one_change_of_both_directions() -> None:
    steps = list(pairwise((PAPER, PAPER.replace("0.1", "0.2"), PAPER.replace("0.1", "0.3"))))
    both = [
        (0.1 * k + 1.0, "netem", turned(way, *step))
        for k, step in enumerate(steps)
        for way in changes.DIRECTIONS
    ]
    state = changing(*both)
    assert [each.text for each in state.said] == ["Loss 10 → 30 %"]
    assert [marked for _, marked in state.marks] == [Mark.CHANGED]
    later = (9.0, "netem", turned("network.uplink", PAPER, PAPER.replace("0.1", "0.4")))
    assert [each.text for each in changing(*both, later).said][1:] == ["Loss 10 → 40 % (up)"]
    back = [(1.5, "netem", turned(way, steps[-1][1], PAPER)) for way in changes.DIRECTIONS]
    undone = [each.text for each in changing(*both, *back).said]
    assert undone == ["Loss 10 → 30 %", "Loss 30 → 10 %"]


def test_the_path_that_is_cut_alone_is_named() -> None:
    state = changing()
    second = opened("netem", {"netem": PACKET_COLUMNS})
    state.take("netem 2", msgspec.structs.replace(second, time_ns=1))
    for way in changes.DIRECTIONS:
        event = turned(way, PAPER, f"{PAPER} & loss(1)")
        state.take("netem 2", Said(time_ns=state.newest_ns + 1, event=event))
    assert [each.text for each in state.said] == ["Link cut (path 2)"]
    assert state.marks[-1][1] is Mark.CUT


def test_events_that_repeat_are_counted_and_leave_room_for_others() -> None:
    brakes = ModeChanged(vehicle=1, before="track", after="brake", reason="it woke too late")
    flies = ModeChanged(vehicle=1, before="brake", after="track", reason="a horizon has come")
    lands = ModeChanged(vehicle=1, before="track", after="land", reason="its battery is low")
    events = [lands, *[brakes, flies] * 5]
    state = changing(*((float(k), "client", event) for k, event in enumerate(events)))
    assert [each.count for each in state.said] == [1, 5, 5]
    assert state.said[-1].time_s - state.said[0].time_s == pytest.approx(10.0)
    assert "×5" in words.said([("", state)])
    apart_ = changing((0.0, "client", brakes), (100.0, "client", brakes))
    assert [each.count for each in apart_.said] == [1, 1]


def test_an_autopilot_s_mode_battery_and_home_are_shown_where_they_are_told() -> None:
    shown = brief()
    state, number = state_of(shown.frames), 1
    assert "autopilot" not in shown_of(state, number, shown.now_ns)
    home = {"latitude_deg": 47.5, "longitude_deg": 8.25}
    told = {"mode": "GUIDED", "armed": 1, "battery": 0.83, "voltage_v": 15.14, "home": home}
    for autopilot, said in (
        (told, ("GUIDED, armed", "83 %, 15.1 V", "47.500000°, 8.250000°")),
        ({"mode": "<b>", "battery": "full", "home": 3}, ("&lt;b&gt;, disarmed", "–, –")),
    ):
        figures = {"by_vehicle": {"1": {"autopilot": autopilot}}}
        state.take("client", Figures(time_ns=shown.now_ns, figures=figures))
        page = shown_of(state, number, shown.now_ns)
        assert all(each in page for each in said)


def test_the_server_that_leads_is_shown_if_there_is_a_standby() -> None:
    now_ns, state = brief().now_ns, state_of(brief().frames)
    assert "led by" not in shown_of(state, 1, now_ns)
    for told, said in (
        ({"number": 3, "server": "b:47001"}, "b:47001, leadership 3"),
        ({"number": "x", "server": "<b>"}, "&lt;b&gt;, leadership –"),
    ):
        figures = {"by_vehicle": {"1": {"leadership": told}}}
        state.take("client", Figures(time_ns=now_ns, figures=figures))
        assert said in shown_of(state, 1, now_ns)


def test_a_mission_s_zones_waits_and_distances_are_shown() -> None:
    scenario = reading.load("swap")
    shape = msgspec.structs.replace(scenario.reference, shape="swap(4)")
    scenario = msgspec.structs.replace(scenario, duration=13.0, settle=0.0, reference=shape)
    zone = "cylinder(6, 6, 1) & fence(-9, 9, -9, 9)"
    flown = flight.fly(scenario, vehicles=4, changes=[(9.0, {"mission.zones": zone})])
    state = state_of(tuple(of_flight(scenario, "swap", flown)))
    assert state.zones == zone
    assert len(state.kept.zones) == 2
    drawn = scene.zones(state.kept, 5.0)
    assert np.abs(drawn).max() == pytest.approx(9.0)
    last = np.stack([track.row["state"][:, 0] for track in state.vehicles.values()])
    away = np.linalg.norm(last[1:] - last[0], axis=1).min()
    first = next(iter(state.vehicles))
    assert state.nearest_m(first) == pytest.approx(away)
    assert state.nearest_m(first, 400)[-1] == pytest.approx(away)
    assert np.nanmin(state.nearest_m(first, 400)) > scenario.mission.separation_m
    assert np.isnan(state.nearest_m(9)).all()
    page = shown_of(state, first, state.newest_ns)
    assert f"{away:.2f} m, at least 0.5 m" in page
    state.take("server", Figures(time_ns=0, figures={"by_vehicle": {"1": {"waits": "vehicle 3"}}}))
    assert "vehicle 3" in shown_of(state, 1, state.newest_ns)
    assert "errors of plug-ins" not in shown_of(state, 1, state.newest_ns)
    failed = {"counts": {"trigger_errors": 3}}
    state.take("server", Figures(time_ns=0, figures=failed))
    assert "trigger 3" in shown_of(state, 1, state.newest_ns)
    known = {"clock_bound_ms": 412.3, "clock_m": 0.487}
    state.take("server", Figures(time_ns=0, figures={"by_vehicle": {"1": known}}))
    assert "412 ms, 0.49 m" in shown_of(state, 1, state.newest_ns)


def test_a_mission_s_motions_that_may_be_flown_are_shown() -> None:
    """The one in force, and one sent since; not one that arrived too late."""
    scenario = reading.load("swap")
    shape = msgspec.structs.replace(scenario.reference, shape="swap(2)")
    scenario = msgspec.structs.replace(scenario, duration=6.0, settle=1.0, reference=shape)
    flown = flight.fly(scenario, vehicles=2)
    on_the_way = (each for each in of_flight(scenario, "swap", flown) if each[0] < 6 * SECOND_NS)
    state = state_of(tuple(on_the_way))
    track = next(iter(state.vehicles.values()))
    ways = track.motions()
    assert len(ways) in (1, 2)
    for way in ways:
        assert np.linalg.norm(way[0] - track.row["state"][:, 0]) < scenario.mission.tube_m
    newest = flown.plan[flown.plan["vehicle"] == track.number][-1:].copy()
    join = round(scenario.link.join_s / scenario.control.dt)
    track.row["in_force"] = 0
    for ago, shown in ((join, 1), (join + 1, 0)):
        newest["begins"] = track.row["step"] - ago
        for _ in range(8):  # copies are one motion
            track.lead(newest)
        assert len(track.motions()) == shown


def apart(*names: str, vehicles: int = 3) -> State:
    """State of a flight whose vehicles have clients of their own, with feeds of these names."""
    shown = demo(vehicles=vehicles, duration_s=3.0)
    clients = dict(enumerate((name for name in names if name.startswith("client")), start=1))
    state = State()
    for _, process, frame in shown.frames:
        if process != "client" and process in names:
            state.take(process, frame)
        for number, name in clients.items() if process == "client" else ():
            if isinstance(frame, Opened):
                state.take(name, msgspec.structs.replace(frame, time_ns=number))
            elif isinstance(frame, Rows):
                rows = np.frombuffer(frame.rows, client_columns(2))
                own = rows[rows["vehicle"] == number].tobytes()
                state.take(name, msgspec.structs.replace(frame, rows=own))
    return state


def test_vehicles_with_clients_of_their_own_are_all_shown() -> None:
    state = apart("server", "netem", "client-1", "client-2", "client-3")
    assert not state.missing
    assert {number: each.client for number, each in state.vehicles.items()} == {
        number: f"client-{number}" for number in (1, 2, 3)
    }
    now_ns = demo(vehicles=3, duration_s=3.0).now_ns
    assert {state.link(number, now_ns).word for number in (1, 2, 3)} == {"GOOD"}
    for name, armed in (("client-1", 1), ("client-3", 0)):
        number = name.rpartition("-")[2]
        figures = {"by_vehicle": {number: {"autopilot": {"mode": name, "armed": armed}}}}
        state.take(name, Figures(time_ns=now_ns, figures=figures))
    assert "client-3, disarmed" in words.figures(state, 3, now_ns)
    assert "client-1, armed" in words.figures(state, 1, now_ns)
    assert "autopilot" not in words.figures(state, 2, now_ns)


def test_one_of_several_clients_that_begins_anew_is_no_new_flight() -> None:
    state = apart("server", "netem", "client-1", "client-2", "client-3")
    again = msgspec.structs.replace(opened("client", {"client": client_columns(2)}), time_ns=10**12)
    state.lose("client-2")
    state.take("client-2", again)
    assert (state.flights, sorted(state.vehicles)) == (1, [1, 2, 3])
    state.lose("client-1")
    state.lose("client-3")
    state.take("client-2", msgspec.structs.replace(again, time_ns=10**12 + 1))
    assert (state.flights, sorted(state.vehicles)) == (2, [])


def test_what_nobody_tells_of_is_named() -> None:
    now_ns = demo(vehicles=3, duration_s=3.0).now_ns
    state = apart("server", "netem", "client-1", "client-2")
    assert state.missing == ("vehicle 3's client",)
    assert "vehicle 3&#x27;s client" in words.status(state, 1, now_ns)
    assert state.link(3, now_ns).word == "UNKNOWN"
    assert apart("server", "netem").missing == ("a client",)
    assert apart("client-1", "netem").missing == ("a server",)
    assert not apart("netem").missing
    assert "no feed" not in words.status(demo().state, 1, demo().now_ns)


def test_figures_are_those_of_the_server_that_plans() -> None:
    state = state_of(brief().frames)
    plans = [frame for _, process, frame in brief().frames if process == "server"]
    for name, waits in (("server", "the old one"), ("server 2", "the new one")):
        if name == "server 2":
            for frame in plans:
                state.take(name, frame)
        figures = {"by_vehicle": {"1": {"waits": waits}}}
        state.take(name, Figures(time_ns=state.newest_ns + 1, figures=figures))
    assert state.waits(1) == "the new one"


def test_what_comes_again_counts_once() -> None:
    """A feed repeats its newest frames to a new reader."""
    shown = demo()
    state = state_of(shown.frames)
    for _, process, frame in shown.frames:
        state.take(process, frame)
    assert state.network.rates(UPLINK, shown.now_ns).sum() == (
        shown.state.network.rates(UPLINK, shown.now_ns).sum()
    )
    assert list(state.said) == list(shown.state.said)
    assert state.flights == 1


def test_another_flight_of_the_same_processes_begins_anew() -> None:
    shown = brief()
    state = state_of(shown.frames)
    opened = next(frame for _, process, frame in shown.frames if process == "client")
    assert isinstance(opened, Opened)
    state.take("client", msgspec.structs.replace(opened, time_ns=opened.time_ns + 1))
    assert state.flights == 2
    assert not state.vehicles
    assert not state.said


def test_several_vehicles_are_shown_and_no_more_than_a_bound() -> None:
    assert sorted(demo(vehicles=3, duration_s=1.0).state.vehicles) == [1, 2, 3]
    state = State()
    columns = client_columns(2)
    rows = np.zeros(100, columns)
    rows["vehicle"] = np.arange(100)
    state.take("client", opened("client", {"client": columns}))
    state.take("client", Rows(part="client", time_ns=1, rows=rows.tobytes()))
    assert len(state.vehicles) == VEHICLES_MAX
    assert state.omitted == 100 - VEHICLES_MAX


def opened(
    process: str, parts: dict[str, np.dtype[np.void]], scenario: Scenario | None = None
) -> Opened:
    return Opened(
        process=process,
        name="demo",
        scenario=to_toml(scenario or reading.load("demo")).decode(),
        parts=described(parts),
        wall_ns=0,
        time_ns=0,
    )


def test_a_day_takes_no_more_memory_than_a_minute() -> None:
    scenario = reading.load("demo")
    fast = msgspec.structs.replace(
        scenario, control=msgspec.structs.replace(scenario.control, dt=0.001)
    )
    state = State()
    columns = client_columns(2)
    state.take("client", opened("client", {"client": columns}, fast))
    state.take("netem", opened("netem", {"netem": PACKET_COLUMNS}, fast))
    for second in range(0, 86_400, 1500):
        rows = np.zeros(1000, columns)
        rows["vehicle"], rows["step"] = 1, second * 1000 + np.arange(1000)
        time_ns = (second + 1) * SECOND_NS
        state.take("client", Rows(part="client", time_ns=time_ns, rows=rows.tobytes()))
        packets = np.zeros(50, PACKET_COLUMNS)
        state.take("netem", Rows(part="netem", time_ns=time_ns, rows=packets.tobytes()))
        changed = ModeChanged(vehicle=1, before="track", after="brake", reason=str(second))
        state.take("client", Said(time_ns=time_ns, event=changed))
    track = state.vehicles[1]
    assert len(track.trail(86_400.0)) <= SLOTS_MAX
    assert len(state.said) == SAID_MAX
    assert state.network.histogram(UPLINK, state.newest_ns).shape == (DELAY_BINS,)
    assert state.network.rates(UPLINK, state.newest_ns).shape == (int(SPAN_S),)
    assert BINS == 240


def test_what_makes_no_sense_is_refused_and_changes_nothing() -> None:
    """A scenario of another version, an unknown mode, and columns of other axes."""
    shown = brief()
    state, newest_ns = state_of(shown.frames), shown.state.newest_ns
    does, trail = state.vehicles[1].does, state.vehicles[1].trail().tolist()
    columns = client_columns(2)
    rows = np.zeros(1, columns)
    rows["vehicle"], rows["step"], rows["mode"] = 1, 1000, 99
    other = opened("client", {"client": columns})
    for scenario in ("of = 'another version'", "no TOML", "a = " + "[" * 100_000):
        with pytest.raises(FeedError, match="got no scenario"):
            state.take("client", msgspec.structs.replace(other, scenario=scenario, time_ns=7))
    with pytest.raises(ValueError, match="client: mode: got 99"):
        state.take("client", Rows(part="client", time_ns=newest_ns + 1, rows=rows.tobytes()))
    assert (state.flights, state.vehicles[1].does) == (1, does)
    assert state.vehicles[1].trail().tolist() == trail


def test_a_part_with_columns_of_no_flight_is_left_out() -> None:
    state, columns = State(), client_columns(3)
    rows = np.zeros(1, columns)
    rows["vehicle"] = 1
    state.take("client", opened("client", {"client": columns}))
    state.take("client", Rows(part="client", time_ns=1, rows=rows.tobytes()))
    assert not state.vehicles


def test_rows_of_an_hour_ago_change_nothing() -> None:
    """The ring holds a minute, and the newest rows replace older ones."""
    state = State()
    columns = client_columns(2)
    state.take("client", opened("client", {"client": columns}))
    for step in (100_000, 5):
        rows = np.zeros(1, columns)
        rows["vehicle"], rows["step"], rows["state"] = 1, step, step
        state.take("client", Rows(part="client", time_ns=step + 1, rows=rows.tobytes()))
    assert state.vehicles[1].trail(86_400.0).tolist() == [[100_000.0, 100_000.0]]


def test_what_is_said_cannot_become_part_of_the_page() -> None:
    shown = brief()
    state = state_of(shown.frames)
    evil = ModeChanged(vehicle=1, before="track", after="brake", reason="<script>alert(1)</script>")
    state.take("client", Said(time_ns=state.newest_ns + 1, event=evil))
    assert "<script>" not in words.said([("<b>", state)])
    assert "&lt;script&gt;" in words.said([("", state)])
    assert "<script>" not in shown_of(state, 1, shown.now_ns, "<script>")


def test_it_says_how_old_what_the_server_knows_is() -> None:
    """A vehicle that reports rarely is shown at every step; plans use older observations."""
    shown = demo()
    track, newest = shown.state.vehicles[1], shown.flown.server[-1]
    behind = int(newest["step"] - newest["observed_step"])
    assert track.known_s == pytest.approx(behind * shown.scenario.control.dt)
    assert 0.3 < track.known_s < 2.0
    said = shown_of(shown.state, 1, shown.now_ns)
    assert f"age of observation at server</td><td>{track.known_s:.2f} s" in said
    assert not np.isnan(track.trail(5.0)).any()


def test_netem_alone_is_a_network_and_no_flight() -> None:
    frames = [frame for frame in demo().frames if frame[1] == "netem"]
    state = state_of(tuple(frames))
    assert not state.flies
    assert demo().state.flies
    now_ns = demo().now_ns
    figures = {"flows": 3, "uplink": {"queue": 7, "lost": 2}, "downlink": {"queue": "many"}}
    state.take("netem", Figures(time_ns=state.newest_ns, figures=figures))
    whole = demo().state.network
    for direction in (UPLINK, DOWNLINK):
        assert state.network.rates(direction, now_ns).sum() > 25
        loads = state.network.loads(direction, now_ns)
        assert np.array_equal(loads, whole.loads(direction, now_ns))
        losses = state.network.losses(direction, now_ns)
        assert 0.02 < np.nanmean(losses) < 0.3
    assert state.network.waiting(UPLINK, now_ns)[-1] == 7
    assert state.network.waiting(DOWNLINK, now_ns)[-1] == 0
    assert 12.0 < state.time_s(now_ns) < 15.0
    shown = shown_of(state, 1, now_ns)
    assert "no vehicle" not in shown
    assert "every step" not in shown
    assert "2 lost" in shown
    assert ">3<" in shown
    for plot in plots.of_link():
        look = plots.Look(state, demo().state.vehicles[1].curves(plots.POINTS), now_ns)
        assert {len(line.values(look)) for line in plot.lines} == {len(plot.grid(look))}


PATHS = {
    "server": [
        {"failure": 0.03, "delay_ms": 101.6, "loss": 0.02, "packets": 40, "first": 33, "copies": 1},
        {"failure": 0.21, "delay_ms": None, "loss": 0.05, "packets": 7, "first": 0, "copies": 0},
    ],
    "client": [
        {"failure": 0.04, "delay_ms": 99.2, "loss": 0.1, "packets": 38, "first": 31, "copies": 2},
        {"failure": 0.97, "delay_ms": None, "loss": 0.05, "packets": 12, "first": 4, "copies": 0},
    ],
}
PATHS_SHOWN = [
    ["", "path 1", "path 2"],
    ["state", "alive", "silent down"],
    ["fails up, down [%]", "3, 4", "21, 97"],
    ["round trip [ms]", "99", "–"],
    ["lost up, down [%]", "2, 10", "5, 5"],
    ["packets up, down", "40, 38", "7, 12"],
    ["first copies up, down", "31, 33", "4, 0"],
]


def cells(html: str) -> list[list[str]]:
    rows = (re.findall("<td[^>]*>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", html))
    return list(rows)


def with_paths(paths: dict[str, Any]) -> State:
    state = state_of(brief().frames)
    for process, told in paths.items():
        figures = {"by_vehicle": {"1": {"paths": told}}}
        state.take(process, Figures(time_ns=state.newest_ns + 1, figures=figures))
    return state


def test_each_path_of_several_has_a_column() -> None:
    shown = shown_of(with_paths(PATHS), 1, brief().now_ns)
    assert cells(shown)[-len(PATHS_SHOWN) :] == PATHS_SHOWN
    alone = shown_of(brief().state, 1, brief().now_ns)
    assert alone.count("<table") == 2
    assert "path 1" not in alone


@pytest.mark.parametrize("told", [None, "two", ["one", "two"], {"1": {}}, [{}] * 9])
def test_what_one_end_does_not_tell_of_a_path_is_a_dash(told: Any) -> None:
    shown = cells(shown_of(with_paths(PATHS | {"server": told}), 1, brief().now_ns))
    row = {name: values for name, *values in shown}
    assert row["packets up, down"][:2] == ["–, 38", "–, 12"]
    assert row["first copies up, down"][:2] == ["31, –", "4, –"]
    assert len(row["state"]) <= 4


def test_packets_of_all_netems_are_those_of_the_network() -> None:
    """Over UDP each path has a netem of its own."""
    frames = [
        (at_ns, f"netem{' 2' * (number % 2)}" if isinstance(frame, Rows) else process, frame)
        for number, (at_ns, process, frame) in enumerate(demo().frames)
        if process == "netem"
    ]
    state = State()
    for process in ("netem", "netem 2"):
        state.take(process, next(each for _, _, each in frames if isinstance(each, Opened)))
    for _, process, frame in frames:
        if not isinstance(frame, Opened):
            state.take(process, frame)
    for process, waiting in (("netem", 3), ("netem 2", 4)):
        figures = {way: {"queue": waiting} for way in ("uplink", "downlink")}
        state.take(process, Figures(time_ns=state.newest_ns, figures=figures))
    assert not state.flies
    for direction in (UPLINK, DOWNLINK):
        rates = state.network.rates(direction, demo().now_ns)
        assert np.array_equal(rates, demo().state.network.rates(direction, demo().now_ns))
        assert state.network.waiting(direction, demo().now_ns)[-1] == 7


def test_every_mode_has_a_colour() -> None:
    assert set(MODE_COLOURS) == set(Mode)
