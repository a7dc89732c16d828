"""The kernel and its rooms: a flight of one vehicle over one link loads the kernel alone."""

import os
import shutil
import sys
from pathlib import Path

import pytest

import skytether
from helpers import ran

PACKAGE = Path(skytether.__file__).parent
LINES = 17_500
"""Largest number of lines that a flight of `demo` loads; each step towards the kernel lowers it."""
CALLS = 150
"""Largest number of Python calls that a step of a vehicle of `demo` takes in virtual time."""
LIVE_LINES = 2000
"""Largest number of lines of the shell's driver and sockets that a live process loads."""
FLIES = "fly demo --virtual"
ROOMS: dict[str, tuple[str, str]] = {
    # places in the package, and a command that needs them
    "missions, the planner": ("server/missions", "fleet swap --virtual"),
    "missions, in a scenario": ("shared/missions", f"{FLIES} --reference.shape swap"),
    "formats": ("shared/formats", f"{FLIES} --reference.shape csv"),
    "further triggers": (
        "server/triggers/further.py",
        f"{FLIES} --control.trigger deviation(0.1)",
    ),
    "fence": ("shared/fence client/fence.py", f"{FLIES} --fence.radius-m 5"),
    "several paths": (
        (
            "client/paths.py server/paths.py shared/wire/paths.py shared/wire/path_proof.py "
            "shared/events/paths.py"
        ),
        "fly demo-two-links --virtual",
    ),
    "a standby server": (
        "client/standby shared/wire/lead.py shared/events/standby.py sim/standby.py",
        f"{FLIES} --standby",
    ),
    "several addresses": ("client/several.py", f"{FLIES} --standby"),
    "saved state": ("client/memory.py", "client demo --vehicle.memory saved --server localhost:9"),
    "keys": (
        (
            "client/secure.py server/secure.py shared/wire/keys.py shared/wire/handshake.py "
            "shared/wire/channel.py shared/wire/noise_nnpsk0.py"
        ),
        f"{FLIES} --secure",
    ),
    "committed": ("server/schemes/committed.py", f"{FLIES} --control.scheme committed"),
    "predictive": ("server/schemes/predictive.py", "fly paper --virtual"),
    "horizons of inputs": (
        (
            "client/horizons.py shared/scenario/horizons.py "
            "server/schemes/horizons.py server/schemes/predictive.py "
            "server/schemes/committed.py server/mpc/hierarchical.py server/mpc/appraisal.py"
        ),
        "fly paper --virtual",
    ),
    "queues": (
        "netem/bottleneck.py netem/impairments/queues.py",
        f"{FLIES} --network.uplink rate(9000)",
    ),
    "traces": ("netem/impairments/traces.py", f"{FLIES} --network.uplink trace('a.csv')"),
    "a shared rate": (
        "server/budget.py",
        f"{FLIES} --control.shared-bytes-per-s 1000",
    ),
    "an autopilot": ("client/mavlink", "client demo --vehicle.kind mavlink"),
    "ROS 2": ("client/ros2 ros2", "client demo --vehicle.kind ros2"),
    "a quadrotor": (
        "quadrotor client/simulated/quadrotor.py",
        f"{FLIES} --vehicle.kind quadrotor",
    ),
    "the stand-in of an autopilot": ("autopilot", "autopilot demo"),
    "the page": ("view/page view/browser", "page folder"),
    "recordings": ("view/recordings", "report a.mcap"),
    "the probe": ("probe", "probe localhost:1"),
    "policies far away": ("policy", "policy join localhost:1 --actions delta"),
    "the laboratory": ("lab", "sweep demo"),
    "the laboratory's engine": ("lab/engine", "sweep demo"),
    "the laboratory's pages": ("lab/pages", "reproduce"),
    "the laboratory's commands": ("lab/commands", "compare"),
    "identification": ("lab/identify", "identify quadrotor"),
    "explanations": ("explain", "explain demo"),
    "the theorem of missions": ("theorem", "explain swap"),
    "figures": ("figures", "reproduce"),
    "environments": ("gym", ""),
    "the library": ("library", ""),
    "plug-ins": (
        (
            "server/schemes/plugins.py server/schemes/guarded.py server/mpc/plugin_planners.py "
            "server/triggers/guarded.py netem/impairments/guarded.py"
        ),
        "",
    ),
}

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
LOAD_ALL = """
import skytether.client.__main__, skytether.netem.__main__, skytether.server.__main__
from skytether.server.schemes import loading

loading.load_all()
"""


