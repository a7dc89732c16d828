"""Imports of commands, which take most of their start: no module that the command can do without.

`python -m bench --only starting` measures the time.
"""

import sys

import pytest

from helpers import ran

MODULES = """
import signal, sys
from skytether.__main__ import main
from skytether.shell.processes import log

def listens(self, event):
    signal.raise_signal(signal.SIGTERM)

if sys.argv[1] in ("server", "client", "netem"):
    log.Log.say = listens
main(sys.argv[1:])
print("imported:", *sys.modules)
"""
HEAVY = {
    "cryptography",
    "jinja2",
    "matplotlib",
    "numba",
    "osqp",
    "rich",
    "scipy",
    "tyro",
    "viser",
    "websockets",
}
EXTRAS = {
    "importlib.metadata",
    "mcap",
    "prometheus_client",
    "skytether.server.endpoint",
    "skytether.server.planning",
}
"""Modules that cost memory and time before the first packet, and that only some options need."""
COMPILER = {"scipy.linalg", "numba.np.linalg"}
"""Modules that numba imports to compile, but not to load compiled code."""


def imported(*argv: str) -> set[str]:
    """Modules that a command has imported at its end; a server or client ends once it listens."""
    done = ran(sys.executable, "-P", "-c", MODULES, *argv)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.rpartition("imported: ")[2].split())


FLIES = ["client demo --model.tau-s 1 1", "netem demo --bind 127.0.0.1:0"]


@pytest.mark.parametrize(
    "command", [pytest.param("list scenarios", marks=pytest.mark.long), *FLIES]
)
def test_what_is_light_imports_nothing_heavy(command: str) -> None:
    modules = imported(*command.split())
    assert "skytether.shell.commandline.command" in modules
    assert modules & (HEAVY | EXTRAS if command in FLIES else HEAVY) == set()


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["demo", "paper"])
def test_a_server_imports_its_own_solver_and_no_ciphers_without_keys(scenario: str) -> None:
    """The server needs numba, which imports the package scipy to ask its version."""
    modules = imported("server", scenario, "--bind", "127.0.0.1:0")
    assert "numba" in modules
    assert modules & (HEAVY | {"scipy.sparse"}) <= {"numba", "scipy"}
    assert modules & COMPILER == set()


def test_a_flight_in_virtual_time_draws_encrypts_and_compiles_nothing() -> None:
    modules = imported("fly", "demo", "--virtual", "--duration", "1")
    assert "numba" in modules
    assert modules & HEAVY <= {"numba", "rich", "scipy"}
    assert modules & COMPILER == set()
