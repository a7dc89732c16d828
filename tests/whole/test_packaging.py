"""Distribution: one package, complete from a checkout and from a source distribution."""

import os
import re
import shlex
import signal
import socket
import sys
import sysconfig
import tarfile
import venv
import zipfile
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from subprocess import Popen

import pytest

from helpers import ran, until
from skytether.shared.scenario import reading

ROOT = Path(__file__).parents[2]
OLD_NAMES = ("shared", "shell", "server", "client", "netem", "sim", "lab", "view", "scenarios")
"""Former names of top-level packages, which other distributions may have."""
LOCKS = sorted((ROOT / "locks").glob("*.lock"))
README = (ROOT / "README.md").read_text()
NETEM = (ROOT / "docs" / "netem.md").read_text()
OTHER_PYTHON = os.environ.get("OTHER_PYTHON", "")
"""Another Python that shall install the wheel and fly, as /usr/bin/python3.13."""
SOMEBODY_ELSE = "raise SystemExit('somebody else')"


def hatchling(source: Path, target: str, folder: Path) -> Path:
    build = ("-m", "hatchling", "build", "-t", target, "-d", folder)
    assert ran(sys.executable, *build, cwd=source).returncode == 0
    (built,) = folder.iterdir()
    return built


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sdist")
    with tarfile.open(hatchling(ROOT, "sdist", folder / "packed")) as packed:
        packed.extractall(folder, filter="data")
    return folder / "skytether-0.1.0"


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hatchling(sdist, "wheel", tmp_path_factory.mktemp("wheel") / "built")


def contents(wheel: Path) -> dict[str, int]:
    """Checksum of each file of a wheel."""
    return {info.filename: info.CRC for info in zipfile.ZipFile(wheel).infolist()}


def files(folder: Path) -> set[str]:
    """Files below a folder and its links, without Python's compiled files."""
    found = {Path(at, name) for at, _, names in os.walk(folder, followlinks=True) for name in names}
    kept = {path for path in found if "__pycache__" not in path.parts}
    return {path.relative_to(folder.parent).as_posix() for path in kept}


def test_the_wheel_is_our_package_and_nothing_else(wheel: Path) -> None:
    held = {name for name in contents(wheel) if not name.startswith("skytether-0.1.0.dist-info/")}
    assert held == files(ROOT / "skytether")
    scenarios = [*reading.names(), reading.COMPARED]
    assert held >= {f"skytether/scenarios/{name}.toml" for name in scenarios}
    assert held >= {"skytether/py.typed", "skytether/server/tick.py"}
    assert "skytether/figures/report.html.jinja" in held


def test_a_checkout_and_its_source_distribution_make_the_same_wheel(
    wheel: Path, tmp_path: Path
) -> None:
    assert contents(hatchling(ROOT, "wheel", tmp_path / "built")) == contents(wheel)


def test_the_source_distribution_holds_the_package_and_no_links(sdist: Path) -> None:
    about = {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "PKG-INFO", ".gitignore"}
    assert {path.name for path in sdist.iterdir()} == {"skytether", *about}
    assert not [path for path in sdist.rglob("*") if path.is_symlink()]


def test_lock_files_carry_hashes_and_no_addresses() -> None:
    hashed = re.compile(r"[a-z0-9-]+==\S+ .*\\\n    --hash=sha256:")
    for lock in LOCKS:
        text = lock.read_text()
        pins = re.split(r"\n(?=\w)", text.strip())
        assert all(hashed.match(f"{pin} ") for pin in pins), lock
        assert "://" not in text, lock
        assert "index" not in text, lock


def test_what_is_in_two_lock_files_has_one_version() -> None:
    pins = {pin for lock in LOCKS for pin in re.findall(r"(?m)^(\S+)==(\S+)", lock.read_text())}
    assert len(pins) == len(dict(pins))


def test_what_is_cited_is_this_version() -> None:
    assert f"\nversion: {metadata.version('skytether')}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.fixture(scope="module", params=[sys.executable, OTHER_PYTHON], ids=["this", "other"])
def interpreter(request: pytest.FixtureRequest) -> str:
    if not request.param:
        pytest.skip("needs OTHER_PYTHON=, the path of another Python")
    return str(request.param)


def installed(
    extras: str, wheel: Path, interpreter: str, folder: Path, *beside: str | Path
) -> Path:
    """Programs of an environment with the wheel, what its extras ask for, and packages `beside`.

    As `uvx` and `pipx` make it. Nothing is compiled, and versions are those of the lock file.
    """
    line = ("-m", "uv", "tool", "install", "--no-build", "--python", interpreter)
    what = ("--constraints", ROOT / "locks" / "dev.lock", f"skytether{extras} @ {wheel.as_uri()}")
    what += tuple(each for package in beside for each in ("--with", package))
    places = {"UV_TOOL_DIR": str(folder), "UV_TOOL_BIN_DIR": str(folder / "bin")}
    done = ran(sys.executable, *line, *what, env=os.environ | places)
    assert done.returncode == 0, done.stderr
    return folder / "skytether" / "bin"


def alone(folder: Path) -> dict[str, str]:
    """Environment variables of somebody who has no compiler, no home and no page."""
    return {"PATH": str(folder), "HOME": str(folder), "SKYTETHER_PAGE": "none"}


