"""Cache of compiled kernels: valid as long as all sources of a kernel are unchanged."""

import linecache
import resource
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import config as numba_config

from skytether.server.schemes import loading
from skytether.shared.base import files, kernel
from skytether.shared.scenario import reading
from skytether.shell.host.compiling import LOCK

HELPER = """
from typing import NamedTuple
from skytether.shared.base.kernel import F1, inline

FACTOR = 2

class Given(NamedTuple):
    values: F1

@inline
def scaled(x):
    return x * FACTOR
"""
CALLER = """
import numpy as np
from helper import Given, scaled
from skytether.shared.base.kernel import kernel

@kernel
def double(given: Given) -> None:
    values = given.values
    for i in range(len(values)):
        values[i] = scaled(values[i])

values = np.ones(1)
double(Given(values))
print(values[0], sum(double.dispatcher.stats.cache_hits.values()))
"""
HELP = """
import sys
from skytether.__main__ import COMMANDS, main
for line in [f"{name} --help" for name in COMMANDS] + sys.argv[1:]:
    try:
        code = main(line.split())
    except SystemExit as ended:
        code = ended.code
    assert code == (2 if line in sys.argv else 0), (line, code)
"""
REFUSED = (
    "fly nosuch --virtual",
    "fly demo --virtual --control.horizon 0",
    "fleet --virtual --workers 2",
    "margins demo --runs 0",
    "reproduce --runs 0",
    "sweep demo --out x --grid control.horizon=0",
    "server demo --bind 0.0.0.0:0 --no-such-flag",
    "server demo --bind 0.0.0.0:0",
    "server demo --bind 127.0.0.1:0 --keys no-such-file",
    "server demo --bind 0.0.0.0:0 --workers 2 --keys no-such-file",
)
PREPARED = """
import caller
from skytether.shared.base import machine_code
from skytether.shell.commandline.terminal import prepare
prepare(machine_code.missing())
"""


SIDE_BY_SIDE = """
import os, sys, time
import caller, second
from skytether.shared.base import machine_code
from skytether.shell.host.compiling import compile_kernels

os.sched_getaffinity = lambda _: {0, 1}
if sys.argv[1:] == ["alone"]:
    sys.executable = "/bin/false"
done = []
kernels = machine_code.missing()

def after_the_helper(each):
    def compile():
        while sys.argv[1:] == ["helped"] and not done:
            time.sleep(0.01)
        each.compile()
    return each._replace(compile=compile)

compile_kernels([after_the_helper(each) for each in kernels], lambda: done.append(1))
for each in (caller.double, second.double):
    print(sum(each.dispatcher.stats.cache_hits.values()), len(each.dispatcher.overloads))
print([each.name for each in kernels], len(done), machine_code.missing())
"""


def put(folder: Path, helper: str = HELPER, caller: str = CALLER) -> Path:
    (folder / "helper.py").write_text(helper)
    (folder / "caller.py").write_text(caller)
    return folder


MODULE = CALLER.split("\nvalues = ", maxsplit=1)[0]
"""The caller's kernel without the call."""


def run(folder: Path) -> str:
    """Output of the caller: the result, and 1 if its machine code came from the disk."""
    done = subprocess.run(
        [sys.executable, "caller.py"],
        cwd=folder,
        env={
            "PYTHONPATH": f"{Path(__file__).parents[2]}:{folder}",
            "HOME": str(folder),
            "PYTHONDONTWRITEBYTECODE": "1",  # Python would leave a truncated .pyc
        },
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


# -- within one process --------------------------------------------------------------------------

FILLING = """
from skytether.shared.base.kernel import F1, kernel

@kernel
def fill(values: F1) -> None:
    values[0] = 2.0
"""


@pytest.fixture
def imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Any]:
    """Each call imports a text as a new process would, always under the same name."""
    monkeypatch.setattr(kernel, "KERNELS", [])
    monkeypatch.setattr(numba_config, "CACHE_DIR", "")
    # On a full disk Python would leave a truncated .pyc.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    file = tmp_path / "filling.py"

    def imported(text: str) -> Any:
        file.write_text(text)
        linecache.checkcache(str(file))
        spec = spec_from_file_location("filling", file)
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "filling", module)
        spec.loader.exec_module(module)
        return module

    return imported


