"""`import skytether`: names, results, and refusals."""

import asyncio
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure

import skytether
from helpers import PATIENCE_S
from skytether import ConfigError, check, fly, fly_batch, load, sweep
from skytether.cli import processes
from skytether.shared.events.flight import ReferenceTooFast
from skytether.shared.events.ground import NoAnswer
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.shared.wire.protocol import (
    Hello,
    Horizon,
    Observation,
    Refusal,
    Welcome,
    decode,
    encode,
    stamp_us,
)
from skytether.shell.commandline.command import CommandError
from skytether.sim import flight as virtual

EXPORTS = skytether.__all__
HEAVY = ("daqp", "matplotlib", "mcap", "numba", "osqp", "pandas", "rich", "scipy", "tyro", "viser")
SHORT: dict[str, Any] = {"duration": 10, "settle": 4}


class Constant(skytether.Endpoint):
    def __init__(self, scenario: skytether.Scenario) -> None:
        super().__init__()
        self.terms = scenario.terms()

    def receive(self, datagram: skytether.Datagram, *, now_ns: int) -> None:
        message = decode(datagram.payload, self.terms)
        vehicle = message.vehicle
        if isinstance(message, Hello):
            welcome = Welcome(vehicle, 1, message.boot_id, 1, now_ns, Refusal.ACCEPTED, self.terms)
            self.send(encode(welcome), datagram.peer)
        elif isinstance(message, Observation):
            inputs = np.full((self.terms.axes, self.terms.planned), 0.1, np.float32)
            horizon = Horizon(vehicle, 1, message.step, stamp_us(now_ns), 0, inputs)
            self.send(encode(horizon), datagram.peer)

    def wake(self, *, now_ns: int) -> None:
        """Nothing is due."""

    def next_wake_ns(self) -> None:
        """Never."""


class Silent(Constant):
    def receive(self, datagram: skytether.Datagram, *, now_ns: int) -> None:
        """Nothing."""


@pytest.fixture(scope="module")
def flown() -> skytether.Flight:
    return fly("demo", **SHORT)


def test_it_exports_what_it_names() -> None:
    assert sorted(name for names in skytether._HOMES.values() for name in names) == EXPORTS
    for name in EXPORTS:
        assert getattr(skytether, name).__name__ == name
    assert set(EXPORTS) <= set(dir(skytether))
    with pytest.raises(AttributeError, match="module 'skytether' has no attribute 'flyy'"):
        skytether.flyy  # noqa: B018
    assert (resources.files("skytether") / "py.typed").is_file()


def test_importing_it_is_light() -> None:
    """Neither numpy nor anything heavier; no exported name needs compiler, pictures or page."""
    code = f"""
import sys, skytether
assert "numpy" not in sys.modules and "asyncio" not in sys.modules
skytether.Flight, skytether.fly, skytether.Scenario, skytether.World, skytether.ConfigError
print(*(name for name in {HEAVY} if name in sys.modules))
"""
    printed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert printed == "\n"


# -- scenarios -------------------------------------------------------------------------------


def test_keys_lie_over_a_scenario_with_dots_or_as_tables() -> None:
    """Other keys stay unchanged; numpy's numbers are accepted."""
    keys = {"control.trigger": "always", "network.uplink.loss": np.float64(0.25)}
    dotted = load("demo", seed=np.int64(7), **keys)
    network = {"uplink": {"loss": 0.25}}
    assert dotted == load(load("demo"), seed=7, control={"trigger": "always"}, network=network)
    assert (dotted.seed, dotted.uplink.loss) == (7, 0.25)
    start = load("demo", **{"vehicle.start_m": np.array([1.0, 2.0])})
    assert start.vehicle.start_m == (1.0, 2.0)


