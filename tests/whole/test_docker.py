"""The containers in a real flight: isolation, and recovery from faults.

One flight is of each submission, and asserts that it flew, stayed safe and is locked in; how many
deadlines a busy machine missed decides about nothing.

`make docker-test` needs a Docker engine with Compose and takes about three minutes; `-s` shows the
progress. COMPOSE is the command to use in place of `docker compose` or `docker-compose`, BASE_IMAGE
the base of the images.
"""

import contextlib
import json
import os
import re
import secrets
import shlex
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import msgspec
import pytest

from helpers import PATIENCE_S
from skytether.shared.scenario import reading
from skytether.shared.telemetry.parts import read
from skytether.shared.telemetry.summary import Summary

pytestmark = [pytest.mark.docker, pytest.mark.realtime, pytest.mark.timeout(900)]

ROOT = Path(__file__).parents[2]
RUNNING = (ROOT / "docs" / "running.md").read_text()
SERVICES = ("server", "netem", "client")
IMAGES = ("client", "page", "server")
EXTRAS = {"numba", "llvmlite", "scipy", "osqp", "viser", "mcap", "matplotlib", "pip"}
"""Packages that the bare package does without."""
STEPS_PER_S = round(1 / reading.load("demo").control.dt)

FLIGHT_S = 60
GATE_FLIGHT_S = 10
FAULTY_FLIGHT_S = 110
"""Duration of the flight with faults [s]; faults and the checks after them take 45 s of it."""
STANDBY_FLIGHT_S = 40
"""Duration of the flight with a standby server [s]."""
MISSION, MISSION_S, VEHICLES = "deploy/mission/compose.yml", 60, 4
FAULT_S = 3.0
"""Duration of a fault [s]: more than the demo's `link.timeout_s`, so that the client detects it."""
HORIZONS = 6
HOVER_M = 1.58
"""Error `rmse_xy` of the demo for a vehicle that stays at its start [m]."""


@pytest.mark.long
@pytest.mark.usefixtures("compose")
def test_each_image_carries_what_it_runs_and_no_more() -> None:
    """The client's is the bare package; the server's and the page's have an extra each."""
    packages = {image: packages_of(image) for image in IMAGES}
    assert packages["page"] & EXTRAS == {"viser"}
    assert packages["client"] & EXTRAS == set()
    assert packages["server"] & EXTRAS == {"numba", "llvmlite", "scipy", "osqp"}
    sizes = {image: size_of(image) for image in IMAGES}
    assert sizes["client"] < min(sizes["page"], sizes["server"])


def packages_of(image: str) -> set[str]:
    """Names in the folder of an image's packages."""
    listed = (
        "--entrypoint=sh",
        f"skytether-{image}",
        "-c",
        "ls /opt/skytether/lib/*/site-packages",
    )
    return set(run("docker", "run", "--rm", "--network=none", *listed).split())


def size_of(image: str) -> int:
    """Size of an image [B]."""
    size = int(run("docker", "image", "inspect", "--format", "{{.Size}}", f"skytether-{image}"))
    say(f"the image of the {image} has {size / 1e6:.0f} MB")
    return size


def test_a_flight_in_containers(compose: list[str], tmp_path: Path) -> None:
    with containers(compose, FLIGHT_S) as three, three.capture() as captured:
        three.flies()
        for service in SERVICES:
            three.check_privileges(service)
        three.check_isolation()
        # A compiled kernel would be in the copy only.
        copied = ("diff", "-r", "/opt/skytether/kernels", "/tmp/kernels")
        assert three.inside("server", *copied) == (0, "")
        say("locked in: not root, read-only, no capabilities, no way round netem")
        three.check_key()

        summary = three.land(tmp_path)
        assert summary.scenario == "demo"
        assert_safe(summary, FLIGHT_S)
        assert packages_of("client") & EXTRAS == set()
        assert size_of("client") < size_of("server")
        check_capture(captured, tmp_path / "client")

        # Existing containers, even if an image has been rebuilt meanwhile.
        three.compose("up", "--detach", "--no-recreate")
        until("a second flight", lambda: three.said("client").count("session open, flying") == 2)
        say("flying again, until SIGTERM")
        three.compose("stop")
        for service in SERVICES:
            assert three.state(service)["ExitCode"] == 0, three.said(service)
        last_words = three.said("client").rsplit("flying", 1)[1]
        assert number("step", last_words) < FLIGHT_S * STEPS_PER_S
        say("SIGTERM ended all three with 0")


