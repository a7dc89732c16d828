"""Doubles of recorded flights: how near they are, their causes, and what is refused."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from helpers import SKYTETHER, ran
from skytether.client.simulated.vehicle import SimulatedVehicle
from skytether.explain import doubles
from skytether.explain.cases import Bad, Command, FlightCase, Stall
from skytether.explain.explanation import Explanation, explain
from skytether.explain.flying import CaseOutcome, fly
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.ends import COLUMNS, PART, End
from skytether.shared.telemetry.record import UPLINK, MemoryRecorder
from skytether.shell.driving.ends import Watched
from skytether.sim import flight
from skytether.sim.world import World

OUT = {"network.uplink": "paper(0.1, 0.02, 2.0) & loss(0.1) & outage(8, 2.5) & outage(0, 0.5)"}


def scenario_of(**keys: Any) -> Scenario:
    table = reading.to_table(reading.load("demo"))
    network = {"network.downlink": "paper(0.1, 0.02, 2.0) & loss(0.1)"}
    short = {"seed": 5, "duration": 13.0, "settle": 3.0}
    set_keys({**network, **short, **keys}, table)
    return reading.check(table, "a test")


def recorded(
    scenario: Scenario,
    *actions: tuple[float, Callable[[World], None]],
    kind: str = "",
    **changed: Any,
) -> Any:
    """Recording of a flight in virtual time, as processes would make it.

    Args:
        kind: kind of the vehicle in the recording; by default that of the scenario.
        changed: keys changed 7 s into the flight.
    """
    ends = MemoryRecorder(COLUMNS)
    worlds: list[World] = []

    def watch(world: World) -> None:
        worlds.append(world)
        for host, end in (("server", End.SERVER), (f"client {scenario.seed}.1", End.CLIENT)):
            inner = world.endpoint(host)
            clock_ns = lambda: flight.MIDNIGHT_NS + worlds[0].now_ns  # noqa: E731
            world.restart(host, Watched(inner, end, ends, clock_ns=clock_ns))
        # As before the restart, the vehicle begins in the middle of a step of the server.
        world.freeze(f"client {scenario.seed}.1")

    def begin(world: World) -> None:
        world.thaw(f"client {scenario.seed}.1")

    own = [(0.0, watch), (0.321, begin), *actions]
    changes = [(7.0, changed)] if changed else []
    flown = flight.fly(scenario, actions=own, changes=changes)
    vehicle = msgspec.structs.replace(scenario.vehicle, kind=kind or scenario.vehicle.kind)
    parts = {"client": flown.client, "server": flown.server, PART: ends.rows()}
    return SimpleNamespace(
        path=Path("a.mcap"),
        scenario=msgspec.structs.replace(scenario, vehicle=vehicle),
        parts=parts,
        begin_ns=flight.MIDNIGHT_NS,
        about=SimpleNamespace(secure=False),
        frames=[(0, "server", None)],
        events=lambda: iter(flown.events),
    )


def explained(case: FlightCase, track: Any) -> Explanation:
    """Explanation of a double up to its cause."""

    def fly_all(cases: Iterable[FlightCase]) -> list[CaseOutcome]:
        return [fly(each) for each in cases]

    return next(
        known
        for _, known in explain(case, "a double", fly_all, recorded=track)
        if known.cause is not None or known.moment is None
    )


def test_a_double_is_the_recorded_flight_and_names_the_outage_in_it() -> None:
    case, track = doubles.double(recorded(scenario_of(**OUT)))
    assert case.stalls == ()
    known = explained(case, track)
    assert known.nearness == doubles.Nearness(0.0, 0.0)
    assert str(known).startswith("A double of the flight, at most 0.000 m from it")
    assert known.cause is not None
    (part,) = known.cause.parts
    assert isinstance(part.unit, Bad)
    assert part.unit.lane[1] == UPLINK
    opens_s = case.double.opens_s if case.double else 0.0
    assert part.start_s < opens_s + 8.5
    assert part.end_s > opens_s + 10.0


def test_a_double_has_all_paths() -> None:
    two = "uniform(0.05, 0.15) & loss(0.2)"
    paths = [{"uplink": f"{two} & outage(8, 3)", "downlink": two}] * 2
    case, track = doubles.double(recorded(scenario_of(**{"network.paths": paths})))
    known = explained(case, track)
    assert known.nearness == doubles.Nearness(0.0, 0.0)
    assert known.cause is not None
    assert {part.unit.lane for part in known.cause.parts if isinstance(part.unit, Bad)} == {
        (0, UPLINK, 0),
        (1, UPLINK, 0),
    }


def test_a_process_that_stood_still_is_a_unit_of_its_double() -> None:
    freeze = (8.0, lambda world: world.freeze("server"))
    thaw = (10.5, lambda world: world.thaw("server"))
    quiet = {"network.uplink": "constant(0.05)", "network.downlink": "constant(0.05)"}
    case, track = doubles.double(recorded(scenario_of(**quiet), freeze, thaw))
    (stall,) = case.stalls
    assert stall.process == "server"
    assert stall.at_s + stall.for_s == pytest.approx(10.5, abs=0.06)
    known = explained(case, track)
    assert known.nearness is not None
    assert known.nearness.until_m < 1e-9
    assert known.cause is not None
    assert [type(part.unit) for part in known.cause.parts] == [Stall]


def test_what_a_person_changed_in_flight_is_a_unit_of_its_double() -> None:
    gust = {"vehicle.steady_wind_mps": [4.0, 0.0]}
    case, track = doubles.double(recorded(scenario_of(), **gust))
    known = explained(case, track)
    assert known.nearness is not None
    assert known.nearness.whole_m < 1e-9
    assert known.cause is not None
    (part,) = known.cause.parts
    assert part.unit == Command(pytest.approx(7.0, abs=0.05), *gust.popitem())


def test_a_real_vehicle_is_doubled_by_its_model_and_what_pushed_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(SimulatedVehicle, "drifts", True)  # as real ones do
    keys = {**OUT, "vehicle.kind": "quadrotor", "vehicle.turbulence_mps": 1.0}
    scenario = scenario_of(**keys, **{"vehicle.steady_wind_mps": [3.0, 0.0]})
    case, track = doubles.double(recorded(scenario, kind="mavlink"))
    assert case.scenario.vehicle.kind == "doubled(1)"
    near = doubles.nearness(fly(case), track, None, 3.0)
    assert near.whole_m < 1e-6
    calm = fly(replace(case, keys=(("vehicle.kind", "doubled(0)"),)))
    with pytest.raises(ConfigError, match=r"its double is \d\.\d\d m away .* expected at most 0.1"):
        doubles.nearness(calm, track, None, 3.0)


def test_a_brake_that_the_recording_lacks_is_refused() -> None:
    case, track = doubles.double(recorded(scenario_of(**OUT)))
    known = explained(case, track)
    flew_on = replace(track, mode=np.full_like(track.mode, 3))
    with pytest.raises(ConfigError, match="unlike the recorded flight"):
        doubles.nearness(known.flown, flew_on, known.moment, 3.0)


@pytest.mark.parametrize(
    ("part", "said"),
    [
        (PART, "expected the packets at both ends"),
        ("client", "expected vehicle 1 alone"),
        ("server 2", "expected one run of one server; got 2"),
    ],
)
def test_what_a_double_needs(part: str, said: str) -> None:
    found = recorded(scenario_of(duration=4.0))
    found.frames.append((0, part, None))
    if part in found.parts:
        found.parts[part] = found.parts[part].copy()[: None if part == "client" else 0]
    found.parts["client"]["vehicle"][-1] += part == "client"
    with pytest.raises(ConfigError, match=said):
        doubles.double(found)


@pytest.mark.realtime
def test_a_flight_over_udp_is_explained_by_its_double(tmp_path: Path) -> None:
    file = tmp_path / "a.mcap"
    flags = ["--seed", "11", "--duration", "13", "--settle", "3", "--no-page"]
    out = [
        "--network.uplink",
        "constant(0.05) & outage(8, 3)",
        "--network.downlink",
        "constant(0.05)",
    ]
    ran(*SKYTETHER, "fly", "demo", *flags, *out, "--record", str(file))
    json = tmp_path / "a.json"
    done = ran(*SKYTETHER, "explain", str(file), "--workers", "1", "--json", str(json))
    assert done.returncode == 0, done.stderr
    told = msgspec.json.decode(json.read_bytes())
    assert told["nearness"]["until_m"] < doubles.NEAR_M
    assert "Why: one outage of the uplink." in done.stdout
