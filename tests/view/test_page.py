"""The page without a browser: access, requests of sliders, and answers."""

import contextlib
import re
import socket
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import msgspec
import numpy as np
import pytest
import viser

from elements import Gui
from helpers import until
from skytether.cli import page_process
from skytether.cli.duel import DuelOptions, titles, together
from skytether.shared.endpoints.change import Answer, Running
from skytether.shared.events.flight import Changed
from skytether.shared.scenario import reading, registry, schema
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.feed import Opened, Said
from skytether.shell.commandline.command import CommandError
from skytether.sim import flight as virtual
from skytether.view.browser import panel, serve
from skytether.view.browser.access import Visitor, is_loopback, may_play
from skytether.view.browser.flight import PageFlight
from skytether.view.browser.page import stop
from skytether.view.browser.replay import Player
from skytether.view.frames import of_flight
from skytether.view.page import plots
from skytether.view.page.controls import (
    THRESHOLDS,
    TRIGGERS,
    applied,
    cut,
    healed,
    is_cut,
    knobs,
    triggers,
)
from skytether.view.page.scene import extent, fence, grid, home, quadrotor, segments
from skytether.view.page.state import Curves, State, VehicleTrack
from skytether.view.recordings.report import with_gaps

HERE = {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080"}


@pytest.mark.parametrize(
    ("host", "path", "headers", "token", "may"),
    [
        ("127.0.0.1", "/", HERE, "", True),
        ("127.0.0.1", "/", {"host": "localhost:8080", "origin": "http://localhost:8080"}, "", True),
        ("::1", "/", {"Host": "[::1]:8080", "Origin": "http://[::1]:8080"}, "", True),
        ("::ffff:127.0.0.1", "/", HERE, "", True),
        ("127.0.0.1", "/", {"Host": "127.0.0.1:8080"}, "", True),  # no browser
        # A stranger's page, in a browser on this machine.
        ("127.0.0.1", "/", HERE | {"Origin": "http://evil.example"}, "", False),
        ("127.0.0.1", "/", HERE | {"Origin": "null"}, "", False),
        # The same under a name that the stranger resolves to this machine.
        ("127.0.0.1", "/", {"Host": "evil.io:8080", "Origin": "http://evil.io:8080"}, "", False),
        ("127.0.0.1", "/", {"Host": "[", "Origin": "http://["}, "", False),
        ("127.0.0.1", "/", {}, "", False),
        ("192.0.2.7", "/", HERE, "", False),
        ("192.0.2.7", "/?token=", HERE, "", False),
        ("192.0.2.7", "/?token=secret", HERE, "secret", True),
        ("192.0.2.7", "/?token=Secret", HERE, "secret", False),
        ("192.0.2.7", "/", HERE, "secret", False),
        ("127.0.0.1", "/", HERE, "secret", True),
        ("", "", {}, "", False),  # viser gave no details
    ],
)
def test_only_this_machine_and_who_knows_the_token_may_play(
    host: str, path: str, headers: dict[str, str], token: str, *, may: bool
) -> None:
    assert may_play(Visitor(host, path, headers), token) is may


def test_a_name_that_only_looks_like_this_machine_is_none() -> None:
    for host in ("localhost.evil.example", "127.0.0.1.evil.example", "0.0.0.0", "::", ""):
        assert not is_loopback(host), host


def running(process: str, scenario: schema.Scenario) -> tuple[Running, dict[str, Any]]:
    """Endpoint of a process that can be changed, and its values."""
    from skytether.client.endpoint import Client
    from skytether.client.simulated.vehicle import simulated
    from skytether.netem.proxy import Proxy
    from skytether.server.endpoint import Server

    match process:
        case "server":
            endpoint: Any = Server(scenario, boot_id=1, entropy=bytes)
        case "netem":
            endpoint = Proxy(scenario, server=("server", 0), flows=1)
        case _:
            flies = simulated(scenario, 1)
            endpoint = Client(scenario, flies, server=("server", 0), vehicle=1, boot_id=1)
    runs = Running(endpoint, scenario)
    answer = msgspec.json.decode(runs.answer(b"{}", now_ns=0), type=Answer)
    return runs, answer.values


@pytest.mark.parametrize("axes", [2, 3])
def test_every_slider_asks_for_what_the_processes_take(axes: int) -> None:
    scenario = reading.load("demo")
    model = msgspec.structs.replace(scenario.model, axes=axes)
    control = msgspec.structs.replace(scenario.control, horizon=50)  # fits, for any delay
    trigger = "state_gap & cost_gap | expected_gap & deviation | periodic"
    control = msgspec.structs.replace(control, scheme="committed", trigger=trigger)
    scenario = msgspec.structs.replace(scenario, model=model, control=control)
    for knob in (*knobs(axes), *THRESHOLDS):
        runs, values = running(knob.process, scenario)
        assert knob.read(values) is not None, knob.label
        for number in (knob.low, knob.high, knob.low + 3 * knob.step):
            asked = msgspec.json.encode(knob.write(values, number))
            answer = msgspec.json.decode(runs.answer(asked, now_ns=0), type=Answer)
            assert not answer.refused, (knob.label, answer.refused)
            _, values = "", msgspec.json.decode(runs.answer(b"{}", now_ns=0), type=Answer).values
            assert knob.read(values) == pytest.approx(number), knob.label


def test_every_trigger_that_is_offered_can_be_flown() -> None:
    demo = reading.load("demo")
    for scheme in ("committed", "predictive", "none", "trajectory"):
        offered = triggers(scheme, "always")
        assert "always" in offered
        for trigger in offered:
            control = msgspec.structs.replace(
                demo.control,
                scheme=scheme,
                trigger=trigger,
                feedback=scheme == "trajectory",
            )
            reading.check(reading.to_table(msgspec.structs.replace(demo, control=control)))
    assert triggers("committed", "periodic(7)")[0] == "periodic(7)"
    assert {name for each in TRIGGERS for name in [each.split(" ")[0]]} <= set(registry.TRIGGERS)


PAPER = "paper(0.4, 0.02, 2.0) & loss(0.1)"
NETWORK = {"network.uplink": PAPER, "network.downlink": PAPER}
"""Values of netem in its frames."""


@pytest.mark.parametrize(
    ("trigger", "shown"),
    [
        ("cost_gap | silence(1)", {"Threshold: cost gap": 0.05}),
        ("cost_gap(2) & periodic", {"Threshold: cost gap": 2.0, "Rate: steps": 10.0}),
        ("state_gap(3)", {"Threshold: ε": 3.0, "Threshold: decay λ": 1.5}),
        ("no trigger", {}),
    ],
)
def test_only_the_thresholds_of_the_trigger_are_shown(
    trigger: str, shown: dict[str, float]
) -> None:
    numbers = {each.label: each.read({"control.trigger": trigger}) for each in THRESHOLDS}
    found = {label: number for label, number in numbers.items() if number is not None}
    assert list(found.values()) == list(shown.values())
    assert all(label.startswith(name) for label, name in zip(found, shown, strict=True))


def test_a_direction_without_loss_or_delay_has_no_slider_for_it() -> None:
    loss, delay, *_ = knobs(2)
    values = {"network.uplink": "rate(5000)", "network.downlink": "constant(0.1) & rate(5000)"}
    assert (loss.read(values), delay.read(values)) == (None, 100.0)
    after = applied(values, delay.write(values, 200.0))
    assert after == values | {"network.downlink": "constant(0.2) & rate(5000)"}


def test_a_slider_sends_its_own_number_and_not_what_the_page_knew_beside_it() -> None:
    """A page that has stayed open since an earlier flight changes nothing else in a later one."""
    scenario = reading.load("demo")
    for knob in (*knobs(2)[:2], THRESHOLDS[1]):
        runs, values = running(knob.process, scenario)
        now = {"network.uplink": PAPER.replace("0.02", "0.03"), "network.downlink": PAPER}
        now |= {"control.trigger": "expected_gap(3) | silence(2)"}
        own = {key: now[key] for key in values.keys() & now.keys()}
        runs.answer(msgspec.json.encode(own), now_ns=0)
        asked = msgspec.json.encode(knob.write(values, 7.0))
        assert not msgspec.json.decode(runs.answer(asked, now_ns=0), type=Answer).refused
        after = msgspec.json.decode(runs.answer(b"{}", now_ns=0), type=Answer).values
        assert knob.read(after) == pytest.approx(7.0)
        for key, text in own.items():
            assert after[key] == applied(own, knob.write(own, 7.0))[key] != text


def test_what_was_known_of_a_process_is_forgotten_when_another_one_begins() -> None:
    flight, asked = PageFlight(), list[tuple[str, dict[str, Any]]]()
    flight.operator = mock.Mock(ask=lambda *request: asked.append(request))
    scenario = msgspec.structs.replace(reading.load("demo"), duration=1.0, settle=0.0)
    frames = list(of_flight(scenario, "demo", virtual.fly(scenario)))
    netem = next(frame for _, process, frame in frames if process == "netem")
    assert isinstance(netem, Opened)
    flight.take("netem", netem)
    flight.values["netem"] = NETWORK
    flight.take("netem", netem)
    assert flight.netems == ["netem"], "its feed was only read anew"
    flight.cut()
    flight.take("netem", msgspec.structs.replace(netem, time_ns=netem.time_ns + 1))
    assert not flight.netems
    flight.values["netem"] = {way: f"{text} & loss(1)" for way, text in NETWORK.items()}
    flight.values["netem"]["network.uplink"] = "loss(0.4) & loss(1)"
    asked.clear()
    flight.heal()
    assert asked == [("netem", NETWORK | {"network.uplink": "loss(0.4)"})]


def test_the_newest_change_is_taken_back() -> None:
    flight, asked = flown(), list[tuple[str, dict[str, Any]]]()
    flight.operator = mock.Mock(ask=lambda *request: asked.append(request))
    flight.values = {"netem": NETWORK, "client": {"armed": True}}
    assert not flight.undoable
    after_ns = flight.state.newest_ns
    before, after = (msgspec.json.encode(text).decode() for text in (f"{PAPER} & loss(1)", PAPER))
    for key in NETWORK:
        change = Changed(key=key, before=before, after=after)
        flight.take("netem", Said(time_ns=after_ns + 1, event=change))
    asked.clear()
    assert flight.undo_cuts
    gui = Gui()
    panel.Controls(mock.Mock(gui=gui), [flight], lambda: 1)
    gui.elements["Undo"].use(True)
    assert not asked, "it would cut the link, so it is asked once more"
    gui.elements["Yes, cut it"].use()
    assert asked == [("netem", dict.fromkeys(NETWORK, f"{PAPER} & loss(1)"))]
    disarmed = Changed(key="armed", before="true", after="false")
    flight.take("client", Said(time_ns=after_ns + 2, event=disarmed))
    assert not flight.undoable


def test_a_change_goes_to_all_clients_or_to_that_of_the_chosen_vehicle() -> None:
    flight, asked = flown(), list[tuple[str, dict[str, Any]]]()
    client = next(process for process in flight.state._processes if process == "client")
    for name in ("client-2", "server 2"):
        opened = flight.state._processes[name.rstrip(" -2")].opened
        flight.take(name, msgspec.structs.replace(opened, time_ns=7))
    flight.state.vehicles[2] = VehicleTrack(2, flight.state.scenario)
    flight.state.vehicles[2].client = "client-2"
    flight.operator = mock.Mock(ask=lambda *request: asked.append(request))
    values = {"armed": True, "vehicle.wind": 0.1}
    flight.values = {"netem": NETWORK, client: values, "client-2": values}
    trigger = {"control.trigger": "always"}
    flight.values |= {"server": trigger, "server 2": trigger}
    gui = Gui()
    panel.Controls(mock.Mock(gui=gui), [flight], lambda: 2)
    for label, value, answering in (
        ("Wind [m/s per √s]", 0.3, ["client", "client-2"]),
        ("Trigger", "periodic", ["server", "server 2"]),
        ("Armed", True, ["client-2"]),
    ):
        asked.clear()
        gui.elements[label].use(value)
        assert [process for process, _ in asked] == answering
    flight.lose("server")
    asked.clear()
    gui.elements["Trigger"].use("always")
    assert [process for process, _ in asked] == ["server 2"]


def test_a_refused_number_is_told_at_its_field_and_not_sent() -> None:
    flight, asked = flown(), list[tuple[str, dict[str, Any]]]()
    flight.operator = mock.Mock(ask=lambda *request: asked.append(request))
    flight.values = {"netem": NETWORK, "server": {"control.trigger": "cost_gap"}}
    gui = Gui()
    controls = panel.Controls(mock.Mock(gui=gui), [flight], lambda: 1)
    controls.show()
    slider = gui.elements["Loss [%]"]
    for refused in (150.0, -1.0, np.nan):
        slider.use(refused)
        assert (asked, slider.value) == ([], 10.0)
        controls.show()
        note, delay = (each.note._html for each in controls._sliders[:2])
        assert note.visible
        assert not delay.visible
        assert "Loss: 0 to 100 %" in note.content
    slider.use(30.0)
    assert asked == [("netem", {"network.uplink.loss": 0.3, "network.downlink.loss": 0.3})]
    flight._answered("netem", asked[0][1], Answer(refused="the horizon is too short"))
    controls.show()
    assert "horizon" in note.content
    assert "horizon" not in controls._answer.content
    flight._answered("netem", {"network.uplink": ""}, Answer(refused="no such impairment"))
    controls.show()
    assert not note.visible
    assert "no such impairment" in controls._answer.content


def test_healing_brings_back_what_was_before_the_link_was_cut(tmp_path: Path) -> None:
    """Each direction its own loss; a cut link is not cut again."""
    asked: list[tuple[str, Any]] = []
    flight = PageFlight("", tmp_path)
    flight.ask = lambda process, values: asked.append((process, dict(values)))  # type: ignore[method-assign]
    flight.cut()
    assert not asked, "nothing is known of the network yet"
    before = NETWORK | {"network.downlink": ""}
    flight.values["netem"] = before
    flight.cut()
    flight.values["netem"] = asked[0][1]
    assert flight.cuts == ["netem"]
    flight.cut()
    flight.heal()
    cuts = {"network.uplink": f"{PAPER} & loss(1)", "network.downlink": "loss(1)"}
    assert asked == [("netem", cuts), ("netem", before)]
    flight.close()


def test_a_path_is_cut_and_healed_alone(tmp_path: Path) -> None:
    asked: list[tuple[str, Any]] = []
    flight = PageFlight("", tmp_path)
    flight.ask = lambda process, values: asked.append((process, dict(values)))  # type: ignore[method-assign]
    flight.values |= {"netem": NETWORK, "netem 2": NETWORK, "server": {}}
    flight.cut(("netem 2",))
    lost = dict.fromkeys(NETWORK, f"{PAPER} & loss(1)")
    assert asked == [("netem 2", lost)]
    flight.values["netem 2"] = lost
    assert (flight.netems, flight.cuts) == (["netem", "netem 2"], ["netem 2"])
    flight.cut()
    assert asked[1:] == [("netem", lost)], "one that is cut is not cut again"
    flight.heal(("netem",))
    assert len(asked) == 2, "it is not cut yet"
    flight.heal()
    assert asked[2:] == [("netem 2", NETWORK)]
    flight.close()


def flown() -> PageFlight:
    """A flight of one second on a page."""
    scenario = msgspec.structs.replace(reading.load("demo"), duration=1.0, settle=0.0)
    flight = PageFlight()
    for _, process, frame in of_flight(scenario, "demo", virtual.fly(scenario)):
        flight.take(process, frame)
    return flight


@pytest.mark.parametrize(
    ("label", "value", "yes", "expected"),
    [
        ("Cut the link", True, "Yes, cut it", "netem"),
        ("Loss [%]", 100.0, "Yes, cut it", "netem"),
        ("Armed", False, "Yes, disarm", "client"),
    ],
)
def test_what_may_end_a_flight_is_asked_once_more(
    label: str, value: object, yes: str, expected: str
) -> None:
    """One click changes nothing; a second one, elsewhere, does, unless it says to leave it."""
    flight, asked = flown(), list[tuple[str, dict[str, Any]]]()
    flight.operator = mock.Mock(ask=lambda *request: asked.append(request))
    flight.values = {"netem": NETWORK, "client": {"armed": True}}
    gui = Gui()
    panel.Controls(mock.Mock(gui=gui), [flight], lambda: 1)
    gui.elements[label].use(value)
    assert asked == []
    gui.elements["Leave it"].use()
    assert asked == []
    gui.elements[label].use(value)
    gui.elements[yes].use()
    assert [process for process, _ in asked] == [expected]


def test_a_page_that_came_later_heals_as_well() -> None:
    cuts = {"network.uplink": "rate(5000) & loss(1)", "network.downlink": "loss(1.0)"}
    assert is_cut(cuts)
    assert cut({"network.uplink": "rate(5000)"}) == {"network.uplink": "rate(5000) & loss(1)"}
    assert healed(cuts) == {"network.uplink": "rate(5000)", "network.downlink": "loss(0.0)"}
    assert not is_cut(healed(cuts))


def test_that_nobody_answers_is_said_in_words(tmp_path: Path) -> None:
    """Once a change was requested; not for the page's own question about changeable keys."""
    flight = PageFlight("", tmp_path)
    assert flight.operator
    for process, values in (("netem", {}), ("client", {"armed": False})):
        flight._answered(process, values, flight.operator._ask(process, values))
        assert flight.refused == bool(values)
    assert flight.answer.startswith("client ")
    flight.close()


def test_a_player_shows_any_time_of_a_flight() -> None:
    scenario = msgspec.structs.replace(reading.load("demo"), duration=10.0)
    frames = list(of_flight(scenario, "demo", virtual.fly(scenario)))
    flight = PageFlight()
    player = Player([flight], [frames])
    player.plays = False
    second_ns = 1_000_000_000
    player.seek(0)
    shown_ns = set()
    flight.take = lambda *frame: shown_ns.add(player.at_ns) or PageFlight.take(flight, *frame)  # type: ignore[method-assign, func-returns-value]
    player.advance(6 * second_ns)
    assert shown_ns == {0}, "a time is shown before its frames are"
    forwards = flight.state.vehicles[1].trail()
    player.seek(9 * second_ns)
    assert len(flight.state.vehicles[1].trail()) > len(forwards)
    player.seek(6 * second_ns)
    assert np.array_equal(flight.state.vehicles[1].trail(), forwards)
    player.advance(60 * second_ns)
    assert player.at_ns == player.end_ns
    player.close()


def test_a_duel_is_on_the_same_network_and_seed() -> None:
    names = ("demo", "paper", "paper-no-compensation")
    flights = together(DuelOptions(names, duration=12.0, seed=7))
    assert {(each.seed, each.duration) for each in flights} == {(7, 12.0)}
    assert all(each.network == flights[0].network for each in flights)
    assert [each.control.scheme for each in flights] == ["trajectory", "predictive", "none"]
    assert titles(["demo", "a/paper.toml"]) == ["demo", "paper"]
    assert titles(["a/demo.toml", "paper", "demo"]) == ["demo 1", "paper", "demo 3"]
    with pytest.raises(CommandError, match="two or more"):
        together(DuelOptions(("demo",)))


def test_a_gap_of_a_plot_is_drawn_as_a_gap() -> None:
    """Unknown values are left out, because the browser draws no line that contains NaN."""
    nan = np.nan
    x, late, never = np.arange(4.0), np.array([nan, nan, 5.0, 6.0]), np.full(4, nan)
    cut = np.array([nan, 1.0, nan, 3.0])
    drawn = plots.drawable(plots.on_one_axis([[x, late, cut, never]])[0])
    assert [list(each) for each in drawn] == [
        [1.0, 2.0, 3.0],
        [None, 5.0, 6.0],
        [1.0, None, 3.0],
        [None, None, None],
    ]
    assert isinstance(drawn[0], np.ndarray), "what has no gap goes as it is"


def test_plots_of_positions_have_ranges_of_the_same_width() -> None:
    nan = np.nan
    wide, narrow = (
        [np.array([nan, -2.0, 1.0]), np.array([2.0, nan, 0.0])],
        [np.array([99.0, 100.0])],
    )
    assert plots.spans([wide, narrow]) == [(-2.0, 2.0), (97.5, 101.5)]
    assert plots.spans([[np.array([nan])]]) == [(0.0, 0.0)]


def test_a_plot_with_gaps_reaches_a_browser() -> None:
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        plot = plots.Plot("", (plots.PlotLine("age", lambda look: look.curves.age_s),))
        shown = plots.Plots(server.gui, [""], [plot])
        nothing = np.empty(0)
        time_s, age_s = np.arange(3.0), np.array([1.0, np.nan, 3.0])
        curves = Curves(
            time_s, nothing, nothing, nothing, nothing, age_s=age_s, solve_ms=nothing, mode=nothing
        )
        shown.draw([plots.Look(State(), curves, 0)])
        sent = list(server._websock_server.get_message_buffer().message_from_id.values())[-1]
        data = sent.as_serializable_dict([])["updates"]["data"]
        assert data[1] == [1.0, None, 3.0]
    finally:
        stop(server)


def test_the_lines_of_a_scene_have_the_gaps_of_what_is_known() -> None:
    points = np.array([[0.0, 0.0], [1.0, 0.0], [np.nan, np.nan], [3.0, 0.0], [4.0, 0.0]])
    assert segments(points)[:, :, 0].tolist() == [[0.0, 1.0], [3.0, 4.0]]


def test_the_figures_of_a_report_have_a_gap_where_rows_are_missing() -> None:
    """A server without plans has no line then; one with plans has a complete line."""
    steps, values = np.array([3, 4, 9, 10]), np.array([1.0, 2.0, 3.0, 4.0])
    assert np.array_equal(with_gaps(steps, values), [1.0, 2.0, np.nan, 3.0, 4.0], equal_nan=True)
    assert np.array_equal(with_gaps(np.arange(4), values), values)
    places = np.stack([values, values], axis=1)
    assert with_gaps(steps, places).shape == (5, 2)


def test_a_scene_has_room_for_all_that_is_flown() -> None:
    middle, reach_m = extent([reading.load("demo")])
    assert middle == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    assert 2.0 < reach_m < 3.0
    lines = grid(middle, reach_m)
    assert lines[..., 0].max() >= 3 * reach_m
    assert np.unique(np.round(np.diff(np.unique(lines[..., 0])), 3)).tolist() == [1.0]
    vertices, faces = quadrotor(1.0)
    assert faces.max() < len(vertices)
    assert segments(np.zeros((5, 2)), dashed=True).shape == (2, 2, 3)


def fenced(**keys: Any) -> Scenario:
    scenario = reading.load("demo")
    return msgspec.structs.replace(
        scenario, fence=msgspec.convert(keys, type(scenario.fence), strict=False)
    )


def test_a_fence_is_drawn_as_far_as_it_has_bounds() -> None:
    box = fence(fenced(low_m=(-3, -2), high_m=(3, 2)), 2.0)
    assert box.shape == (4, 2, 3)
    assert (np.abs(box).max(axis=(0, 1)) == [3.0, 2.0, 0.0]).all()
    opened = fence(fenced(low_m=(-3, -2)), 2.0)
    assert opened[..., 0].min() == -3.0
    assert opened[..., 0].max() > 5.0
    around = fence(fenced(radius_m=9.0), 2.0)
    begin = home(reading.load("demo"))[0]
    assert np.hypot(*(around[..., :2] - begin).T) == pytest.approx(9.0, abs=1e-5)
    assert len(fence(fenced(speed_mps=2.0), 2.0)) == 0


# -- a process that serves a page ------------------------------------------------------------------


def heard(at: str, folder: Path) -> list[str]:
    said: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page_process, "say", said.append)
        with page_process.beside([folder], at):
            until(lambda: said)
            if found := re.search(r"http://\S*", said[0]):
                with urllib.request.urlopen(found[0]) as page:
                    said.append(page.read().decode())
    return said


