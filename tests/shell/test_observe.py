"""Compose profile `observe`: every metric of its dashboard is served, and access is restricted.

Neither Prometheus nor Grafana runs here; server, netem and client do.
"""

import asyncio
import json
import re
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from skytether.cli.processes import Child, started
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import ModeChanged
from skytether.shared.events.processes import Measured
from skytether.shell.processes.log import LogLine
from skytether.shell.processes.metrics import TABLES, names

ROOT = Path(__file__).parents[2]
OBSERVE = ROOT / "deploy"
DOCUMENT = ROOT / "docs" / "operating.md"
DASHBOARD = json.loads((OBSERVE / "grafana" / "dashboards" / "skytether.json").read_text())
RULES = yaml.safe_load((OBSERVE / "rules.yml").read_text())
COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
THREE = ("server", "netem", "client")
NEVER_YET = {
    "skytether_server_lost_horizons_total",
    "skytether_server_dropped_datagrams_total",
    "skytether_client_dropped_datagrams_total",
    *(f"skytether_{end}_path_failure_ratio" for end in ("server", "client")),
    *(f"skytether_{end}_path_acknowledgement_seconds" for end in ("server", "client")),
    "skytether_client_leadership",
    "skytether_client_leader",
}
"""Metrics that exist only after an event of their kind, with several paths, or with a standby."""
EXPRESSIONS = [
    *(target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]),
    *(rule["expr"] for group in RULES["groups"] for rule in group["rules"]),
]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, set[str]], str]:
    return asyncio.run(_flown(tmp_path_factory.mktemp("feeds")))


@pytest.fixture(scope="module")
def exported(flown: tuple[dict[str, set[str]], str]) -> dict[str, set[str]]:
    """Names of the metrics that processes serve in flight, and of their labels."""
    return flown[0]