def assert_safe(summary: Summary, seconds: int) -> None:
    """The flight was flown encrypted to its end, and the vehicle stayed where its path is."""
    assert summary.secure
    assert summary.steps > 0
    assert summary.steps + summary.deadline_misses == seconds * STEPS_PER_S
    assert summary.rmse_xy is not None
    # The machine may be slow: the vehicle hovers meanwhile, at worst at the end of its path.
    assert 0 < summary.rmse_xy < 2 * HOVER_M


@pytest.mark.long
@pytest.mark.parametrize(("seconds", "code"), [(GATE_FLIGHT_S, 0), (0, 2)])
def test_one_command_flies_for_a_gate(
    compose: list[str], tmp_path: Path, seconds: int, code: int
) -> None:
    """By the command of docs/running.md all end after the flight, with the client's exit code."""
    (line,) = (line for line in RUNNING.splitlines() if "--exit-code-from" in line)
    *command, build = shlex.split(line)[:4]
    assert (command, build) == (["docker", "compose", "up"], "--build")
    three = Containers(compose, seconds)
    try:
        found, said = three.attempt("up", *shlex.split(line)[4:])
        assert found == code, said[-4000:]
        statuses = {each: three.state(each)["Status"] for each in (*SERVICES, "keys", "page")}
        assert set(statuses.values()) == {"exited"}, statuses
        if code == 0:
            assert_safe(three.land(tmp_path), seconds)
    finally:
        three.compose("down", "--volumes", "--remove-orphans")


@pytest.mark.long
def test_a_flight_goes_on_after_every_fault(compose: list[str], tmp_path: Path) -> None:
    with containers(compose, FAULTY_FLIGHT_S) as three:
        three.flies()

        with three.fault(f"netem is paused for {FAULT_S:g} s"):
            three.docker("pause", three.id("netem"))
            time.sleep(FAULT_S)
            three.docker("unpause", three.id("netem"))

        before = three.addresses("server")
        with three.fault("the server is killed, and started at another address"):
            three.docker("kill", three.id("server"))
            with three.squatter("ground"):
                time.sleep(FAULT_S)
                three.docker("start", three.id("server"))
        assert three.addresses("server") != before

        with three.fault("the server crashes, and Docker restarts it"):
            # Kills all processes of its user except this shell; then the init process ends as well.
            three.inside("server", "sh", "-c", "kill -9 -1")
            until("the restart", lambda: three.inspect("server")["RestartCount"] == 1)

        with three.fault("netem is killed, and started again"):
            three.docker("kill", three.id("netem"))
            time.sleep(FAULT_S)
            three.docker("start", three.id("netem"))

        before = three.addresses("client")
        with three.fault(f"the client has no network for {FAULT_S:g} s, then another address"):
            three.docker("network", "disconnect", three.network("air"), three.id("client"))
            with three.squatter("air"):
                time.sleep(FAULT_S)
                three.docker("network", "connect", three.network("air"), three.id("client"))
        assert three.addresses("client") != before

        summary = three.land(tmp_path)
        assert three.said("client").count("session open, flying") == 1
        assert three.said("client").count("the server has restarted") >= 2
        assert_safe(summary, FAULTY_FLIGHT_S)
        three.compose("stop")
        assert [three.state(service)["ExitCode"] for service in SERVICES] == [0, 0, 0]


@pytest.mark.long
def test_a_flight_goes_on_with_the_standby_server(compose: list[str], tmp_path: Path) -> None:
    with containers(compose, STANDBY_FLIGHT_S, standby=True) as five:
        five.flies()
        until("the standby's session", lambda: five.has_said("standby", "vehicle 1 flies"))
        leader = five.leader()
        say(f"the {leader} is killed")
        five.compose("kill", leader)
        until("another leader", lambda: five.leader() != leader)
        assert_safe(five.land(tmp_path), STANDBY_FLIGHT_S)