def test_a_scenario_is_loaded_from_a_path(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('extends = "demo"\nduration = 12\n')
    assert load(file) == load(str(file)) == load("demo", duration=12)


def test_a_key_may_end_a_contradiction_of_the_file(tmp_path: Path) -> None:
    """Only the final values are judged, as on the command line."""
    file = tmp_path / "mine.toml"
    file.write_text('extends = "demo"\nfence.radius_m = 20\nfence.wind_mps = 5.0\n')
    with pytest.raises(ConfigError, match=r"mine.toml: fence.wind_mps: got 5.0"):
        load(file)
    assert load(file, **{"fence.wind_mps": 0.5}).fence.wind_mps == 0.5


def test_a_scenario_made_by_hand_is_checked() -> None:
    assert check({"duration": 3, "model": {"axes": 3}}).model.axes == 3
    assert check(skytether.Scenario(seed=4), duration=3).steps == 60
    wrong = skytether.Scenario(title="mine", duration=-1.0)
    for refuses in (check, fly, load):
        with pytest.raises(ConfigError, match=r"mine: duration: got -1.0, expected a"):
            refuses(wrong)


def test_a_reference_that_nothing_can_follow_is_told() -> None:
    keys = {"reference.radius_m": 8.0, "reference.period_s": 10.0, "model.gain": 0.5}
    flight = fly("demo", **SHORT, **keys)
    (event,) = (each for each in flight.events if isinstance(each.event, ReferenceTooFast))
    assert event.event == ReferenceTooFast(at_s=0.0, speed_mps=event.event.speed_mps, most_mps=0.8)
    assert event.event.speed_mps == pytest.approx(2.0 * np.pi * 8.0 / 10.0)
    assert event.time_ns < 10**9
    assert flight.summary.too_fast == 1.0
    usual = fly("demo", **SHORT)
    assert usual.summary.too_fast == 0.0
    assert not any(isinstance(each.event, ReferenceTooFast) for each in usual.events)
    assert fly("target", **SHORT).summary.too_fast is None


# -- flights ---------------------------------------------------------------------------------


def test_a_flight_is_that_of_the_simulation(flown: skytether.Flight) -> None:
    scenario = load("demo", **SHORT)
    record = virtual.fly(scenario)
    assert flown.record.trace_hash() == record.trace_hash()
    assert [each.event for each in flown.events] == [each.event for each in record.events]
    assert {each.host for each in flown.events} == {"server", "netem", "client"}
    parts = record.client, record.server, record.netem
    assert flown.summary == summarise(scenario, "demo", *parts, figures=record.figures)
    assert flown.summary.rmse_xy == pytest.approx(0.0280, abs=1e-4)
    assert (flown.failure, flown.name, flown.scenario) == (None, "demo", scenario)
    assert repr(flown) == "<Flight 'demo', seed 1: 200 steps in 10 s>"


def test_arrays_have_names_shapes_and_units(flown: skytether.Flight) -> None:
    columns = {column.name: column for column in flown.columns()}
    assert columns["position_m"] == ("position_m", (200, 2), "m")
    assert columns["input_mps"] == ("input_mps", (200, 2), "m/s")
    assert columns["age_ns"].unit == "ns"
    assert columns["netem.bytes"].unit == "B"
    assert columns["mode"].unit == columns["server.event"].unit == ""
    assert columns["plan.input_mps"].shape == (len(flown.record.plan), 2, 80)
    for name, column in columns.items():
        assert flown[name].shape == column.shape
        assert not flown[name].flags.writeable
    client = flown.record.client
    assert np.array_equal(flown["position_m"], client["state"][..., 0])
    assert np.array_equal(flown["velocity_mps"], client["state"][..., 1])
    assert np.array_equal(
        flown["server.planned_position_m"], flown.record.server["planned"][..., 0]
    )
    assert np.array_equal(flown["plan.input_mps"], flown.record.plan["inputs"])
    assert np.array_equal(flown["time_s"], np.arange(200) * 0.05)
    reference = flown.scenario.make_reference()
    assert np.array_equal(flown["desired_position_m"], reference(flown["time_s"])[..., 0])
    lines = str(flown).splitlines()
    assert lines[0] == repr(flown)
    assert [line.split()[0] for line in lines[1:]] == list(columns)


def test_a_flight_comes_back_from_its_file(tmp_path: Path) -> None:
    flown = fly("demo", secure=True, duration=3, settle=0, **{"model.axes": 3})
    flown.save(tmp_path / "flight.mcap")
    back = skytether.Flight.load(str(tmp_path / "flight.mcap"))
    for part in ("client", "server", "netem", "plan"):
        before, after = getattr(flown.record, part), getattr(back.record, part)
        assert before.dtype == after.dtype
        assert before.tobytes() == after.tobytes()
    assert back.events == flown.events
    assert back.record.figures == flown.record.figures
    assert back.summary == flown.summary
    assert back.summary.secure
    assert (back.name, back.scenario, back.failure) == ("demo", flown.scenario, flown.failure)
    assert back.columns() == flown.columns()


def test_a_flight_that_failed_says_why_and_comes_back(tmp_path: Path) -> None:
    scenario = load("demo", **{"link.connect_s": 2.0})
    flown = fly(scenario, server=Silent(scenario))
    assert isinstance(flown.failure, NoAnswer)
    assert flown["position_m"].shape == (0, 2)
    assert flown.summary.rmse_xy is None
    with pytest.raises(skytether.FlightError, match="no step was flown: vehicle 1: no answer"):
        flown.plot()
    flown.save(tmp_path / "flight.mcap")
    back = skytether.Flight.load(tmp_path / "flight.mcap")
    assert (back.failure, back.columns()) == (flown.failure, flown.columns())


def test_a_batch_is_its_single_flights(flown: skytether.Flight) -> None:
    one, other = fly_batch("demo", np.array([1, 5]), **SHORT)
    assert one.record.trace_hash() == flown.record.trace_hash()
    assert other.summary == fly("demo", seed=5, **SHORT).summary
    assert (other.scenario.seed, other["plan.input_mps"].shape) == (5, (0, 2, 80))


def test_each_flight_of_a_batch_has_its_own_drops() -> None:
    damaged = "paper(0.1, 0.02, 2.0) & corrupt(0.3) & loss(0.1)"
    keys = {**SHORT, "network.uplink": damaged, "network.downlink": damaged}
    together = [each.summary.drops for each in fly_batch("demo", (1, 2), **keys)]
    assert together == [fly("demo", seed=seed, **keys).summary.drops for seed in (1, 2)]
    assert all(drops and drops.keys() == {"server", "netem", "client"} for drops in together)


def test_a_flight_is_drawn(flown: skytether.Flight) -> None:
    plane, packets = flown.plot().axes
    assert plane.get_title().startswith("demo, seed 1")
    assert np.array_equal(plane.lines[1].get_xydata(), flown["position_m"])
    for way, stairs in enumerate(packets.patches):
        counts, edges_s, _ = stairs.get_data()
        assert counts.sum() == (flown["netem.direction"] == way).sum()
        assert set(np.diff(edges_s)) == {1.0}


def test_a_flights_path_is_drawn_on_axes_that_are_given(flown: skytether.Flight) -> None:
    figure = Figure(figsize=(3.4, 3.0))
    left, right = figure.subplots(1, 2)
    assert flown.plot(ax=right) is figure
    assert not left.lines
    assert np.array_equal(right.lines[1].get_xydata(), flown["position_m"])


@pytest.mark.long
def test_a_flight_goes_to_pandas(flown: skytether.Flight) -> None:
    pytest.importorskip("pandas")
    table = flown.to_pandas()
    assert list(table.columns[:5]) == [
        "time_s",
        "vehicle",
        "step",
        "position_x_m",
        "velocity_x_mps",
    ]
    assert np.array_equal(table["position_y_m"], flown["position_m"][:, 1])
    assert table["mode"].iloc[-1] == "track"
    assert len(flown.to_pandas("netem")) == len(flown["netem.bytes"])
    assert "input_x_mps_79" in flown.to_pandas("plan")


@pytest.mark.long  # pandas takes a second to import
def test_flights_are_rows_of_a_table(flown: skytether.Flight) -> None:
    pytest.importorskip("pandas")
    swept = skytether.Swept({"control.trigger": "always"}, flown.scenario, (flown.summary,) * 2)
    for table, rows in ((skytether.table([flown]), 1), (swept.to_pandas(), 2)):
        assert list(table["rmse_xy"]) == [flown.summary.rmse_xy] * rows
        assert table["seed"].dtype.kind == "i"
    assert swept.to_pandas().columns[0] == "control.trigger"
    assert set(skytether.table([flown]).columns) == set(Summary.__struct_fields__) - {
        "modes",
        "drops",
    }


def test_without_pandas_it_says_what_to_install(
    flown: skytether.Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"^pandas is not installed, .*'skytether\[pandas\]'"):
        flown.to_pandas()
    with pytest.raises(ImportError, match=r"'skytether\[pandas\]'"):
        skytether.table([flown])
    with pytest.raises(ImportError, match=r"'skytether\[pandas\]'"):
        skytether.Swept({}, flown.scenario, ()).to_pandas()


def test_a_server_of_ones_own_is_flown() -> None:
    always = {"vehicle.report": "always"}
    scenario = load("demo-committed", duration=8, settle=0, **always)
    flown = fly(scenario, server=Constant(scenario))
    planned = flown["input_mps"][flown["covered"]]
    assert len(planned) > 80
    assert np.unique(planned).tolist() == [np.float32(0.1)]
    assert len(flown["server.step"]) == len(flown["plan.step"]) == 0
    assert flown.summary.uplink_packets == (flown["netem.direction"] == 0).sum() > 100


# -- over UDP --------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.realtime
def test_a_flight_over_udp_is_a_flight(tmp_path: Path) -> None:
    at_once = {"network.uplink": "loss(0.1)", "network.downlink": "loss(0.1)"}
    flown = fly("demo", udp=True, secure=True, duration=5, settle=0, **at_once)
    assert (flown.summary.duration_s, flown.summary.secure) == (5.0, True)
    times_ns = [each.time_ns for each in flown.events]
    assert times_ns[0] == 0
    assert min(flown["netem.arrived_ns"]) > 0
    assert max(flown["netem.arrived_ns"]) <= max(times_ns)
    flown.save(tmp_path / "flight.mcap")
    back = skytether.Flight.load(tmp_path / "flight.mcap")
    assert back.record.trace_hash() == flown.record.trace_hash()
    assert back.events == flown.events


async def test_a_process_that_fails_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """With its last lines; also if an event loop is already running, as in a notebook."""

    def run(*_: object, **__: object) -> list[processes.Shortfall]:
        asyncio.run(asyncio.sleep(0))
        raise CommandError("server: killed")

    monkeypatch.setattr(processes, "run", run)
    with pytest.raises(skytether.FlightError, match="server: killed"):
        fly("demo", udp=True)


@pytest.mark.realtime
def test_ctrl_c_ends_the_processes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Event()

    def run(*_: object, interrupted: Callable[[], bool], **__: object) -> None:
        main = threading.main_thread().ident
        assert main is not None
        signal.pthread_kill(main, signal.SIGINT)
        while not interrupted():
            threading.Event().wait(0.01)
        ended.set()

    monkeypatch.setattr(processes, "run", run)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            fly("demo", udp=True)
    finally:
        signal.signal(signal.SIGINT, before)
    assert ended.wait(PATIENCE_S)


# -- sweeps ----------------------------------------------------------------------------------

GRID = {"control.trigger": ["always", "cost_gap"], "network.uplink.loss": np.array([0.0, 0.5])}


def test_a_sweep_flies_every_combination() -> None:
    swept = sweep("demo", GRID, runs=2, seed=3, **SHORT)
    assert [tuple(each.keys.values()) for each in swept] == [
        ("always", 0.0),
        ("always", 0.5),
        ("cost_gap", 0.0),
        ("cost_gap", 0.5),
    ]
    last = swept[-1]
    keys = {"control.trigger": "cost_gap", "network.uplink.loss": 0.5}
    assert last.scenario == load("demo", seed=3, **SHORT, **keys)
    alone = fly("demo", seed=4, **SHORT, **keys).summary
    assert last.runs[1] == msgspec.structs.replace(alone, drops=None, plugin_errors=None)
    one, other = (run.rmse_xy for run in last.runs)
    assert one is not None
    assert other is not None
    mean, half = last.mean("rmse_xy")
    assert mean == pytest.approx((one + other) / 2)
    # 12.7062 is t of one degree of freedom.
    assert half == pytest.approx(12.7062 * abs(one - other) / 2, rel=1e-4)


@pytest.mark.long
def test_a_sweep_is_the_same_with_more_workers() -> None:
    alone = sweep("demo", GRID, runs=2, **SHORT)
    assert sweep("demo", GRID, runs=2, workers=2, **SHORT) == alone


# -- refusals --------------------------------------------------------------------------------


def mine() -> Constant:
    return Constant(load("demo-committed"))


DEMO = "demo with these keys: "
REFUSALS: list[tuple[Callable[[], object], type[Exception], str]] = [
    (lambda: fly("dmeo"), ConfigError, "dmeo: no such scenario; did you mean demo?"),
    (
        lambda: fly(42),  # type: ignore[arg-type]
        TypeError,
        "scenario: got 42, expected the name of a scenario, a .toml file or a Scenario",
    ),
    (
        lambda: check("demo"),  # type: ignore[arg-type]
        TypeError,
        "scenario: got 'demo', expected a Scenario or a mapping of its keys",
    ),
    (
        lambda: fly("demo", duraton=3),
        ConfigError,
        f"{DEMO}duraton: no such key; did you mean duration?",
    ),
    (
        lambda: fly("demo", server="mine"),  # type: ignore[arg-type]
        TypeError,
        "server: got 'mine', expected an Endpoint",
    ),
    (
        lambda: fly("demo", udp=True, server=mine()),
        ConfigError,
        "udp: got True with a server of your own, expected virtual time",
    ),
    (
        lambda: fly("demo", secure=True, server=mine()),
        ConfigError,
        "secure: got True with a server of your own, which cannot open encrypted packets",
    ),
    (
        lambda: fly_batch("demo", 8),  # type: ignore[arg-type]
        TypeError,
        "seeds: got 8, expected several seeds, as in range(100)",
    ),
    (
        lambda: fly_batch("demo", [1, -1]),
        ConfigError,
        f"{DEMO}seed: got -1, expected a whole number >= 0",
    ),
    (
        lambda: fly_batch("demo", [1, 2, 1]),
        ConfigError,
        "seeds: got 1 twice, expected seeds that differ",
    ),
    (
        lambda: sweep("demo", ["seed"]),  # type: ignore[arg-type]
        TypeError,
        "grid: got ['seed'], expected a mapping from keys to lists of values",
    ),
    (
        lambda: sweep("demo", {"control.trigger": "always"}),
        TypeError,
        "grid: control.trigger: got 'always', expected a list of values",
    ),
    (
        lambda: sweep("demo", {"control.input_weight": []}),
        ConfigError,
        "grid: control.input_weight: got no values, expected at least one",
    ),
    (
        lambda: sweep("demo", {"control.input_weight": [1.0, 1]}),
        ConfigError,
        "grid: control.input_weight: got 1.0 twice, expected values that differ",
    ),
    (
        lambda: sweep("demo", {"seed": [1, 2]}),
        ConfigError,
        "grid: got 'seed', expected another key: the seed counts the runs",
    ),
    (
        lambda: sweep("demo", {"control.horizom": [1]}),
        ConfigError,
        "demo with control.horizom=1: control.horizom: no such key; did you mean horizon?",
    ),
    (
        lambda: sweep("demo", {}, runs=0),
        ConfigError,
        "runs: got 0, expected a whole number from 1 on",
    ),
]


@pytest.mark.parametrize(("attempt", "kind", "said"), REFUSALS, ids=[each[2] for each in REFUSALS])
def test_what_cannot_be_is_refused_in_words(
    attempt: Callable[[], object], kind: type[Exception], said: str
) -> None:
    with pytest.raises(kind) as refused:
        attempt()
    assert str(refused.value) == said


def test_a_flight_refuses_in_words(flown: skytether.Flight, tmp_path: Path) -> None:
    no_file = tmp_path / "nowhere" / "flight.mcap"
    swept = skytether.Swept({}, flown.scenario, (flown.summary,))
    refusals: list[tuple[Callable[[], object], type[Exception], str]] = [
        (lambda: flown["positon_m"], KeyError, "no array 'positon_m'; did you mean position_m?"),
        (lambda: flown["state"], KeyError, "no array 'state'; did you mean stale?"),
        (lambda: flown.to_pandas("clint"), KeyError, "no part 'clint'; did you mean client?"),
        (lambda: swept.mean("rmse"), KeyError, "no figure 'rmse'; did you mean rmse_z?"),
        (
            lambda: flown.save(tmp_path / "flight.csv"),
            ConfigError,
            f"{tmp_path}/flight.csv: expected a file that ends in .mcap",
        ),
        (
            lambda: flown.save(no_file),
            skytether.RecordingError,
            f"{no_file}: cannot be written: No such file or directory",
        ),
        (
            lambda: skytether.Flight.load(__file__),
            skytether.RecordingError,
            f"{__file__}: it is not an MCAP file, expected a recording (.mcap)",
        ),
    ]
    for attempt, kind, said in refusals:
        with pytest.raises(kind) as refused:
            attempt()
        assert refused.value.args[0] == said