async def _flown(feeds: Path) -> tuple[dict[str, set[str]], str]:
    """Metrics of each process in flight, and the output of the documented reader of a feed."""
    ports: dict[str, Address] = {}
    flying = asyncio.Event()

    def hear(process: str) -> Any:
        def on_event(line: LogLine) -> None:
            event = line.event
            if isinstance(event, Measured):
                ports[process] = event.host, event.port
            if isinstance(event, ModeChanged) and event.after == "track":
                flying.set()

        return on_event

    def process(name: str, *argv: str) -> AbstractAsyncContextManager[Child]:
        common = ["demo", "--metrics", "127.0.0.1:0", "--feed", str(feeds / f"{name}.feed")]
        return started(name, *common, *argv, on_event=hear(name))

    here = ["--bind", "127.0.0.1:0"]
    async with (
        process("server", *here) as server,
        process("netem", *here, "--server", at(server.address)) as netem,
        process("client", "--server", at(netem.address)),
    ):
        await asyncio.wait_for(flying.wait(), 180.0)
        found: dict[str, set[str]] = {}
        deadline = asyncio.get_running_loop().time() + 180.0
        # Figures are a second old: wait until they include the first plan.
        while "skytether_client_age_seconds" not in found:
            assert asyncio.get_running_loop().time() < deadline
            await asyncio.sleep(0.2)
            for address in ports.values():
                body = await asyncio.to_thread(fetched, address, "/metrics")
                for family in text_string_to_metric_families(body):
                    for sample in family.samples:
                        found.setdefault(sample.name, set()).update(sample.labels, {"job"})
        (example,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
        reader = await asyncio.create_subprocess_exec(
            sys.executable, "-c", example, cwd=feeds, stdout=asyncio.subprocess.PIPE
        )
        printed, _ = await reader.communicate()
        assert reader.returncode == 0
    return found, printed.decode()


def at(address: Address) -> str:
    return f"{address[0]}:{address[1]}"


def fetched(address: Address, path: str) -> str:
    with urllib.request.urlopen(f"http://{at(address)}{path}", timeout=180.0) as answer:
        return str(answer.read().decode())


def metrics_of(expression: str) -> set[str]:
    return set(re.findall(r"skytether_[a-z_]+", expression))


@pytest.mark.long
@pytest.mark.realtime
def test_every_metric_that_is_asked_for_is_served(exported: dict[str, set[str]]) -> None:
    asked = set[str]().union(*map(metrics_of, EXPRESSIONS))
    assert asked - set(exported) <= NEVER_YET
    assert set(exported) <= names()


def test_every_metric_that_is_asked_for_has_a_name() -> None:
    asked = set[str]().union(*map(metrics_of, EXPRESSIONS))
    assert asked <= names()
    assert len(asked) > 20


@pytest.mark.long
@pytest.mark.realtime
def test_the_documented_reader_of_a_feed_reads_it(flown: tuple[dict[str, set[str]], str]) -> None:
    lines = flown[1].splitlines()
    assert lines
    assert all(re.fullmatch(r"vehicle 1 is at \[[^]]*\] m", line) for line in lines)


@pytest.mark.long
@pytest.mark.realtime
def test_every_label_that_is_asked_for_is_served(exported: dict[str, set[str]]) -> None:
    """In selections and sums; labels added by Prometheus are known."""
    for expression in EXPRESSIONS:
        labels = set(re.findall(r"(\w+)(?:=|=~|!=)\"", expression))
        labels |= {
            label.strip()
            for group in re.findall(r"by \(([^)]*)\)", expression)
            for label in group.split(",")
        }
        known = set[str]().union(*(exported.get(name, set()) for name in metrics_of(expression)))
        if metrics_of(expression) <= NEVER_YET:
            known |= {"reason", "path", "vehicle", "server"}
        assert labels <= known | {"job"}, expression


def test_expressions_fit_what_they_are_about() -> None:
    kinds = {metric.name: metric.kind for table in TABLES.values() for metric in table}
    for expression in EXPRESSIONS:
        for opening, closing in ("()", "[]", "{}"):
            assert expression.count(opening) == expression.count(closing), expression
        for name in re.findall(r"(?:rate|increase)\(skytether_(\w+)", expression):
            assert kinds[name.removesuffix("_bucket")] in ("counter", "histogram"), expression
        for name in re.findall(r"skytether_(\w+_total)\b(?![^)]*\[)", expression):
            assert name == "feed_dropped_readers_total"  # a total is intended there
        if "histogram_quantile" in expression:
            assert "sum by (le" in expression
            assert "_bucket" in expression


def test_panels_ask_the_one_source_there_is() -> None:
    settings = OBSERVE / "grafana/provisioning/datasources/prometheus.yml"
    (source,) = yaml.safe_load(settings.read_text())["datasources"]
    assert {panel["datasource"]["uid"] for panel in DASHBOARD["panels"]} == {source["uid"]}
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])


def test_what_is_scraped_is_what_the_services_serve() -> None:
    settings = yaml.safe_load((OBSERVE / "prometheus.yml").read_text())
    targets = {
        job["job_name"]: target
        for job in settings["scrape_configs"]
        for each in job["static_configs"]
        for target in each["targets"]
    }
    assert targets == {service: f"{service}:9464" for service in THREE}
    for service in THREE:
        assert "--metrics=0.0.0.0:9464" in COMPOSE[service]["command"]
        assert "ports" not in COMPOSE[service]
        assert set(COMPOSE[service]["networks"]) <= {"air", "ground"}


def observing() -> Iterator[tuple[str, dict[str, Any]]]:
    return ((name, each) for name, each in COMPOSE.items() if each.get("profiles") == ["observe"])


def test_the_observers_are_pinned_and_locked_in() -> None:
    assert {name for name, _ in observing()} == {"prometheus", "grafana"}
    for _, service in observing():
        assert re.fullmatch(r"[a-z]+/[a-z]+:v?\d+\.\d+\.\d+", service["image"])
        assert service["read_only"]
        assert service["cap_drop"] == ["ALL"]
        assert all(port.startswith("127.0.0.1:") for port in service["ports"])
        for volume in service["volumes"]:
            source, _, mode = volume.split(":") if volume[0] == "." else ("", "", "ro")
            assert (ROOT / source).exists()
            assert mode == "ro"
    environment = COMPOSE["grafana"]["environment"]
    assert environment["GF_AUTH_ANONYMOUS_ORG_ROLE"] == "Viewer"
    home = environment["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"]
    assert (OBSERVE / "grafana" / home.removeprefix("/etc/skytether/")).exists()
