"""Catalogue of a scenario's keys: their owners, those changeable in flight, and docs/keys.md."""

import re
import typing
from pathlib import Path
from typing import Annotated

import pytest

from skytether.client.mavlink.keys import ORIGIN
from skytether.client.simulated.vehicle import SimulatedVehicle
from skytether.lab.pages import keys_document
from skytether.netem.__main__ import emulate
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import POINT, TRIGGER
from skytether.server.missions.mission_planner import GOALS, ZONES
from skytether.shared.base.meanings import meanings
from skytether.shared.endpoints.other_directions import RELAY, RUN
from skytether.shared.scenario.catalogue import KEYS, keys, keys_of
from skytether.shared.scenario.owners import InFlight, Key, OfServer, Owner
from skytether.shared.scenario.schema import Section, Strength
from skytether.shared.scenario.whole import Scenario

DOCS = Path(__file__).parents[2] / "docs"


class Free(Section, frozen=True):
    wind: Strength = 0.0


class Shared(Section, frozen=True):
    wind: OfServer[Annotated[float, Key(Owner.VEHICLE)]] = 0.0


@pytest.mark.parametrize("section", [Free, Shared])
def test_a_key_without_one_owner_is_a_mistake(section: type[Section]) -> None:
    with pytest.raises(AssertionError, match=r"air\.wind: expected one owner"):
        dict(keys(section, "air."))


def test_the_documented_keys_change_in_flight() -> None:
    text = (DOCS / "operating.md").read_text()
    rows = re.findall(r"^\| (server|netem|client) \| (.*) \|$", text, re.MULTILINE)
    named = {socket: set(re.findall("`([a-z_.0-9]+)`", keys)) for socket, keys in rows}
    assert named["server"] == TRIGGER | POINT | ZONES | GOALS
    assert named["client"] == SimulatedVehicle.changeable | keys_of(
        InFlight.ARMED, InFlight.LEAP, "leader", ORIGIN
    )
    assert Proxy.changeable == {"network.uplink", "network.downlink"}
    assert named["netem"] == Proxy.changeable | {*RELAY, *RUN}


def test_the_page_of_all_keys_is_up_to_date() -> None:
    text = keys_document.document()
    assert sorted(re.findall(r"^\| `(.*?)` \|", text, re.MULTILINE)) == sorted(KEYS)
    assert (DOCS / "keys.md").read_text() == text, "docs/keys.md is out of date: run `make keys`"


def test_help_has_the_sentences_of_the_page(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        emulate(["--help-keys"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for name in ("control", "vehicle", "sensor", "link"):
        sentences = meanings(typing.get_type_hints(Scenario)[name])
        for key, sentence in sentences.items():
            assert sentence in shown, f"{name}.{key}"
