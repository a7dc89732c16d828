"""Commands of docs/ci.md, as GitHub and GitLab would run them."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path

import pytest
import yaml

from helpers import PATIENCE_S
from namespaces import needs_namespaces
from robot import free_port
from skytether.__main__ import main
from skytether.shell.driving import inside

PAGE = (Path(__file__).parents[2] / "docs" / "ci.md").read_text()
GITHUB, GITLAB = (
    yaml.load(each, yaml.BaseLoader) for each in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
)
STEPS = {name: job["steps"] for name, job in GITHUB["jobs"].items()}
ON_GITHUB = {
    name: [step["run"].strip() for step in steps if "run" in step] for name, steps in STEPS.items()
}
ON_GITLAB = {name: [*job.get("before_script", ()), *job["script"]] for name, job in GITLAB.items()}
PLACES = {"github": ON_GITHUB, "gitlab": ON_GITLAB}


def prepares(line: str) -> bool:
    """Whether a command prepares the runner, and is checked alone."""
    return line.split(maxsplit=1)[0] in ("sudo", "apt-get", "pip")


def lines(place: str, job: str) -> list[str]:
    return [line for line in PLACES[place][job] if not prepares(line)]


@contextmanager
def ran(script: str, folder: Path) -> Iterator[int]:
    """Exit code of a script of the page in a folder, with our programs in its PATH; what it leaves
    is ended afterwards.
    """
    script = re.sub(r"\b8000\b", str(free_port()), script)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with subprocess.Popen(
        ["bash", "-e", "-c", script],
        cwd=folder,
        env={**os.environ, "PATH": path},
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            yield process.wait(PATIENCE_S)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("place", PLACES)
def test_what_prepares_the_runner_is_what_netem_asks_for(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared = [
        shlex.split(line.removeprefix("sudo "))
        for job in PLACES[place].values()
        for line in filter(prepares, job)
    ]
    extras = {*metadata.metadata("skytether").get_all("Provides-Extra")}
    for program, *words in prepared:
        match program, words:
            case "apt-get", ["update"]:
                pass
            case "apt-get", ["install", "-y", *packages]:
                assert packages == ["slirp4netns", "iproute2"]
            case "sysctl", ["-w", setting]:
                monkeypatch.setattr(os, "geteuid", lambda: 1000)
                monkeypatch.setattr(Path, "exists", lambda _: True)
                assert setting in inside._how(PermissionError(1, "not permitted"))
            case "pip", ["install", *packages]:
                asked = re.findall(r"skytether\[(\w+)\]", " ".join(packages))
                assert {*asked} <= extras
                assert any(each.startswith("skytether") for each in packages)
            case _:
                pytest.fail(f"nothing checks {program}")


def test_the_record_is_kept_on_both() -> None:
    (kept,) = (step for step in STEPS["program"] if "upload-artifact" in step.get("uses", ""))
    assert kept["with"]["path"].split() == GITLAB["program"]["artifacts"]["paths"]
    (line,) = (line for line in ON_GITLAB["program"] if "netem run" in line)
    assert all(f" {name} " in line for name in kept["with"]["path"].split())
    assert "\n".join(lines("gitlab", "program")) == "\n".join(lines("github", "program"))


@pytest.mark.realtime
@pytest.mark.parametrize("place", PLACES)
def test_the_test_of_the_page_passes(place: str, tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(# test_client\.py\n.*?)```", PAGE, re.DOTALL)
    (tmp_path / "test_client.py").write_text(code)
    with ran("\n".join(lines(place, "fixture")), tmp_path) as status:
        assert status == 0


@pytest.mark.realtime
@pytest.mark.long
@needs_namespaces
@pytest.mark.skipif(shutil.which("curl") is None, reason="no curl here")
@pytest.mark.parametrize("place", PLACES)
def test_the_program_of_the_page_leaves_its_record(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ran("\n".join(lines(place, "program")), tmp_path) as status:
        assert status == 0
    assert (tmp_path / "page.html").stat().st_size
    assert all((tmp_path / name).stat().st_size for name in GITLAB["program"]["artifacts"]["paths"])
    monkeypatch.chdir(tmp_path)
    (export,) = re.findall(r"```sh\nskytether (.*?)\n```", PAGE)
    assert main(shlex.split(export)) == 0
    table = (tmp_path / "tables" / "netem.csv").read_text()
    assert {"to_program", "from_program"} <= {*re.findall(r"\w+_program", table)}
