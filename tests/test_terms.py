"""Terms of a flight: for every key of a scenario, two ends differ and are told, or may differ."""

import math
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from client.plant import FirstOrderPlant
from client.vehicle import Client
from lab.keys import flat, lay
from server.endpoint import Server
from shared import config
from shared.chance import stream
from shared.config import Scenario
from shared.endpoint import SECOND_NS, Datagram
from shared.events import Difference
from shared.protocol import PAYLOAD_BYTES_MAX, Hello, encode
from shared.terms import FREE, KEYS

HERE = config.check(
    {
        "model": {"axes": 2},
        "control": {"horizon": 50, "trigger": "state_gap | silence(1)"},
        "reference": {"points_m": [[0.0, 0.0], [1.0, 0.0]]},
    },
    "here",
)
"""What the server flies, with as little as possible that forbids a single change."""
OTHER: dict[str, Any] = {
    "model.axes": 3,
    "control.scheme": "predictive",
    "control.feedback": False,
    "reference.preview": 1.0,
    "sensor.filter": "none",
    "sensor.position_bias_m": [0.1, 0.1],
    "sensor.velocity_bias_mps": [0.1, 0.1],
    "sensor.velocity_every_s": 1.0,
    "control.delay_bound": 0.5,
    "control.trigger": "always",
    "control.solver": "osqp",
    "control.input_reference": False,
    "reference.shape": "square",
    "reference.velocity_mps": [0.1, 0.1],
    "reference.points_m": [[0.0, 0.0], [2.0, 0.0]],
    "reference.loop": True,
    "vehicle.exhausted": "hold",
    "vehicle.tau_s": [0.5],
    "vehicle.start_m": [1.0, 1.0],
    "vehicle.steady_wind_mps": [0.1, 0.1],
    "network.uplink.delay": "none",
    "network.downlink.delay": "none",
    "title": "another",
    "armed": False,
}
"""Another value of the keys that are no numbers, or that not every number may be."""


ALL = dict(flat(config.to_table(HERE)))
"""Every key of a scenario with dots, and its value."""


def with_(key: str, value: Any) -> Scenario:
    """The scenario with one key changed."""
    table = config.to_table(HERE)
    lay({key: value}, table)
    if key == "model.axes":
        table["reference"]["points_m"] = ()
    return config.check(table, "there")


def differing(key: str, folder: Path) -> tuple[Scenario, Scenario]:
    """Two scenarios that differ in this key."""
    if key == "reference.file":
        made = []
        for name, end in (("one", 1.0), ("other", 2.0)):
            file = folder / f"{name}.csv"
            file.write_text(f"t,x,y\n0,0,0\n9,{end},0\n")
            table = config.to_table(HERE)
            table["reference"] |= {"shape": "csv", "file": str(file)}
            made.append(config.check(table, name))
        return made[0], made[1]
    if key == "model.axes":
        return msgspec.structs.replace(
            HERE, reference=msgspec.structs.replace(HERE.reference, points_m=())
        ), with_(key, 3)
    value = OTHER.get(key)
    if value is None:
        here = ALL[key]
        value = [each * 1.1 for each in here] if isinstance(here, list | tuple) else here
        if isinstance(here, int | float) and not isinstance(here, bool):
            value = here + 1 if isinstance(here, int) else (here or 0.1) * 1.1
    return HERE, with_(key, value)


def shake_hands(ours: Scenario, theirs: Scenario) -> tuple[Server, Client]:
    """A server of one scenario and a client of another, after HELLO and WELCOME."""
    server = Server(ours, boot_id=7, entropy=stream(1, "entropy").bytes)
    plant = FirstOrderPlant(theirs, stream(1, "wind"))
    client = Client(theirs, plant, server=("server", 0), vehicle=1, boot_id=9)
    client.wake(now_ns=0)
    for payload, _, _ in client.outbox():
        server.receive(Datagram(payload, ("vehicle", 1)), now_ns=SECOND_NS)
    for payload, _, _ in server.outbox():
        client.receive(Datagram(payload, ("server", 0)), now_ns=2 * SECOND_NS)
    return server, client


def test_every_key_is_a_term_or_free_to_differ() -> None:
    """There is no third kind, and none is both."""
    assert set(ALL) == set(KEYS.values()) | set(FREE)
    assert not set(KEYS.values()) & set(FREE)


@pytest.mark.parametrize("key", [key for key in ALL if key in KEYS.values()])
def test_ends_that_differ_in_a_term_are_refused_and_told(key: str, tmp_path: Path) -> None:
    """Both operators read the key and both values; no session is opened."""
    ours, theirs = differing(key, tmp_path)
    server, client = shake_hands(ours, theirs)
    (difference,) = ours.terms().differences(theirs.terms())[:1]
    assert key in (difference.key, "model.axes")
    assert difference.here != difference.there
    for told in (" ".join(map(str, server.events())), " ".join(map(str, client.events()))):
        assert key in told
        assert difference.here in told
        assert difference.there in told
    assert client.failure is not None
    assert client.finished
    assert not server.figures()["vehicles"]


@pytest.mark.parametrize("key", [key for key in ALL if key in FREE])
def test_ends_may_differ_in_what_is_free(key: str, tmp_path: Path) -> None:
    """The vehicle flies."""
    ours, theirs = differing(key, tmp_path)
    assert ours != theirs
    _, client = shake_hands(ours, theirs)
    assert client.failure is None
    assert not client.finished
    assert client.next_wake_ns() is not None


def test_a_trajectory_is_compared_by_what_stands_in_its_file(tmp_path: Path) -> None:
    """Wherever it lies on either machine."""
    scenarios = []
    for name in ("here", "there"):
        file = tmp_path / f"{name}.csv"
        file.write_text("t,x,y\n0,0,0\n9,1,0\n")
        reference = {"shape": "csv", "file": str(file)}
        scenarios.append(config.check({"reference": reference}, name))
    assert scenarios[0].terms() == scenarios[1].terms()


def test_a_difference_is_told_as_the_scenario_writes_it() -> None:
    """Seconds for the step, lists for axes, true and false."""
    here = HERE.terms()
    there = here._replace(dt_ns=20_000_000, tau_s=(0.5, 0.6), loop=True)
    assert here.differences(there) == (
        Difference("control.dt", "0.05", "0.02"),
        Difference("model.tau_s", "[0.84, 0.84]", "[0.5, 0.6]"),
        Difference("reference.loop", "false", "true"),
    )


def test_the_longest_terms_fit_one_datagram() -> None:
    """Three axes, and texts as long as they may be."""
    terms = HERE.terms()._replace(tau_s=(math.pi,) * 3, u_max=(math.pi,) * 3, points="x" * 32)
    terms = terms._replace(scheme="x" * 32, exhausted="x" * 32, shape="x" * 32, table="x" * 32)
    assert len(encode(Hello(2**16 - 1, 2**64 - 1, terms))) <= PAYLOAD_BYTES_MAX


def test_the_documented_tables_name_every_key() -> None:
    """The terms in the order on the wire, and all others with whose they are."""
    text = (Path(__file__).parent.parent / "docs" / "protocol.md").read_text()
    terms, free = text.split("## Terms")[1].split("## Rules")[0].split("All other keys")
    assert re.findall(r"^\| `([a-z_.0-9]+)` \|", terms, re.MULTILINE) == list(KEYS.values())
    rows = re.findall(r"^\| (`.*`) \| (.*) \|$", free, re.MULTILINE)
    assert {key: whose for keys, whose in rows for key in re.findall("`(.*?)`", keys)} == FREE