def loaded(at: Path | None) -> dict[str, int]:
    """Number of lines of each module that a flight of `demo` loads, from a package at a place."""
    flown = ran(sys.executable, "-P", "-c", FLY, env=environment(at) if at else None)
    assert flown.returncode == 0, flown.stderr
    pairs = (line.split() for line in flown.stdout.splitlines())
    return {name: int(lines) for name, lines in pairs}


def environment(at: Path) -> dict[str, str]:
    kernels = at.parent / "kernels"  # of all these copies, which have the same
    return {**os.environ, "PYTHONPATH": str(at), "NUMBA_CACHE_DIR": str(kernels)}


def test_a_flight_of_one_vehicle_loads_no_room_and_few_lines() -> None:
    lines = loaded(None)
    rooms = {
        f"skytether.{place.removesuffix('.py').replace('/', '.')}"
        for places, _ in ROOMS.values()
        for place in places.split()
    }
    # A room's keys are read with every scenario.
    read = {f"{room}{part}" for room in rooms for part in ("", ".keys")}
    beside = tuple(f"{room}." for room in rooms)
    assert {each for each in lines if each in rooms or each.startswith(beside)} <= read
    assert sum(lines.values()) <= LINES


LIVE = """
import sys
import skytether.{name}.__main__

for name, module in sorted(sys.modules.items()):
    if name.startswith("skytether.shell.") and module.__file__:
        print(name, len(open(module.__file__).read().splitlines()))
"""


BESIDE = {"program", "inside", "connections", "stream", "graph", "control", "journal", "feed"}
BESIDE |= {"memory", "recorder_process", "preloading", "time_of_day"}


@pytest.mark.parametrize("name", ["client", "netem"])
def test_a_live_process_loads_a_driver_and_sockets_and_what_its_options_call_for(name: str) -> None:
    ran_it = ran(sys.executable, "-P", "-c", LIVE.format(name=name))
    assert ran_it.returncode == 0, ran_it.stderr
    lines = {module: int(count) for module, count in map(str.split, ran_it.stdout.splitlines())}
    assert not {each for each in lines if each.rpartition(".")[2] in BESIDE}
    drives = ("skytether.shell.driving.", "skytether.shell.host.")
    assert sum(lines[each] for each in lines if each.startswith(drives)) <= LIVE_LINES


COUNT = """
import sys
import msgspec
from skytether.shared.scenario import reading
from skytether.sim import flight

calls, seconds = 0, []

def count(frame, event, arg):
    global calls
    calls += event == "call"

demo = msgspec.structs.replace(reading.load("demo"), duration=4.0, settle=0.0)
sys.setprofile(count)
flight.fly(demo, on_second=lambda _: seconds.append(calls))
sys.setprofile(None)
print((seconds[-1] - seconds[-2]) * demo.control.dt)
"""


def test_a_step_of_a_vehicle_takes_few_calls() -> None:
    flown = ran(sys.executable, "-P", "-c", COUNT)
    assert flown.returncode == 0, flown.stderr
    assert float(flown.stdout) <= CALLS


CHANGE = """
import sys
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shell.processes.preloading import preload
from skytether.shared.scenario import reading

swap = reading.to_table(reading.load("swap"))
one = reading.check(swap, "swap")
netem = Proxy(one, server=("server", 0), flows=1)
server = Server(one, boot_id=1, entropy=bytes)
preload(server.changeable | netem.changeable)
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


PLUGIN = """
from skytether.plugin import Compared, Impairment, above, impairment, trigger

@trigger
def own(situation):
    return above(situation, Compared.EXPECTED_GAP, 0.1)

@impairment(name="own")
class Own(Impairment):
    def __call__(self, fate, draws):
        fate.delay_ns += 1
