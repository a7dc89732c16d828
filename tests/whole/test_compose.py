"""Services of docker-compose.yml, as far as they can be checked without an engine."""

import ast
import re
import shutil
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

from helpers import ran
from skytether.client.__main__ import ClientOptions
from skytether.shared.scenario import reading
from skytether.shell.commandline import command

ROOT = Path(__file__).parents[2]
FILE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICES: dict[str, dict[str, Any]] = FILE["services"]
ALWAYS = {"keys", "server", "netem", "client", "page"}
PROFILES = {
    "observe": {"prometheus", "grafana"},
    "px4": {"px4", "aboard"},
    "ros2": {"ground", "driver"},
    "netem": {"relay"},
    "standby": {"standby", "netem-standby"},
}
DOCKERFILE = (ROOT / "Dockerfile").read_text()


def argv(service: str, scenario: str) -> list[str]:
    command = SERVICES[service]["command"]
    named = [re.sub(r"\$\{SCENARIO:-demo\}", scenario, each) for each in command]
    return [re.sub(r"\$\{\w+:-(.*?)\}", r"\1", each) for each in named]


def test_a_profile_adds_services_and_changes_none() -> None:
    """Without a profile there are the five services of a flight, independent of profiles."""
    assert {name for name, each in SERVICES.items() if "profiles" not in each} == ALWAYS
    for profile, added in PROFILES.items():
        assert {n for n, each in SERVICES.items() if each.get("profiles") == [profile]} == added
    for name in ALWAYS:
        assert set(SERVICES[name].get("depends_on", {})) <= ALWAYS


@pytest.mark.docker
@pytest.mark.long
def test_compose_understands_its_file() -> None:
    docker = shutil.which("docker")
    if docker is None or ran(docker, "compose", "version").returncode:
        pytest.skip("no Compose")
    for profile, added in {"": set(), **PROFILES}.items():
        flag = ["--profile", profile] if profile else []
        done = ran(docker, "compose", *flag, "config", "--services", cwd=ROOT)
        assert done.returncode == 0, done.stderr
        assert set(done.stdout.split()) == ALWAYS | added


def test_each_image_of_ours_is_a_stage_with_a_lock_file() -> None:
    targets = {each["build"]["target"] for each in SERVICES.values() if "build" in each}
    last = r"^FROM (?:bare|ros:\S+) AS (\w+)$"
    assert targets == set(re.findall(last, DOCKERFILE, re.MULTILINE))
    for lock in re.findall(r"^COPY (locks/\w+\.lock)", DOCKERFILE, re.MULTILINE):
        assert (ROOT / lock).exists()


def test_the_autopilot_is_pinned_and_speaks_to_the_computer_aboard_alone() -> None:
    autopilot, aboard = SERVICES["px4"], SERVICES["aboard"]
    assert re.fullmatch(r"px4io/px4-sitl:v\d+\.\d+\.\d+", autopilot["image"])
    assert aboard["network_mode"] == "service:px4"
    assert "networks" not in aboard
    assert not {"ports"} & {*autopilot, *aboard}
    assert all(FILE["networks"][each]["internal"] for each in autopilot["networks"])
    for each in (autopilot, aboard):
        assert each["read_only"]
        assert each["cap_drop"] == ["ALL"]


def test_the_computer_aboard_flies_it_by_the_scenario_that_the_server_has() -> None:
    """The vehicle is the autopilot on its own loopback, with parameters set."""
    name, *flags = argv("aboard", "px4")
    assert (name, argv("server", "px4")[1]) == ("client", flags[0])
    here = [flag for flag in flags if "=/" not in flag]  # paths are those of the container
    options = command.parse(ClientOptions(), here, "skytether client", "")
    assert options.set_parameters
    assert options.config.model == reading.load("px4").model
    assert options.config.vehicle.kind == "mavlink"
    assert options.config.vehicle.address == "udp:127.0.0.1:14540"


def test_the_robot_and_its_router_are_reached_by_the_computer_aboard_alone() -> None:
    robot, driver = SERVICES["ground"], SERVICES["driver"]
    assert driver["network_mode"] == "service:ground"
    assert not {"ports"} & {*robot, *driver}
    assert all(FILE["networks"][each]["internal"] for each in robot["networks"])
    name, *flags = argv("driver", "demo")
    assert (name, argv("server", "demo")[1]) == ("client", flags[0])
    here = [flag for flag in flags if "=/" not in flag]  # paths are those of the container
    options = command.parse(ClientOptions(), here, "skytether client", "")
    assert options.config.vehicle.kind == "ros2"
    assert options.config.vehicle.address == "tcp:127.0.0.1:7447"
    compile((ROOT / "deploy" / "ros2" / "robot.py").read_text(), "robot.py", "exec")


def test_what_an_image_compiles_names_what_exists() -> None:
    """Without an engine, nothing else runs the Python in the image's file."""
    codes = re.findall(r'python -P -c +"([^"]+)"', DOCKERFILE.replace("\\\n", ""))
    assert codes
    for code in codes:
        tree, modules = ast.parse(re.sub(r" {2,}", " ", code)), {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                for each in node.names:
                    modules[each.name] = import_module(f"{node.module}.{each.name}")
        for node in ast.walk(tree):
            match node:
                case ast.Attribute(value=ast.Name(id=name), attr=attribute) if name in modules:
                    assert hasattr(modules[name], attribute)
