"""The kernel and its rooms: a flight of one vehicle over one link loads the kernel alone."""

import os
import shutil
import sys
from pathlib import Path

import pytest

import skytether
from helpers import ran

PACKAGE = Path(skytether.__file__).parent
LINES = 19_900
"""Largest number of lines that a flight of `demo` loads; each step towards the kernel lowers it."""
FLIES = "fly demo --virtual"
ROOMS = {
    "shared/formats": f"{FLIES} --reference.shape csv",
    "shared/missions": f"{FLIES} --reference.shape swap",
    "server/missions": "fleet swap --virtual",
    "server/triggers/further.py": f"{FLIES} --control.trigger deviation(0.1)",
}
"""Folder or module of each room, and a command that needs it."""

SKYTETHER = (sys.executable, "-P", "-m", "skytether")
FLY = """
import sys
import msgspec
from skytether.shared.scenario import reading
from skytether.sim import flight

flight.fly(msgspec.structs.replace(reading.load("demo"), duration=1.0))
for name, module in sorted(sys.modules.items()):
    if name.startswith("skytether") and getattr(module, "__file__", None):
        print(name, len(open(module.__file__).read().splitlines()))
"""


def loaded(at: Path | None) -> dict[str, int]:
    """Number of lines of each module that a flight of `demo` loads, from a package at a place."""
    flown = ran(sys.executable, "-P", "-c", FLY, env=environment(at) if at else None)
    assert flown.returncode == 0, flown.stderr
    pairs = (line.split() for line in flown.stdout.splitlines())
    return {name: int(lines) for name, lines in pairs}


def environment(at: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(at), "NUMBA_CACHE_DIR": str(at / "kernels")}


def test_a_flight_of_one_vehicle_loads_no_room_and_few_lines() -> None:
    lines = loaded(None)
    rooms = tuple(f"skytether.{place.removesuffix('.py').replace('/', '.')}" for place in ROOMS)
    # A room's keys are read with every scenario.
    read = {f"{room}{part}" for room in rooms for part in ("", ".keys")}
    assert {name for name in lines if name.startswith(rooms)} <= read
    assert sum(lines.values()) <= LINES


CHANGE = """
import sys
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.scenario import reading, rooms

swap = reading.to_table(reading.load("swap"))
one = reading.check(swap, "swap")
netem = Proxy(one, server=("server", 0), flows=1)
server = Server(one, boot_id=1, entropy=bytes)
rooms.preload(server.changeable | netem.changeable)
before = {*sys.modules}
swap["network"]["uplink"] = "rate(9000) & uniform(0.1, 0.2)"
swap["mission"]["zones"] = "box(9, 10, 9, 10)"
other = reading.check(swap, "swap")
netem.change(other, frozenset({"network.uplink"}), now_ns=0)
server.change(other, frozenset({"mission.zones"}), now_ns=0)
print(*sorted({*sys.modules} - before))
"""


def test_a_change_in_flight_imports_nothing() -> None:
    changed = ran(sys.executable, "-P", "-c", CHANGE)
    assert (changed.stdout, changed.stderr) == ("\n", "")


@pytest.mark.long
@pytest.mark.parametrize("room", ROOMS)
def test_the_kernel_flies_without_a_room(room: str, tmp_path: Path) -> None:
    copy = tmp_path / "skytether"
    shutil.copytree(PACKAGE, copy, symlinks=False, ignore=shutil.ignore_patterns("__pycache__"))
    place = copy / room
    shutil.rmtree(place) if place.is_dir() else place.unlink()
    assert loaded(tmp_path)
    lacking = ran(*SKYTETHER, *ROOMS[room].split(), env=environment(tmp_path))
    assert (lacking.returncode, lacking.stdout) == (2, "")
    assert "is not installed" in lacking.stderr
    assert len(lacking.stderr.splitlines()) == 1