@pytest.mark.long
def test_a_mission_outlives_a_path_and_a_server(compose: list[str], tmp_path: Path) -> None:
    """The four vehicles of deploy/mission arrive, though the netem of a path and then the leading
    server are killed.
    """
    with containers(compose, MISSION_S, standby=True, more=MISSION) as all_of_them:
        until("the vehicles", lambda: all_of_them.said("server").count(" flies, from ") == VEHICLES)
        for service in ("netem-lte", "server"):
            time.sleep(5.0)
            all_of_them.compose("kill", service)
            say(f"{service} is killed")
        vehicles = ["client", *(f"client-{number}" for number in range(2, VEHICLES + 1))]
        for service in vehicles:
            until(
                f"the end of {service}",
                lambda service=service: all_of_them.state(service)["Status"] == "exited",
                within_s=MISSION_S + PATIENCE_S,
            )
            assert all_of_them.state(service)["ExitCode"] == 0, all_of_them.said(service)
        all_of_them.docker("cp", f"{all_of_them.id('client')}:/results/.", str(tmp_path))
        for number in range(1, VEHICLES + 1):
            file = tmp_path / f"{number}.json"
            summary = msgspec.json.decode(file.read_bytes(), type=Summary)
            assert summary.secure
            assert summary.modes.keys() <= {"sync", "ready", "track", "coast"}
            state = read(tmp_path / f"{number}")["state"][:, :, 0]
            assert state[-1] == pytest.approx(-state[0], abs=0.1), "it changed places"


