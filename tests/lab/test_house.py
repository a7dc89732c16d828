"""Pictures of the code: they are those that the code gives today, and a wrong one is refused."""

import re
from pathlib import Path

import pytest

from skytether.lab.house import packet, rooms
from skytether.lab.house.__main__ import PICTURES
from skytether.lab.house.packet import DrawnCall, DrawnPart

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("name", PICTURES)
def test_the_committed_picture_is_the_codes(name: str) -> None:
    """`make pictures` would change nothing."""
    drawn = PICTURES[name]()
    assert (DOCS / name).read_text() == drawn, f"docs/{name} is out of date: run `make pictures`"


def test_a_room_imports_what_it_says() -> None:
    """Imports are read from the code: from a room, of a module by its name, and within shared."""
    found = rooms.imports()
    assert ("shared",) in found["client",]
    assert ("server",) not in found["client",]
    assert ("sim",) in found["library",]
    assert found["shared", "base"] == set()
    assert ("shared", "law") in found["shared", "wire"]


def test_an_arrow_that_a_longer_way_implies_is_left_out() -> None:
    """Arrows a → b → c stand for a → c as well."""
    a, b, c, d = ("a",), ("b",), ("c",), ("d",)
    edges = {a: {b, c, d}, b: {c}, c: set(), d: set()}
    assert rooms.reduced(edges) == {(a, b), (b, c), (a, d)}


def test_a_room_without_a_place_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is drawn without it."""
    without = {name: room for name, room in rooms.ROOMS.items() if name != "netem"}
    monkeypatch.setattr(rooms, "ROOMS", without)
    with pytest.raises(LookupError, match="differ in netem"):
        rooms.rooms_svg()


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (DrawnCall("client/nowhere.py: fly", ""), "client/nowhere.py is no file"),
        (DrawnCall("client/pilot.py: Pilot.swim", ""), "client/pilot.py has no Pilot.swim"),
        (
            DrawnCall(
                "netem/link.py: Link.take", "", (DrawnCall("netem/proxy.py: Proxy.wake", ""),)
            ),
            "netem/link.py: Link.take does not call wake",
        ),
    ],
)
def test_a_way_that_the_code_does_not_go_is_refused(
    call: DrawnCall, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A function that is gone, and one that calls another no more."""
    monkeypatch.setattr(packet, "WAY", (DrawnPart("wrong", 0, 0, (call,)),))
    with pytest.raises(LookupError, match=told):
        packet.packet_svg()


def test_a_call_through_a_method_of_the_same_class_counts() -> None:
    """`Pilot.fly` asks for measurements in `Pilot._navigate`."""
    assert "measurements" in packet.called("client/pilot.py: Pilot.fly")


def test_the_picture_and_the_words_name_the_same_functions() -> None:
    """Those of docs/design.md, "Following a packet"."""
    text = (DOCS / "design.md").read_text()
    section = text.partition("## Following a packet")[2].partition("\n## ")[0]
    told = set(re.findall(r"`([\w/]+\.py: [\w.]+)`", section))
    assert told == {call.where for call in packet.functions()}
