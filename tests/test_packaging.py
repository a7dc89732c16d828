"""The distribution: its flat names are its own, and it carries what it needs."""

import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata, resources
from pathlib import Path

import pytest

from shared import config

ROOT = Path(__file__).parent.parent
PACKAGES = ["shared", "shell", "server", "client", "netem", "sim", "lab", "view", "skytether"]
PACKAGES += ["scenarios"]


def test_each_top_level_name_belongs_to_our_distribution_alone() -> None:
    """An unrelated `shared` exists on the index and would overwrite ours silently."""
    owners = metadata.packages_distributions()
    for package in PACKAGES:
        # An editable install maps no packages, but nobody else may claim them either.
        assert set(owners.get(package, ["skytether"])) == {"skytether"}
        assert Path(str(resources.files(package))) == ROOT / package


def test_it_cannot_be_published_by_accident() -> None:
    """Flat names are for an environment of their own."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert "Private :: Do Not Upload" in project["classifiers"]


def test_the_wheel_holds_the_listed_packages_and_the_scenarios(tmp_path: Path) -> None:
    """Exactly: no tests, no documents, and every scenario."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    files = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in files} == {*PACKAGES, "skytether-0.1.0.dist-info"}
    packed = {name for name in files if name.endswith(".toml")}
    names = [*config.names(), config.COMPARED]
    assert packed == {f"scenarios/{name}.toml" for name in names}


def test_lock_files_carry_hashes_and_no_addresses() -> None:
    """Pinned, hashed, and from whatever index pip is configured for."""
    for name in ("requirements.lock", "requirements-dev.lock"):
        lines = (ROOT / name).read_text().splitlines()
        pins = [line for line in lines if line and line[0].isalnum()]
        assert all("==" in pin for pin in pins)
        assert sum("--hash=sha256:" in line for line in lines) >= len(pins)
        assert not any("://" in line or "index" in line for line in lines)


@pytest.mark.long
def test_folders_with_our_names_are_not_taken_for_ours(tmp_path: Path) -> None:
    """Where the user happens to be: by the command, its workers and processes, and `python -P`."""
    for package in PACKAGES:
        (tmp_path / package).mkdir()
        for name in ("__init__.py", "__main__.py"):
            (tmp_path / package / name).write_text("raise SystemExit('somebody else')")
    skytether = str(Path(sys.executable).with_name("skytether"))
    flags = ["--duration", "3", "--settle", "0"]
    flags += ["--network.uplink.delay", "none", "--network.downlink.delay", "none"]
    for argv in (
        [skytether, "fly", "demo", *flags],
        [skytether, "sweep", "demo", *flags, "--runs", "1", "--workers", "1", "--out", "swept"],
        [sys.executable, "-P", "-m", "server", "--help"],
    ):
        done = subprocess.run(argv, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")
