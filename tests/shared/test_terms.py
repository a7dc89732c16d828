"""Terms of a flight: for every key, ends that differ are refused with a message, or may differ."""

import math
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from skytether.client.endpoint import Client
from skytether.client.simulated.vehicle import simulated
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.law.terms import Difference, Terms
from skytether.shared.scenario import reading
from skytether.shared.scenario.catalogue import DECISIONS, KEYS, TERMS, differences
from skytether.shared.scenario.dotted import flat, set_keys
from skytether.shared.scenario.owners import Owner
from skytether.shared.scenario.registry import PLANNERS
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX, Hello, encode

pytestmark = pytest.mark.usefixtures("plugin_tables")

HERE = reading.check(
    {
        "model": {"axes": 2},
        "control": {"horizon": 50, "scheme": "committed", "trigger": "state_gap | silence(1)"},
        "reference": {"points_m": [[0.0, 0.0], [1.0, 0.0]]},
    },
    "here",
)
"""Scenario of the server, with as few restrictions on single changes as possible."""
OTHER: dict[str, Any] = {
    "model.axes": 3,
    "link.spread": "all",
    "network.paths": [{"uplink": "none"}, {"uplink": "none"}],
    "control.scheme": "predictive",
    "control.feedback": False,
    "reference.origin": [47.0, 8.0],
    "reference.preview": 1.0,
    "sensor.filter": "none",
    "sensor.position_bias_m": [0.1, 0.1],
    "sensor.velocity_bias_mps": [0.1, 0.1],
    "sensor.velocity_every_s": 1.0,
    "control.delay_bound": 0.5,
    "control.trigger": "always",
    "control.planner": "own",
    "control.solver": "osqp",
    "control.input_reference": False,
    "reference.shape": "square",
    "reference.velocity_mps": [0.1, 0.1],
    "reference.points_m": [[0.0, 0.0], [2.0, 0.0]],
    "reference.loop": True,
    "vehicle.kind": "quadrotor",
    "vehicle.report": "deviation(0.1)",
    "link.heartbeat_s": 0.2,
    "vehicle.address": "tcp:127.0.0.1:5760",
    "vehicle.frame": "crazyflie",
    "vehicle.battery": 0.5,
    "fence.low_m": [-50.0, -50.0],
    "fence.high_m": [50.0, 50.0],
    "fence.radius_m": 50.0,
    "fence.speed_mps": 10.0,
    "mavlink.takeoff_m": 5.0,
    "mavlink.origin": "autopilot",
    "mavlink.second_commander": "yield",
    "ros2.odometry": "/robot/odom",
    "ros2.command": "/robot/cmd_vel",
    "ros2.stamped": False,
    "ros2.drive": "differential",
    "ros2.origin": "odometry",
    "link.time_of_day": "host",
    "vehicle.exhausted": "hold",
    "vehicle.memory": "none",
    "vehicle.on_loss": "return",
    "vehicle.tau_s": [0.5],
    "vehicle.gain": 0.9,
    "vehicle.dead_time_s": 0.1,
    "vehicle.start_m": [1.0, 1.0],
    "vehicle.steady_wind_mps": [0.1, 0.1],
    "network.uplink": "constant(0.1)",
    "network.downlink": "loss(0.1)",
    "title": "another",
    "armed": False,
}
"""Another value of each key that is no number, or is restricted."""


ON_MISSION = reading.load("swap")
MISSION: dict[str, Any] = {
    "mission.separation_m": 0.6,
    "mission.height_m": 1.0,
    "mission.tube_m": 0.1,
    "mission.speed_mps": 0.5,
    "mission.acceleration_mps2": 0.4,
    "mission.allocate": True,
    "mission.goals": "goal(2, 5.5, 1)",
    "mission.zones": "fence(-9, 9, -9, 9)",
}
"""Another value of each key of `mission`."""


ALL = dict(flat(reading.to_table(HERE)))


def with_(key: str, value: Any) -> Scenario:
    table = reading.to_table(HERE)
    set_keys({key: value}, table)
    if key == "model.axes":
        table["reference"]["points_m"] = ()
    return reading.check(table, "there")


def differing(key: str, folder: Path) -> tuple[Scenario, Scenario]:
    if key == "reference.file":
        made = []
        for name, end in (("one", 1.0), ("other", 2.0)):
            file = folder / f"{name}.csv"
            file.write_text(f"t,x,y\n0,0,0\n9,{end},0\n")
            table = reading.to_table(HERE)
            table["reference"] |= {"shape": "csv", "file": str(file)}
            made.append(reading.check(table, name))
        return made[0], made[1]
    if key == "model.axes":
        return msgspec.structs.replace(
            HERE, reference=msgspec.structs.replace(HERE.reference, points_m=())
        ), with_(key, 3)
    if key.startswith("mission."):
        table = reading.to_table(ON_MISSION)
        set_keys({key: MISSION[key]}, table)
        return ON_MISSION, reading.check(table, "there")
    if key == "control.planner":
        PLANNERS.add(lambda problem: problem, "own")
    value = OTHER.get(key)
    if value is None:
        here = ALL[key]
        value = [each * 1.1 for each in here] if isinstance(here, list | tuple) else here
        if isinstance(here, int | float) and not isinstance(here, bool):
            value = here + 1 if isinstance(here, int) else (here or 0.1) * 1.1
    return HERE, with_(key, value)