"""
REQUESTS = """
import sys
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.base.errors import ConfigError
from skytether.shell.processes.preloading import preload
from skytether.shared.endpoints.change import Running
from skytether.shared.scenario import reading
from skytether.shell.commandline import plugins

folder, plugin = sys.argv[1:]
plugins.load([plugin])
demo = reading.load("demo")
netem = Proxy(demo, server=("server", 0), flows=1)
server = Server(demo, boot_id=1, entropy=bytes)
preload(server.changeable | netem.changeable)
before = {*sys.modules}
for endpoint, key, value in (
    (server, "control.triger", "always"),
    (server, "control.trigger", 5),
    (server, "control.trigger", "periodic(x)"),
    (server, "control.trigger", "own"),
    (netem, "network.uplink", "own"),
    (netem, "network.uplink", f"trace('{folder}')"),
):
    try:
        Running(endpoint, demo).change({key: value}, now_ns=0)
        print(value)
    except ConfigError:
        pass
print(*sorted(name for name in {*sys.modules} - before if not name.startswith("encodings.")))
"""


def test_a_refused_change_and_one_to_a_plugin_import_nothing(tmp_path: Path) -> None:
    plugin = tmp_path / "own.py"
    plugin.write_text(PLUGIN)
    asked = ran(sys.executable, "-P", "-c", REQUESTS, str(tmp_path), str(plugin))
    assert (asked.stdout, asked.stderr) == ("own\nown\n\n", "")


MESSAGES = """
import sys
import msgpack
from skytether.shared.scenario import reading
from skytether.shared.wire import protocol
from skytether.shared.wire.drop import ProtocolError

terms = reading.load("demo").terms()
protocol.preload()
before = {*sys.modules}
for number in range(256):
    try:
        protocol.decode(msgpack.packb([protocol.VERSION, number, 1]), terms)
    except ProtocolError:
        pass
print(*sorted({*sys.modules} - before))
"""


def test_a_strangers_message_imports_nothing() -> None:
    heard = ran(sys.executable, "-P", "-c", MESSAGES)
    assert (heard.stdout, heard.stderr) == ("\n", "")


HANDSHAKE = """
import sys
from skytether.shared.wire.noise_nnpsk0 import Initiator, Responder

before = {*sys.modules}
hello = Initiator(bytes(32), b"", b"1" * 32, b"")
Responder(bytes(32), b"", hello.message).answer(b"2" * 32, b"")
print(*sorted({*sys.modules} - before))
"""


def test_a_handshake_imports_nothing() -> None:
    shaken = ran(sys.executable, "-P", "-c", HANDSHAKE)
    assert (shaken.stdout, shaken.stderr) == ("\n", "")


@pytest.mark.long
@pytest.mark.parametrize("room", ROOMS)
def test_the_kernel_flies_without_a_room(room: str, tmp_path: Path) -> None:
    """Deleted: all else flies, lists its commands, and says in a line what is not installed."""
    places, command = ROOMS[room]
    copy = tmp_path / "skytether"
    shutil.copytree(PACKAGE, copy, symlinks=False, ignore=shutil.ignore_patterns("__pycache__"))
    for place in places.split():
        at = copy / place
        shutil.rmtree(at) if at.is_dir() else at.unlink()
    assert loaded(tmp_path)
    every_module = (sys.executable, "-P", "-c", LOAD_ALL)
    assert ran(*every_module, env=environment(tmp_path)).returncode == 0
    flown = ran(*SKYTETHER, *FLIES.split(), "--duration", "5", env=environment(tmp_path))
    assert flown.returncode == 0, flown.stderr
    listed = ran(*SKYTETHER, "--help", env=environment(tmp_path))
    assert (listed.returncode, listed.stderr) == (0, "")
    if command:
        lacking = ran(*SKYTETHER, *command.split(), env=environment(tmp_path), cwd=tmp_path)
        assert (lacking.returncode, lacking.stdout) == (2, "")
        lines = lacking.stderr.splitlines()
        (line,) = [each for each in lines if not each.startswith("compiling")]
        assert "is not installed" in line