def fills(fill: Any) -> int:
    """Call a kernel that must work; returns whether its machine code came from the disk."""
    values = np.ones(1)
    fill(values)
    assert values[0] == 2.0
    return sum(fill.dispatcher.stats.cache_hits.values())


def test_a_kernel_that_cannot_be_stored_works_and_is_stored_later(
    imported: Callable[[str], Any],
) -> None:
    """Files cannot grow beyond 100 bytes at first, as on a full disk."""
    first, second, third, fourth = (imported(FILLING).fill for _ in range(4))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        hits = fills(first)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert hits == 0
    assert [fills(second), fills(third)] == [0, 1]
    for wrong in (np.ones(1, np.float32), np.ones((2, 2)), np.ones(4)[::2]):
        with pytest.raises(TypeError):
            fourth(wrong)


def test_a_kernel_without_a_writable_folder_works(
    imported: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel.CacheFolders, "_locator_classes", ())
    assert fills(imported(FILLING).fill) == 0


CALLING = """
FACTOR = 2

def scaled(x: float) -> float:
    return x * FACTOR

def calls(x: float) -> float:
    return scaled(x)
"""


def test_a_kernel_is_stamped_with_all_that_it_uses(imported: Callable[[str], Any]) -> None:
    """A constant and the source of a function that it calls."""

    def stamp(text: str) -> str:
        return kernel.stamp(imported(text).calls)

    same, *others = map(
        stamp, (CALLING, CALLING.replace("= 2", "= 37"), CALLING.replace("*", "+ 1 *"))
    )
    assert stamp(CALLING) == same
    assert len({same, *others}) == 3


# -- in processes of their own -------------------------------------------------------------------


@pytest.mark.long
def test_a_kernel_is_compiled_anew_when_what_it_calls_has_changed(tmp_path: Path) -> None:
    assert run(put(tmp_path)) == "2.0 0"
    assert run(tmp_path) == "2.0 1"
    assert run(put(tmp_path, HELPER.replace("FACTOR = 2", "FACTOR = 3"))) == "3.0 0"
    assert run(put(tmp_path, HELPER.replace("x * FACTOR", "x * FACTOR + 1"))) == "3.0 0"
    assert run(tmp_path) == "3.0 1"