def shake_hands(ours: Scenario, theirs: Scenario) -> tuple[Server, Client]:
    server = Server(ours, boot_id=7, entropy=stream(1, "entropy").bytes)
    client = Client(theirs, simulated(theirs, 1), server=("server", 0), vehicle=1, boot_id=9)
    client.wake(now_ns=0)
    for payload, _, _ in client.outbox():
        server.receive(Datagram(payload, ("vehicle", 1)), now_ns=SECOND_NS)
    for payload, _, _ in server.outbox():
        client.receive(Datagram(payload, ("server", 0)), now_ns=2 * SECOND_NS)
    return server, client


def test_every_key_is_a_term_or_free_to_differ() -> None:
    """A key of both ends is a term, and each term has one key."""
    assert set(ALL) == set(KEYS)
    of_both = [name for name, key in KEYS.items() if key.owner is Owner.BOTH]
    assert sorted(TERMS.values()) == sorted(of_both)
    assert set(TERMS) == set(Terms._fields)


def test_each_term_differs_by_its_own_key(tmp_path: Path) -> None:
    for key in TERMS.values():
        ours, theirs = differing(key, tmp_path)
        (difference,) = differences(ours.terms(), theirs.terms())[:1]
        assert key in (difference.key, "model.axes")
        assert difference.here != difference.there


@pytest.mark.parametrize("key", ["control.dt", "reference.file"])
def test_ends_that_differ_in_a_term_are_refused_and_told(key: str, tmp_path: Path) -> None:
    ours, theirs = differing(key, tmp_path)
    server, client = shake_hands(ours, theirs)
    (difference,) = differences(ours.terms(), theirs.terms())
    for text in (" ".join(map(str, server.events())), " ".join(map(str, client.events()))):
        assert key in text
        assert difference.here in text
        assert difference.there in text
    assert client.failure is not None
    assert client.finished
    assert not server.figures()["vehicles"]


def test_what_is_free_to_differ_changes_no_term(tmp_path: Path) -> None:
    for key in sorted(KEYS.keys() - TERMS.values() - {*DECISIONS}):
        ours, theirs = differing(key, tmp_path)
        assert ours != theirs
        assert ours.terms() == theirs.terms(), key


def test_ends_may_differ_in_what_is_free() -> None:
    _, client = shake_hands(HERE, with_("control.input_weight", 0.5))
    assert client.failure is None
    assert not client.finished
    assert client.next_wake_ns() is not None


def test_a_trajectory_is_compared_by_what_stands_in_its_file(tmp_path: Path) -> None:
    scenarios = []
    for name in ("here", "there"):
        file = tmp_path / f"{name}.csv"
        file.write_text("t,x,y\n0,0,0\n9,1,0\n")
        reference = {"shape": "csv", "file": str(file)}
        scenarios.append(reading.check({"reference": reference}, name))
    assert scenarios[0].terms() == scenarios[1].terms()
    elsewhere = reading.to_table(scenarios[1])
    elsewhere["reference"]["origin"] = [47.0, 8.0]
    assert scenarios[0].terms() != reading.check(elsewhere, "elsewhere").terms()


def test_a_difference_is_told_as_the_scenario_writes_it() -> None:
    here = HERE.terms()
    there = here._replace(dt_ns=20_000_000, tau_s=(0.5, 0.6), loop=True)
    assert differences(here, there) == (
        Difference("control.dt", "0.05", "0.02"),
        Difference("model.tau_s", "[0.84, 0.84]", "[0.5, 0.6]"),
        Difference("reference.loop", "false", "true"),
    )


def test_the_longest_terms_fit_one_datagram() -> None:
    terms = HERE.terms()._replace(tau_s=(math.pi,) * 3, u_max=(math.pi,) * 3, points="x" * 32)
    terms = terms._replace(scheme="x" * 32, exhausted="x" * 32, shape="x" * 32, table="x" * 32)
    assert len(encode(Hello(2**16 - 1, 2**64 - 1, terms))) <= PAYLOAD_BYTES_MAX


def test_the_documents_name_every_term_in_its_place() -> None:
    text = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
    section = text.split("## Terms")[1].split("## Rules")[0]
    named = re.findall(r"`([a-z_]+\.[a-z_0-9]+)`", section)
    assert named == [TERMS[field] for field in Terms._fields]


@pytest.mark.parametrize(
    ("scheme", "splines", "planned", "reach"),
    [
        ("none", False, 40, 40),
        ("predictive", False, 40, 40),
        ("committed", False, 40, 40),
        ("trajectory", True, 1, 60),
    ],
)
def test_what_follows_from_the_terms_of_a_scheme(
    scheme: str, splines: bool, planned: int, reach: int
) -> None:
    """Steps of 50 ms, H = 40, an age bound of 3 s, 60 steps, and braking at 2 m/s²."""
    agreed = (
        reading.load("demo")
        .terms()
        ._replace(scheme=scheme, dt_ns=50_000_000, horizon=40, age_max_s=3.0, brake_mps2=2.0)
    )
    assert (agreed.splines, agreed.planned, agreed.reach) == (splines, planned, reach)
    assert agreed.age_max == 60
    assert agreed.dt_s == 0.05
    assert agreed._replace(exhausted="brake").brake == pytest.approx(0.1)
    assert agreed._replace(exhausted="hold").brake == 0.0