@dataclass
class Containers:
    command: list[str]
    seconds: int
    standby: bool = False
    more: str = ""
    """Another file of Compose, which is read after docker-compose.yml."""
    project: str = field(default_factory=lambda: f"skytether-test-{secrets.token_hex(4)}")
    ids: dict[str, str] = field(default_factory=dict)
    """Identifiers of the containers, by service; they stay the same from `up` to `down`."""

    def compose(self, *arguments: str) -> str:
        return run(*self.argv(*arguments), more_env=self.flight)

    def attempt(self, *arguments: str) -> tuple[int, str]:
        return attempt(*self.argv(*arguments), within_s=300.0, more_env=self.flight)

    def argv(self, *arguments: str) -> list[str]:
        files = [f"--file={ROOT / name}" for name in ("docker-compose.yml", self.more) if name]
        profile = ["--profile", "standby"] * self.standby
        return [*self.command, *files, "-p", self.project, *profile, *arguments]

    @property
    def flight(self) -> dict[str, str]:
        standby = {"STANDBY": "netem-standby:47000"} if self.standby else {}
        return {"FLIGHT_SECONDS": str(self.seconds), "SCENARIO": "demo", **standby}

    def docker(self, *arguments: str) -> str:
        return run("docker", *arguments)

    def id(self, service: str) -> str:
        if service not in self.ids:
            self.ids[service] = self.compose("ps", "--all", "--quiet", service).strip()
        return self.ids[service]

    def network(self, name: str) -> str:
        return f"{self.project}_{name}"

    def inspect(self, service: str) -> dict[str, Any]:
        return json.loads(self.docker("inspect", self.id(service)))[0]

    def state(self, service: str) -> dict[str, Any]:
        return self.inspect(service)["State"]

    def addresses(self, service: str) -> dict[str, str]:
        networks = self.inspect(service)["NetworkSettings"]["Networks"]
        return {name: network["IPAddress"] for name, network in networks.items()}

    def said(self, service: str) -> str:
        return attempt("docker", "logs", self.id(service))[1]

    def inside(self, service: str, *command: str) -> tuple[int, str]:
        return attempt("docker", "exec", self.id(service), *command)

    def has_said(self, service: str, what: str, *, since: int = 0) -> bool:
        return what in self.said(service)[since:]

    # -- the flight --------------------------------------------------------------------------

    def figures(self, service: str) -> str:
        """Figures that a process prints at SIGUSR1, up to the last line."""
        pattern = r"(?s)counted so far:.*?send_errors +\d+"
        before = len(re.findall(pattern, self.said(service)))
        self.docker("kill", "--signal", "USR1", self.id(service))
        new = until(
            f"figures of the {service}", lambda: re.findall(pattern, self.said(service))[before:]
        )
        return str(new[-1])

    def flies(self) -> None:
        until("the session", lambda: self.has_said("server", "vehicle 1 flies"))
        first = self.figures("client")
        # A second later all packets that netem holds now have been delivered.
        second = self.figures_with("step", number("step", first) + STEPS_PER_S)
        leader = self.leader()
        server = self.figures(leader)
        last = self.figures_with("horizons", number("horizons", second) + HORIZONS)
        assert number("events", self.figures(leader)) > number("events", server)
        counts = [number("horizons", figures) for figures in (first, last)]
        say(f"orders reach the vehicle: {counts[0]} ... {counts[1]}")

    def leader(self) -> str:
        """Server that leads the vehicle. The standby does so from the start if it answers first."""
        said, leads, _ = self.said("client").rpartition(" leads it now")
        return "standby" if leads and said.endswith("netem-standby:47000") else "server"

    def figures_with(self, name: str, least: int) -> str:
        """First figures of the client in which a counter reaches a value."""

        def enough() -> str | None:
            assert self.state("client")["Status"] == "running", "the flight has ended too soon"
            figures = self.figures("client")
            return figures if number(name, figures) >= least else None

        return until(f"{name}: {least}", enough)

    @contextlib.contextmanager
    def fault(self, what: str) -> Iterator[None]:
        """Fault that the client detects, and that ends with the block."""
        before = len(self.said("client"))
        say(what)
        yield
        began_s = time.monotonic()
        for event in ("brakes: the server is silent", "flies a plan"):
            until(event, partial(self.has_said, "client", event, since=before))
        say(f"a plan is flown again, {time.monotonic() - began_s:.1f} s after the repair")
        self.flies()

    @contextlib.contextmanager
    def squatter(self, network: str) -> Iterator[None]:
        """Container of a stranger at the address that a container had in a network."""
        argv = ["run", "--detach", "--rm", "--network", self.network(network)]
        argv += ["--entrypoint", "sleep", "skytether-client", "600"]
        stranger = self.docker(*argv).strip()
        try:
            yield
        finally:
            self.docker("rm", "--force", stranger)

    def land(self, folder: Path) -> Summary:
        until(
            "the end of the flight",
            lambda: self.state("client")["Status"] == "exited",
            within_s=self.seconds + PATIENCE_S,
        )
        assert self.state("client")["ExitCode"] == 0, self.said("client")
        self.docker("cp", f"{self.id('client')}:/results/.", str(folder))
        summary = msgspec.json.decode((folder / "summary.json").read_bytes(), type=Summary)
        say(f"landed: {summary.steps} steps, rmse_xy {summary.rmse_xy:.3f} m")
        return summary

    # -- isolation ---------------------------------------------------------------------------

    @contextlib.contextmanager
    def capture(self) -> Iterator[Path]:
        """File of every UDP payload that netem receives and sends meanwhile, on both networks."""
        script = (ROOT / "tests" / "sniff.py").read_text()
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "capture.pcap"
            argv = ["docker", "run", "--rm", "--network", f"container:{self.id('netem')}"]
            argv += ["--user=0", "--cap-add=NET_RAW", "--entrypoint=python", "skytether-client"]
            with (
                file.open("wb") as out,
                subprocess.Popen([*argv, "-c", script], stdout=out) as sniffer,
            ):
                try:
                    yield file
                finally:
                    sniffer.terminate()
                    sniffer.wait(30.0)

    def check_key(self) -> None:
        """The key is one file that only its owner can read, the same for both ends."""
        shown = [self.inside(each, "cat", "/keys/vehicle-1") for each in ("server", "client")]
        assert shown[0] == shown[1]
        assert shown[0][0] == 0
        assert self.inside("server", "stat", "-c", "%a", "/keys/vehicle-1") == (0, "600\n")
        assert self.inside("server", "touch", "/keys/another")[0] != 0
        assert self.inside("netem", "ls", "/keys/vehicle-1")[0] != 0
        secret = shown[0][1].split()[-1]
        assert all(secret not in self.said(each) for each in ("server", "client", "netem"))

    def check_privileges(self, service: str) -> None:
        host = self.inspect(service)["HostConfig"]
        assert host["ReadonlyRootfs"]
        assert host["CapDrop"] == ["ALL"]
        assert not host["CapAdd"]
        assert not host["Privileged"]
        assert not host["PortBindings"]
        assert host["Memory"] > 0
        assert host["NanoCpus"] > 0
        assert host["PidsLimit"] > 0

        _, status = self.inside(service, "cat", "/proc/1/status")
        assert re.search(r"^Uid:(\s10001){4}$", status, re.MULTILINE)
        assert re.search(r"^Gid:(\s10001){4}$", status, re.MULTILINE)
        assert set(re.findall(r"^Cap(?:Eff|Prm|Bnd):\s(\w+)$", status, re.MULTILINE)) == {"0" * 16}
        assert "NoNewPrivs:\t1" in status
        code, output = self.inside(service, "touch", "/opt/skytether/file")
        assert code != 0
        assert "Read-only file system" in output
        assert self.inside(service, "touch", "/tmp/file")[0] == 0

        code, where = self.inside(
            service, "python", "-c", "import skytether; print(skytether.__file__)"
        )
        assert where.startswith("/opt/skytether/lib/"), where
        assert self.inside(service, "sh", "-c", "command -v cc gcc g++ make")[0] != 0

    def check_isolation(self) -> None:
        """Client and server share no network; netem is the client's only neighbour."""
        client, server = self.addresses("client"), self.addresses("server")
        assert set(client) == {self.network("air")}
        assert set(server) == {self.network("ground")}
        assert set(self.addresses("netem")) == {self.network("air"), self.network("ground")}
        for name in ("air", "ground"):
            assert json.loads(self.docker("network", "inspect", self.network(name)))[0]["Internal"]

        for service in ("server", "netem"):
            assert self.state(service)["Health"]["Status"] == "healthy"
            # The health check must fail in a container where nobody listens.
            _, *question = self.inspect(service)["Config"]["Healthcheck"]["Test"]
            assert self.inside(service, *question)[0] == 0
            assert self.inside("client", *question)[0] == 1

        (address,) = server.values()
        code, output = self.ask_for_the_server("server")
        assert (code, "cannot find server" in output) == (1, True), output
        code, output = self.ask_for_the_server(address)
        assert (code, f"no answer from {address}" in output) == (1, True), output

    def ask_for_the_server(self, host: str) -> tuple[int, str]:
        argv = ["docker", "run", "--rm", "--network", f"container:{self.id('client')}"]
        argv += ["skytether-client", "client", "demo", "--id=2", "--link.connect-s=2"]
        return attempt(*argv, f"--server={host}:47001", "--insecure")