@pytest.fixture
def neighbours() -> Iterator[int]:
    """A port that is taken, like the next one; the following ones are free."""
    for port in range(20_000, 60_000, 7):
        with contextlib.suppress(OSError), contextlib.ExitStack() as taken:
            for each in (port + 2, port + 1, port):
                sock = taken.enter_context(socket.socket())
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                sock.bind(("127.0.0.1", each))
                if each == port + 2:
                    sock.close()
                else:
                    sock.listen()
            yield port
            return


@pytest.mark.realtime
def test_a_page_is_served_on_the_next_free_port_where_its_own_is_taken(
    tmp_path: Path, neighbours: int
) -> None:
    at = f"127.0.0.1:{neighbours}"
    address, page = heard(at, tmp_path)
    assert f"http://127.0.0.1:{neighbours + 2} " in address
    assert "<html" in page
    assert not re.search(r"<(?:script|link|img)[^>]*(?:src|href)=[\"']?(?:https?:)?//", page)


def test_where_no_port_is_free_that_is_said(
    neighbours: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert serve.next_free("127.0.0.1", neighbours) == neighbours + 2
    assert serve.next_free("127.0.0.1", 0) == 0
    monkeypatch.setattr(serve, "PORTS_TRIED", 2)
    with pytest.raises(CommandError, match=f"{neighbours}: .*is taken, and so are"):
        serve.next_free("127.0.0.1", neighbours)
    with pytest.raises(CommandError, match=r"192\.0\.2\.1"):
        serve.next_free("192.0.2.1", neighbours)


def test_a_flight_goes_on_without_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here the page's process prints what it was asked for, and ends."""
    monkeypatch.setattr(page_process, "sys", SimpleNamespace(executable="/bin/echo"))
    (line,) = heard("192.0.2.1:8080", tmp_path)
    assert "192.0.2.1:8080" in line
    assert line.endswith("; the flight goes on without a page")
