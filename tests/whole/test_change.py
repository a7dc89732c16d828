"""Changes in flight: checked like a scenario, made between two steps, logged as events."""

import random
import string
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from helpers import Idle, packaged
from skytether.client.endpoint import Client
from skytether.client.failsafe import TRANSITIONS
from skytether.client.fleet import ClientFleet
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.vehicle import simulated
from skytether.client.simulated.weather import Weather
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.change import REQUEST_BYTES_MAX, Answer, Running
from skytether.shared.endpoints.endpoint import Endpoint
from skytether.shared.events.flight import Changed, ChangeRefused, Event, Flying, ModeChanged
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import VehicleConfig
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import UPLINK, Reason, Record
from skytether.shared.wire.protocol import Mode
from skytether.sim.flight import fly

DEMO = reading.load("demo")
FORGOTTEN = {"vehicle.wind": 2.5}


class Probe(Idle):
    changeable = frozenset({"vehicle.wind", "network.uplink", "vehicle.steady_wind_mps"})

    def __init__(self) -> None:
        super().__init__()
        self.changes: list[tuple[Scenario, frozenset[str], int]] = []

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        self.changes.append((scenario, keys, now_ns))


def probe(scenario: Scenario = DEMO) -> tuple[Probe, Running]:
    endpoint = Probe()
    return endpoint, Running(endpoint, scenario)


PAPER = "paper(0.4, 0.02, 2.0)"


def lossier(loss: float) -> Changed:
    """Change of the uplink's loss, which was 0.1."""
    before, after = f'"{PAPER} & loss(0.1)"', f'"{PAPER} & loss({loss})"'
    return Changed(key="network.uplink", before=before, after=after)


def answer(running: Running, request: bytes) -> Answer:
    return msgspec.json.decode(running.answer(request, now_ns=7), type=Answer)


# -- checks of changes -----------------------------------------------------------------------------


def test_a_change_is_laid_over_all_changes_before_it() -> None:
    """The endpoint gets the whole scenario, the keys and the time; its events report the change."""
    endpoint, running = probe()
    running.change({"vehicle.wind": 2}, now_ns=5)
    changed = running.change({"network.uplink.loss": 0.25}, now_ns=6)
    (first, _, _), (scenario, keys, now_ns) = endpoint.changes
    assert (first.vehicle.wind, first.uplink.loss) == (2.0, 0.1)
    assert (scenario.vehicle.wind, scenario.uplink.loss) == (2.0, 0.25)
    assert (keys, now_ns) == ({"network.uplink"}, 6)
    assert changed == (lossier(0.25),)
    assert endpoint.events() == (Changed(key="vehicle.wind", before="0.05", after="2.0"), *changed)
    assert running.settings == {"vehicle.wind": 2, "network.uplink": f"{PAPER} & loss(0.25)"}


def test_a_value_that_a_key_has_already_is_passed_on_and_no_news() -> None:
    endpoint, running = probe()
    assert running.change({"vehicle.wind": 0.05}, now_ns=5) == ()
    assert endpoint.changes == [(DEMO, frozenset({"vehicle.wind"}), 5)]
    assert endpoint.events() == ()


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (
            {"vehicle.wind": 1, "control.dt": 0.1},
            "control.dt: cannot be changed in flight",
        ),
        ({"vehicle.wint": 1}, "vehicle.wint: no such key; did you mean vehicle.wind?"),
        (
            {"control": {}},
            "control: cannot be changed in flight",
        ),
        (
            {"vehicle.wind": 1, "network.uplink.loss": 1.5},
            "network.uplink: got 'loss(1.5)', expected loss(share) with 0 <= share <= 1",
        ),
        ({"vehicle.wind": "much"}, "vehicle.wind: got 'much', expected a number"),
        (
            {"vehicle.steady_wind_mps": [0.1, 0.2, 0.3]},
            "vehicle.steady_wind_mps: got [0.1, 0.2, 0.3], expected 2 numbers with model.axes = 2",
        ),
    ],
)
def test_what_cannot_be_is_refused_with_one_line_and_nothing_changes(
    values: dict[str, Any], reason: str
) -> None:
    endpoint, running = probe()
    with pytest.raises(ConfigError) as refused:
        running.change(values, now_ns=5)
    assert str(refused.value).startswith(reason)
    assert endpoint.events() == (ChangeRefused(reason=str(refused.value)),)
    assert endpoint.changes == []
    assert answer(running, b"{}").values["vehicle.wind"] == 0.05