def quiet(folder: Path, code: str, *argv: str) -> str:
    """Standard error of a program that keeps its machine code in `folder`."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, *argv],
        cwd=folder,
        env={"NUMBA_CACHE_DIR": str(folder / "kept"), "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stderr


@pytest.mark.long
def test_a_help_and_a_refusal_compile_nothing(tmp_path: Path) -> None:
    quiet(tmp_path, HELP, *REFUSED)
    assert not (tmp_path / "kept").exists()


@pytest.mark.long
def test_what_is_compiled_is_said_once(tmp_path: Path) -> None:
    put(tmp_path, caller=MODULE)
    said = "compiling control loops, once on this machine: takes up to a minute\n"
    assert quiet(tmp_path, PREPARED) == said
    assert quiet(tmp_path, PREPARED) == ""


@pytest.mark.long
@pytest.mark.parametrize("helpers", ["helped", "alone"])
def test_kernels_are_compiled_by_another_process_beside(tmp_path: Path, helpers: str) -> None:
    """Its machine code is read from the disk; where it fails, this process compiles all."""
    (tmp_path / "helper.py").write_text(HELPER)
    for name in ("caller", "second"):
        (tmp_path / f"{name}.py").write_text(MODULE)
    done = subprocess.run(
        [sys.executable, "-P", "-c", SIDE_BY_SIDE, helpers],
        cwd=tmp_path,
        env={"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    read, calls = ("1 1", 2) if helpers == "helped" else ("0 1", 1)
    *hits, compiled = done.stdout.splitlines()
    assert sorted(hits) == ["0 1", read]
    assert compiled == f"['caller:double', 'second:double'] {calls} []"


@pytest.mark.long
def test_a_command_waits_for_another_that_compiles(tmp_path: Path) -> None:
    """And then finds machine code where the other has stored it."""
    put(tmp_path, caller=MODULE)
    kept = {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-P", "-c", PREPARED]
    subprocess.run(command, cwd=tmp_path, env=kept, check=True)
    (lock,) = (tmp_path / "kept").rglob(LOCK)
    stored = [each for each in (tmp_path / "kept").rglob("*") if each.suffix in (".nbi", ".nbc")]
    away = [each.rename(tmp_path / each.name) for each in stored]
    with lock.open() as held:
        files.lock(held.fileno())
        with subprocess.Popen(
            command, cwd=tmp_path, env=kept, stderr=subprocess.PIPE, text=True
        ) as second:
            assert second.stderr
            assert "waiting for another command" in second.stderr.readline()
            for compiled, place in zip(away, stored, strict=True):
                compiled.rename(place)
            held.close()
            assert second.stderr.read() == ""
    assert second.returncode == 0


def test_a_part_is_for_kernels_alone() -> None:
    """It has no machine code of its own; see `kernel.PartLibrary`."""

    @kernel.part
    def doubled(x: float) -> float:
        return 2.0 * x

    @kernel.kernel
    def called(x: float) -> float:
        return doubled(x)

    assert called(3.0) == 6.0
    with pytest.raises(TypeError, match="not callable"):
        doubled(3.0)


@pytest.mark.long
def test_machine_code_for_a_type_that_is_gone_is_no_reason_to_fail(tmp_path: Path) -> None:
    """The type has moved to another module, as it may between two versions."""
    assert run(put(tmp_path)) == "2.0 0"
    (tmp_path / "elsewhere.py").write_text(HELPER)
    moved = CALLER.replace("from helper import Given, ", "from elsewhere import Given, ")
    assert run(put(tmp_path, HELPER.replace("Given", "Told"), moved)) == "2.0 0"


CALLED = """
import os
import sys
import msgspec
from numba.core import event
from skytether.server.schemes import loading
from skytether.shared.base import files, kernel, machine_code
from skytether.shared.scenario import reading
from skytether.sim import flight

def in_memory():
    return {f"{each.__module__}.{each.__name__}" for each in kernel.KERNELS if each.overloads}

def fly(name):
    scenario = msgspec.structs.replace(reading.load(name), duration=8.0)
    kernel.load(without=loading.others(scenario))
    loaded = in_memory()
    with event.install_recorder("numba:compile") as compiled:
        flight.fly(scenario, vehicles=16 if scenario.is_mission else 1)
    print(name, *(in_memory() - loaded), len(compiled.buffer), flush=True)

for name in sys.argv[1:]:  # each in a process that has nothing in memory, but the modules
    if not os.fork():
        fly(name)
        sys.exit()
    assert os.wait()[1] == 0, name
"""


@pytest.mark.long
def test_a_server_has_all_kernels_of_its_scheme_in_memory_before_it_flies() -> None:
    """In flight no other kernel is called, and nothing is compiled, not even for figures."""
    names = ["demo", "demo-committed", "paper", "paper-no-compensation", "swap"]
    done = subprocess.run(
        [sys.executable, "-P", "-c", CALLED, *names], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == [f"{name} 0" for name in names]


ALWAYS = {"clock", "controller", "desired", "plausibility"}
"""Modules of the server whose kernels are called with every scheme."""


@pytest.mark.parametrize("scenario", ["demo", "demo-committed", "paper", "swap"])
def test_a_server_loads_no_kernel_of_another_scheme(scenario: str) -> None:
    """A module with kernels belongs to named schemes, or to all of them."""
    import_module("skytether.server.endpoint")
    loading.load_all()
    own = loading.others(reading.load("paper")) | loading.others(reading.load("swap"))
    own -= loading.others(reading.load(scenario))
    loaded = {each.__module__ for each in kernel.KERNELS} - loading.others(reading.load(scenario))
    server = {name for name in loaded if name.startswith("skytether.server.")}
    assert {name.rpartition(".")[2] for name in server - own} <= ALWAYS
