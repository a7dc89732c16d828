"""Distribution: one package, complete from a checkout and from a source distribution."""

import os
import re
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from helpers import ran
from skytether.shared.scenario import reading

ROOT = Path(__file__).parents[2]
OLD_NAMES = ("shared", "shell", "server", "client", "netem", "sim", "lab", "view", "scenarios")
"""Former names of top-level packages, which other distributions may have."""
LOCKS = sorted((ROOT / "locks").glob("*.lock"))
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
    assert held >= {f"skytether/{room}/report.html.jinja" for room in ("view", "figures")}


def test_a_checkout_and_its_source_distribution_make_the_same_wheel(
    wheel: Path, tmp_path: Path
) -> None:
    assert contents(hatchling(ROOT, "wheel", tmp_path / "built")) == contents(wheel)


def test_the_source_distribution_holds_the_package_and_no_links(sdist: Path) -> None:
    about = {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "PKG-INFO", ".gitignore"}
    assert {path.name for path in sdist.iterdir()} == {"skytether", *about}
    assert not [path for path in sdist.rglob("*") if path.is_symlink()]


@pytest.mark.parametrize("lock", LOCKS, ids=lambda path: path.stem)
def test_lock_files_carry_hashes_and_no_addresses(lock: Path) -> None:
    text = lock.read_text()
    pins = re.split(r"\n(?=\w)", text.strip())
    assert all(re.match(r"[a-z0-9-]+==\S+ .*\\\n    --hash=sha256:", f"{pin} ") for pin in pins)
    assert "://" not in text
    assert "index" not in text


def test_what_is_in_two_lock_files_has_one_version() -> None:
    pins = {pin for lock in LOCKS for pin in re.findall(r"(?m)^(\S+)==(\S+)", lock.read_text())}
    assert len(pins) == len(dict(pins))


@pytest.mark.long
@pytest.mark.timeout(600)  # a new server compiles its kernels
@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_it_flies_in_an_environment_that_has_a_package_called_server(
    kind: str, wheel: Path, tmp_path: Path
) -> None:
    """With `skytether` added, README's example flies, whatever folders are in the directory."""
    python, packages = environment(tmp_path / "environment")
    (packages / "server").mkdir()
    (packages / "server" / "__init__.py").write_text("NAME = 'unrelated'")
    before = names(packages)
    what = [str(wheel)] if kind == "wheel" else ["--no-build-isolation", "--editable", str(ROOT)]
    install = ["-m", "uv", "pip", "install", "--offline", "--no-deps", "--python", str(python)]
    assert ran(sys.executable, *install, *what).returncode == 0
    added = names(packages) - before
    if kind == "wheel":
        assert added == {"skytether", "skytether-0.1.0.dist-info"}
    else:
        assert added == {"_editable_impl_skytether.pth", "skytether-0.1.0.dist-info"}

    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    example += "\nimport server\nprint(skytether.__file__, server.NAME)"
    beside = tmp_path / "beside"
    strangers(beside, *(name for name in OLD_NAMES if name != "server"))
    # -c, without -P: folders here precede installed packages
    done = ran(python, "-c", example, cwd=beside)
    assert done.returncode == 0, done.stderr
    compiled = "compiling control loops, once on this machine: takes up to a minute\n"
    assert done.stderr in ("", compiled)
    flown, where = done.stdout.splitlines()
    assert 0 < float(flown.split()[0]) < 0.1
    home = packages if kind == "wheel" else ROOT
    assert where == f"{home / 'skytether' / '__init__.py'} unrelated"

    command = ("fly", "demo", "--virtual", "--duration", "10")
    done = ran(python.with_name("skytether"), *command, cwd=beside)
    assert (done.returncode, done.stderr) == (0, "")


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
@pytest.mark.parametrize("name", ["server", "netem", "client"])
def test_rooms_of_a_checkout_run_as_processes(name: str) -> None:
    done = ran(sys.executable, "-m", name, "--help", cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"skytether {name}" in done.stdout


@pytest.mark.long
def test_folders_with_our_names_are_not_taken_for_ours(tmp_path: Path) -> None:
    """Folders in the user's directory are ignored by commands, processes, and `python -P`."""
    strangers(tmp_path, *OLD_NAMES, "skytether")
    skytether = str(Path(sys.executable).with_name("skytether"))
    flags = ["--duration", "3", "--settle", "0"]
    flags += ["--network.uplink", "loss(0.1)", "--network.downlink", "loss(0.1)"]
    for argv in (
        [skytether, "fly", "demo", *flags],
        [skytether, "sweep", "demo", *flags, "--runs", "1", "--workers", "1", "--out", "swept"],
        [sys.executable, "-P", "-m", "skytether.server", "--help"],
    ):
        done = ran(*argv, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