def test_a_request_without_keys_is_answered_with_what_may_change() -> None:
    _, running = probe()
    running.change({"vehicle.steady_wind_mps": [0.5, 0]}, now_ns=5)
    assert answer(running, b"{}").values == {
        "vehicle.wind": 0.05,
        "network.uplink": f"{PAPER} & loss(0.1)",
        "vehicle.steady_wind_mps": [0.5, 0.0],
    }


def test_the_trajectory_s_file_is_not_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk may be too slow for a control tick; and the file may have changed since."""
    file = tmp_path / "way.csv"
    file.write_text("t,x,y\n0,0,0\n9,1,1\n")
    table = reading.to_table(DEMO) | {"reference": {"shape": "csv", "file": str(file)}}
    scenario = reading.check(table, "test")
    file.unlink()
    probe(scenario)[1].change(FORGOTTEN, now_ns=5)
    check = reading.check
    monkeypatch.setattr(reading, "check", lambda raw, **_: check(raw))
    with pytest.raises(ConfigError, match="a file that can be read"):
        probe(scenario)[1].change(FORGOTTEN, now_ns=5)


def test_what_is_no_request_is_refused_and_changes_nothing() -> None:
    rng = random.Random(1)
    letters = string.printable + "é\ud800\0"
    deep = b'{"vehicle.wind":' + b"[" * 2000 + b"]" * 2000 + b"}"
    good = b'{"vehicle.wind":-1,"network.uplink.loss":[0.5]}'
    requests = [b"", b"[]", b"null", b"\xff", deep, b'{"vehicle.wind":null}', good * 100]
    for _ in range(500):
        requests.append(rng.randbytes(rng.randrange(200)))
        at, size = rng.randrange(len(good)), rng.randrange(9)
        requests.append(good[:at] + rng.randbytes(size) + good[at + size :])
        key = "".join(rng.choices(letters, k=rng.randrange(1, 30)))
        requests.append(repr({key: 1}).replace("'", '"').encode(errors="surrogatepass"))
    endpoint, running = probe()
    for request in requests:
        heard = answer(running, request)
        assert heard.refused or heard.values, request
        assert heard.refused.isprintable(), request
    assert endpoint.changes == []
    assert {type(event).__name__ for event in endpoint.events()} == {"ChangeRefused", "Omitted"}


def test_a_request_may_be_so_long_and_no_longer() -> None:
    """The rest of a datagram that is too long was never read."""
    _, running = probe()
    request = b'{"vehicle.wind":1}'
    assert answer(running, request + b" " * (REQUEST_BYTES_MAX - len(request))).changed
    longer = answer(running, request + b" " * (REQUEST_BYTES_MAX + 1 - len(request)))
    assert longer.refused == "got more than 4096 B, expected a shorter request"


@pytest.mark.parametrize("kind", [Server, Proxy, Client, ClientFleet])
def test_what_may_change_is_a_key_of_the_scenario(kind: type[Endpoint]) -> None:
    endpoint = make(kind)
    values = answer(Running(endpoint, DEMO), b"{}").values
    assert values.keys() == endpoint.changeable
    assert values
    assert answer(Running(endpoint, DEMO), msgspec.json.encode(values)) == Answer()


def make(kind: type[Endpoint]) -> Endpoint:
    if kind is Server:
        return Server(DEMO, boot_id=1, entropy=stream(1, "entropy").bytes)
    if kind is Proxy:
        return Proxy(DEMO, server=("server", 0))
    client = Client(DEMO, simulated(DEMO, 1), server=("netem", 0), vehicle=1, boot_id=1)
    return ClientFleet([client]) if kind is ClientFleet else client


# -- in flight -------------------------------------------------------------------------------------


def scenario(**changes: Any) -> Scenario:
    return packaged("demo-committed", {"duration": 10.0, "settle": 0.0}, changes)


def told(flight: Record, *kinds: type[Event]) -> list[tuple[float, str, Event]]:
    return [(at / 1e9, host, event) for at, host, event in flight.events if type(event) in kinds]


def test_netem_loses_what_it_is_told_to_from_then_on() -> None:
    """Packets under way arrive; setting the same loss again has no effect."""
    flown = scenario()
    flight = fly(flown, changes=[(4.0, {"network.uplink.loss": 1.0})])
    up = flight.netem[flight.netem["direction"] == UPLINK]
    before, after = up[up["arrived_ns"] < 4e9], up[up["arrived_ns"] >= 4e9]
    assert 0 < before["lost"].mean() < 0.3
    assert after["lost"].all()
    assert told(flight, Changed) == [(4.0, "netem 1", lossier(1.0))]
    same = fly(flown, changes=[(4.0, {"network.uplink.loss": 0.1})])
    assert same.trace_hash() == fly(flown).trace_hash()


def test_another_delay_is_that_of_the_packets_to_come() -> None:
    values = {"network.downlink": "constant(0.1) & loss(0.1)"}
    packets = fly(scenario(), changes=[(4.0, values)]).netem
    down = packets[packets["direction"] != UPLINK]
    after = down["arrived_ns"] >= 4e9
    assert (down["delay_ns"][after] == 100_000_000).all()
    assert (down["delay_ns"][~after] >= 400_000_000).all()
    assert (packets["delay_ns"][packets["direction"] == UPLINK] >= 400_000_000).all()


def test_every_trigger_may_follow_every_other_in_flight() -> None:
    triggers = ["always", "periodic", "state_gap(9, 1) & budget(5, 2) | silence(1)", "deviation"]
    triggers += ["periodic(20)", "cost_gap & budget(2, 1)", "periodic(4)"]
    changes = [(4.0 + i, {"control.trigger": text}) for i, text in enumerate(triggers)]
    flight = fly(scenario(duration=12.0), vehicles=2, changes=changes)
    assert flight.failure is None
    assert [str(event) for *_, event in told(flight, Changed)][-1] == (
        'control.trigger is "periodic(4)" from now on, it was "cost_gap & budget(2, 1)"'
    )
    modes = flight.client[flight.client["step"] > 80]["mode"]
    assert set(modes.tolist()) <= {Mode.TRACK, Mode.COAST}
    one = flight.server[flight.server["vehicle"] == 1]
    ((began_s, *_), _) = told(flight, Flying)
    time_s = began_s + 0.05 * one["step"]
    events = [one["event"][(time_s > s + 0.1) & (time_s < s + 0.95)].sum() for s in (4, 5, 10)]
    assert events[0] >= 16
    assert events[1] <= 2
    assert events[2] == 4


def test_a_threshold_changes_without_its_trigger() -> None:
    flown = scenario(control={"trigger": "periodic(10)"})
    events = fly(flown, changes=[(5.0, {"control.trigger.periodic": 2})]).server["event"]
    assert np.diff(np.flatnonzero(events)[-20:]).tolist() == [2] * 19
    assert np.diff(np.flatnonzero(events)[:4]).tolist() == [10] * 3


def test_wind_blows_from_the_next_step_on_and_changes_nothing_before() -> None:
    """To the last bit; and gusts begin, and end. There is no feedback aboard."""
    flown = scenario(vehicle={"wind": 0.0}, control={"feedback": False})
    calm = fly(flown).client
    for values in ({"vehicle.steady_wind_mps": [0.5, 0.0]}, {"vehicle.wind": 0.2}):
        windy = fly(flown, changes=[(5.0, values)]).client
        blown = np.flatnonzero((windy["state"] != calm["state"]).any(axis=(1, 2)))
        assert 75 < blown[0] < 100
    gusty: dict[str, Any] = {"vehicle.gust_mps2": 2.0, "vehicle.gust_every_s": 0.1}
    endless = [(5.0, gusty | {"vehicle.gust_s": 1e6}), (7.0, {"vehicle.gust_mps2": 0.0})]
    windy = fly(flown, changes=endless).client
    assert np.abs(windy["state"] - calm["state"])[120, :, 1].max() > 0.3
    assert np.abs(windy["state"] - calm["state"])[-1, :, 1].max() < 0.1


def test_a_gust_that_blows_goes_on_with_its_new_strength() -> None:
    air = VehicleConfig(gust_mps2=1.0, gust_every_s=1e-9, gust_s=1e9)
    flown = msgspec.structs.replace(DEMO, vehicle=air)
    plant = FirstOrderPlant(flown, Weather(flown, stream(1, "wind")))
    plant.advance(np.zeros(2))
    before = plant.state()[:, 1].copy()
    plant.weather.change(msgspec.structs.replace(air, gust_mps2=3.0))
    plant.advance(np.zeros(2))
    gained = plant.state()[:, 1] - before * np.exp(-0.05 / DEMO.tau_s)
    np.testing.assert_allclose(gained, 3.0 * before, rtol=1e-9)


def test_a_live_point_is_led() -> None:
    flown = scenario(reference={"shape": "live"}, duration=14.0)
    place, way = "reference.points_m", "reference.velocity_mps"
    flight = fly(
        flown,
        changes=[
            (2.0, {place: [[1.0, 2.0]], way: [0.0, 0.0]}),
            (8.0, {way: [0.5, 0.0]}),
            (10.0, {place: [[3.0, 2.0]]}),
        ],
    )
    ((began_s, *_),) = told(flight, Flying)
    time_s = began_s + 0.05 * flight.server["step"]
    known = flight.server["reference"]
    moved_m = 0.5 * np.clip(time_s - 8.0, 0.0, 2.0)
    late_m = np.where(time_s > 10.0, 3.0 + 0.5 * (time_s - 10.0), 1.0 + moved_m)
    wanted = np.stack([late_m, np.full(len(time_s), 2.0)], axis=-1) * (time_s > 2.0)[:, None]
    sharp = np.abs(time_s[:, None] - [2.0, 10.0]).min(axis=1) > 0.1
    np.testing.assert_allclose(known[sharp, :, 0], wanted[sharp], atol=0.05)
    np.testing.assert_array_equal(known[time_s > 8.1, 0, 1], 0.5)
    flown_m = flight.client["state"][..., 0]
    np.testing.assert_allclose(flown_m[flight.client["step"] == 135][0], [1.0, 2.0], atol=0.1)


def test_only_a_live_point_can_be_led() -> None:
    flight = fly(scenario(), changes=[(3.0, {"reference.points_m": [[1.0, 2.0]]})])
    ((_, host, refused),) = told(flight, ChangeRefused)
    assert host == "server"
    assert refused.reason.startswith("reference.points_m: ")


def arming(*changes: tuple[float, bool], armed: bool = True) -> Record:
    """Flight in which the vehicle is armed and disarmed at these times [s]."""
    flown = scenario(armed=armed, duration=12.0)
    return fly(flown, changes=[(at, {"armed": value}) for at, value in changes])


def test_a_vehicle_that_waits_is_armed_in_flight() -> None:
    flight = arming((5.0, True), armed=False)
    modes = [(event.after, event.reason) for _, _, event in told(flight, ModeChanged)]
    assert modes == [
        ("sync", str(Reason.OPENED)),
        ("ready", str(Reason.GOOD)),
        ("ready", str(Reason.UNARMED)),
        ("ready", str(Reason.GOOD)),
        ("track", str(Reason.HORIZON)),
    ]
    assert not flight.client["input"][:80].any()
    assert flight.failure is None


def test_a_vehicle_that_is_disarmed_brakes_at_once_and_flies_again_when_armed() -> None:
    """It drops its plan, hovers, accepts no other meanwhile, and needs no new session."""
    flight = arming((5.0, False), (8.0, True))
    modes = [
        (round(at, 1), event.after, event.reason) for at, _, event in told(flight, ModeChanged)
    ][3:]
    assert [mode for _, *mode in modes] == [
        ["brake", str(Reason.UNARMED)],
        ["hover", str(Reason.UNARMED)],
        ["hover", str(Reason.GOOD)],
        ["track", str(Reason.HORIZON)],
    ]
    assert modes[0][0] == 5.0
    hovering = flight.client["mode"] == Mode.HOVER
    assert not flight.client["input"][hovering].any()
    assert 2.0 < 0.05 * hovering.sum() < 6.0


def test_without_its_rows_in_the_table_a_disarmed_vehicle_would_fly_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ablation for the test above: it would fly its plan to the end."""
    rows = {key: mode for key, mode in TRANSITIONS.items() if key[1] is not Reason.UNARMED}
    monkeypatch.setattr("skytether.client.endpoint.TRANSITIONS", rows)
    flight = arming((5.0, False))
    modes = [(event.after, event.reason) for *_, event in told(flight, ModeChanged)]
    assert ("brake", str(Reason.UNARMED)) not in modes


def test_what_is_refused_in_flight_is_an_event_and_the_flight_is_the_same() -> None:
    """The endpoint that owns the key reports it; unknown keys are reported by the server."""
    flown = scenario()
    changes: list[tuple[float, dict[str, Any]]] = [
        (3.0, {"network.uplink.loss": 2, "network.downlink.loss": 0.5}),
        (4.0, {"control.horizon": 80}),
        (5.0, {"vehicle.wind": "strong"}),
    ]
    flight = fly(flown, changes=changes)
    assert [(at, host) for at, host, _ in told(flight, ChangeRefused)] == [
        (3.0, "netem 1"),
        (4.0, "server"),
        (5.0, "client 1.1"),
    ]
    assert flight.trace_hash() == fly(flown).trace_hash()
