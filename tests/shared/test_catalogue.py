"""Catalogue of a scenario's keys: their owners, which change in flight, and the page of all."""

import re
import typing
from pathlib import Path
from typing import Annotated

import pytest

from skytether.client.simulated.vehicle import SimulatedVehicle
from skytether.lab import keys_document
from skytether.netem.__main__ import emulate
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import GOALS, POINT, TRIGGER, ZONES
from skytether.shared.scenario.catalogue import KEYS, keys, keys_of
from skytether.shared.scenario.owners import InFlight, Key, OfServer, Owner
from skytether.shared.scenario.schema import Scenario, Section, Strength
from skytether.shared.wire.protocol import INPUTS_MAX

DOCS = Path(__file__).parents[2] / "docs"


class Free(Section, frozen=True):
    """A key that names no owner."""

    wind: Strength = 0.0


class Shared(Section, frozen=True):
    """A key that names two."""

    wind: OfServer[Annotated[float, Key(Owner.VEHICLE)]] = 0.0


@pytest.mark.parametrize("section", [Free, Shared])
def test_a_key_without_one_owner_is_a_mistake(section: type[Section]) -> None:
    """It is told by its name, as soon as the catalogue is made."""
    with pytest.raises(AssertionError, match=r"air\.wind: expected one owner"):
        dict(keys(section, "air."))


def test_the_documented_keys_change_in_flight() -> None:
    """Exactly those in the table of docs/operating.md, at each socket."""
    text = (DOCS / "operating.md").read_text()
    rows = re.findall(r"^\| (server|netem|client) \| (.*) \|$", text, re.MULTILINE)
    named = {socket: set(re.findall("`([a-z_.0-9]+)`", keys)) for socket, keys in rows}
    assert named["server"] == TRIGGER | POINT | ZONES | GOALS
    assert named["client"] == SimulatedVehicle.changeable | keys_of(
        InFlight.ARMED, InFlight.LEAP, InFlight.ORIGIN
    )
    assert named["netem"] == {"network.uplink", "network.downlink"}
    assert Proxy.changeable == {
        name for name in KEYS if name.startswith(("network.uplink.", "network.downlink."))
    }


def test_the_page_of_all_keys_is_up_to_date() -> None:
    """It is what `make keys` writes, with one row for each key."""
    text = keys_document.document()
    assert sorted(re.findall(r"^\| `(.*?)` \|", text, re.MULTILINE)) == sorted(KEYS)
    assert (DOCS / "keys.md").read_text() == text, "docs/keys.md is out of date: run `make keys`"


def test_a_row_tells_unit_values_default_and_owner() -> None:
    """One of each kind of value; a bar does not end its cell."""
    rows = re.findall(r"^\| `(.*?)` \|(.*)$", keys_document.document(), re.MULTILINE)
    told = {key: [cell.strip() for cell in cells.split(" | ")][:5] for key, cells in rows}
    assert told["control.dt"] == ["s", "0.001 to 1", "`0.05`", "both ends", ""]
    assert told["link.age_max_s"][1] == "more than 0 to 60"
    assert told["control.horizon"][1] == f"whole number, 1 to {INPUTS_MAX}"
    assert told["control.delay_bound"][1:3] == ['0 to 3600 or `"auto"`', '`"auto"`']
    assert told["control.terminal_weight"][:2] == ["1/m², s²/m²", "2 numbers, 0 to 1e9"]
    assert told["vehicle.wind"] == ["m/s per √s", "0 to 1000", "`0.0`", "vehicle", "yes"]
    assert told["reference.points_m"][1] == "list of lists of numbers, -1e6 to 1e6"
    assert told["armed"][1:4] == ["`true`, `false`", "`true`", "vehicle"]
    assert told["control.trigger"][2] == r'`"expected_gap \| heartbeat"`'


def test_help_has_the_sentences_of_the_page(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both read a key's docstring."""
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        emulate(["--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for name in ("control", "vehicle", "sensor", "link"):
        sentences = keys_document.sentences(typing.get_type_hints(Scenario)[name])
        for key, sentence in sentences.items():
            assert sentence in shown, f"{name}.{key}"