@pytest.mark.long
@pytest.mark.realtime
def test_the_bare_wheel_is_a_bad_network_for_any_program(
    interpreter: str, wheel: Path, tmp_path: Path
) -> None:
    """README's line carries packets; a command that needs an extra names it."""
    skytether = installed("", wheel, interpreter, tmp_path) / "skytether"
    refused = ran(skytether, "fly", "demo", env=alone(tmp_path), cwd=tmp_path)
    assert refused.returncode == 2
    assert "pip install 'skytether[server]'" in refused.stderr

    (line,) = re.findall(r"`skytether (netem [^`]+)`", README)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free,
    ):
        for each in (server, client, free):
            each.bind(("127.0.0.1", 0))
            each.setblocking(False)
        ports = {"5000": str(server.getsockname()[1]), "5001": str(free.getsockname()[1])}
        free.close()
        argv = shlex.split(re.sub("|".join(ports), lambda port: ports[port[0]], line))

        def arrived() -> bool:
            with suppress(OSError):  # netem is not there yet
                client.sendto(b"asked", ("127.0.0.1", int(ports["5001"])))
            with suppress(BlockingIOError):
                return server.recv(100) == b"asked"
            return False

        with Popen([skytether, *argv], env=alone(tmp_path), cwd=tmp_path) as netem:
            try:
                until(arrived)
            finally:
                netem.send_signal(signal.SIGINT)
    assert netem.returncode == 0


@pytest.mark.long
@pytest.mark.realtime
def test_a_project_with_the_wheel_has_the_fixture(
    interpreter: str, wheel: Path, tmp_path: Path
) -> None:
    """The example of docs/netem.md, as the only file of a project, under pytest."""
    (example,) = re.findall(r"```python\n(# test_mine.py\n.*?)```", NETEM, re.DOTALL)
    project = tmp_path / "project"
    project.mkdir()
    (project / "test_mine.py").write_text(example)
    python = installed("", wheel, interpreter, tmp_path, "pytest") / "python"
    done = ran(python, "-m", "pytest", "-q", env=alone(tmp_path), cwd=project)
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout


@pytest.mark.long
@pytest.mark.realtime
@pytest.mark.timeout(1800)  # a new server compiles its kernels, for minutes where others work
def test_the_wheel_flies_with_its_extras_alone(
    interpreter: str, wheel: Path, tmp_path: Path
) -> None:
    """README's line without a checkout, with the wheel in place of the address, and its example.

    They fly whatever folders are in the directory.
    """
    ((extras, command),) = re.findall(
        r'^uvx --from "skytether(\[.*\]) @ git\+ADDRESS" skytether (.*?) *(?:#.*)?$',
        README,
        re.MULTILINE,
    )
    programs = installed(extras, wheel, interpreter, tmp_path)
    beside = tmp_path / "beside"
    strangers(beside, *OLD_NAMES)
    python = programs / "python"
    # -c, without -P: folders here precede installed packages
    done = ran(python, "-c", example(), env=alone(tmp_path), cwd=beside)
    assert done.returncode == 0, done.stderr
    assert_flown(done.stdout.splitlines()[0])
    short = ("--duration", "6", "--settle", "0")
    done = ran(programs / "skytether", *command.split(), *short, env=alone(tmp_path), cwd=beside)
    assert done.returncode == 0, done.stderr
    assert "over UDP" in done.stdout


@pytest.mark.long
def test_an_editable_installation_flies_in_an_environment_that_has_a_package_called_server(
    tmp_path: Path,
) -> None:
    """With `skytether` added, README's example flies, whatever folders are in the directory."""
    python, packages = environment(tmp_path / "environment")
    (packages / "server").mkdir()
    (packages / "server" / "__init__.py").write_text("NAME = 'unrelated'")
    before = names(packages)
    install = ["-m", "uv", "pip", "install", "--offline", "--no-deps", "--python", str(python)]
    what = ["--no-build-isolation", "--editable", str(ROOT)]
    assert ran(sys.executable, *install, *what).returncode == 0
    added = names(packages) - before
    assert added == {"_editable_impl_skytether.pth", "skytether-0.1.0.dist-info"}

    beside = tmp_path / "beside"
    strangers(beside, *(name for name in OLD_NAMES if name != "server"))
    where = "\nimport server\nprint(skytether.__file__, server.NAME)"
    done = ran(python, "-c", example() + where, cwd=beside)
    assert done.returncode == 0, done.stderr
    flown, where = done.stdout.splitlines()
    assert_flown(flown)
    assert where == f"{ROOT / 'skytether' / '__init__.py'} unrelated"


def example() -> str:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    return str(example)


def assert_flown(line: str) -> None:
    """What README's example prints."""
    assert 0 < float(line.split(maxsplit=1)[0]) < 0.1


def environment(folder: Path) -> tuple[Path, Path]:
    """Python and packages of a new environment that sees all installed packages except Skytether.

    A .pth in a folder named by another .pth is not followed, so the editable installation is not
    found.
    """
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    (packages / "those_of_the_tests.pth").write_text(sysconfig.get_path("purelib"))
    missing = ran(python, "-P", "-c", "import numpy, skytether")
    assert "No module named 'skytether'" in missing.stderr
    return python, packages


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def strangers(folder: Path, *packages: str) -> None:
    for package in packages:
        (folder / package).mkdir(parents=True)
        for name in ("__init__.py", "__main__.py"):
            (folder / package / name).write_text(SOMEBODY_ELSE)


@pytest.mark.long
@pytest.mark.parametrize("name", ["server", "client"])
def test_rooms_of_a_checkout_run_as_processes(name: str) -> None:
    done = ran(sys.executable, "-m", name, "--help", cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"skytether {name}" in done.stdout