@contextlib.contextmanager
def containers(
    compose: list[str], seconds: int, *, standby: bool = False, more: str = ""
) -> Iterator[Containers]:
    """The three containers, running; removed at the end in any case."""
    three = Containers(compose, seconds, standby, more)
    try:
        three.compose("up", "--detach")
        say(f"up, for a flight of {seconds} s")
        yield three
    except BaseException:
        with contextlib.suppress(AssertionError):
            print(three.compose("logs", "--no-color"))
        raise
    finally:
        three.compose("down", "--volumes", "--remove-orphans")


@pytest.fixture(scope="module")
def compose() -> list[str]:
    """Command for Compose, after it has built the images."""
    given = os.environ.get("COMPOSE")
    known = [given] if given else ["docker compose", "docker-compose"]
    if not works("docker", "version"):
        pytest.skip("no Docker engine answers")
    command = next((found for found in map(shlex.split, known) if works(*found, "version")), None)
    if command is None:
        pytest.skip(f"no Compose: tried {' and '.join(known)}")
    say(f"{shlex.join(command)} builds the images")
    Containers(command, FLIGHT_S).compose("build")
    return command


def check_capture(capture: Path, part: Path) -> None:
    """No position or velocity of the flight is visible in the captured packets."""
    payloads, rows = capture.read_bytes(), read(part)
    assert len(payloads) > 100 * len(rows)  # an OBSERVATION a step, before netem and after
    states = {number.tobytes() for number in rows["state"].ravel()}
    states = {state for state in states if len(set(state)) > 5}  # 0 and 2.0 occur everywhere
    assert len(states) > len(rows)
    found = [state for state in states if state in payloads]
    assert not found
    say(f"{len(payloads)} B captured; none of {len(states)} numbers of the state is in them")


def works(*command: str) -> bool:
    try:
        return attempt(*command)[0] == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def attempt(
    *command: str, within_s: float = PATIENCE_S, more_env: Mapping[str, str] = MappingProxyType({})
) -> tuple[int, str]:
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=within_s,
        check=False,
        env={**os.environ, **more_env},
    )
    return done.returncode, done.stdout


def run(*command: str, more_env: Mapping[str, str] = MappingProxyType({})) -> str:
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
        env={**os.environ, **more_env},
    )
    said = f"{shlex.join(command)}\n{done.stdout[-4000:]}{done.stderr[-4000:]}"
    assert done.returncode == 0, said
    return done.stdout


def number(name: str, figures: str) -> int:
    found = re.search(rf"(?m): +{name} +(\d+)$", figures)
    return int(found[1]) if found else 0


T = TypeVar("T")


def until(what: str, condition: Callable[[], T | None], within_s: float = PATIENCE_S) -> T:
    deadline_s = time.monotonic() + within_s
    while not (value := condition()):
        assert time.monotonic() < deadline_s, f"in {within_s:g} s not come: {what}"
        time.sleep(0.2)
    return value


def say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')}  {text}", flush=True)
