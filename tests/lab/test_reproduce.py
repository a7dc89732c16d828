"""Reproduction: methods, verdicts, and the files of the report."""

import csv
import json
import math
import re
import shlex
import struct
import subprocess
import sys
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from helpers import refused_before_writing
from skytether.__main__ import main
from skytether.lab.engine import studies
from skytether.lab.engine.calibration import TABLE_1
from skytether.lab.engine.studies import EVENT, EVERY, NONE, PERIODIC, MethodFlights, Study
from skytether.lab.engine.sweep import GridAxis, Sweep
from skytether.lab.pages import plates, report
from skytether.netem.impairments.direction import impairments
from skytether.shared.scenario import reading
from skytether.shared.scenario.registry import IMPAIRMENTS
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.sim import flight

ROOT = Path(__file__).parents[2]
PAPER = reading.load("paper")

(LINE,) = [
    line
    for line in (ROOT / "docs" / "running.md").read_text().splitlines()
    if line.startswith("skytether reproduce")
]

FIGURES = {
    "fig2",
    "fig3",
    "fig4",
    "fig5",
    "fig5-pareto",
    "estimate-error",
    "rmse-loss",
    "rmse-delay",
    "rmse-jitter",
    "rmse-mismatch",
    "rmse-clock",
}
TABLES = {"table1", "traffic", "real"}


# -- methods -------------------------------------------------------------------------------------


def test_the_methods_are_the_papers_scenarios() -> None:
    plan = Sweep("paper", PAPER, [studies.METHODS], 1)
    for name, method in (
        ("paper-no-compensation", NONE),
        ("paper-every-step", EVERY),
        ("paper", EVENT),
    ):
        assert replace(plan.scenario_of(method), title="") == replace(reading.load(name), title="")


SUMMARY = summarise(PAPER, "paper", flight.fly(replace(PAPER, duration=6.0)).client)


def runs(*ratios: float, rmse: float = 1.0) -> list[Summary]:
    traffic = {"uplink_packets": 10, "uplink_bytes": 400}
    traffic |= {"downlink_packets": 30, "downlink_bytes": 600}
    error = {"rmse_x": rmse, "rmse_y": 2.0 * rmse, "rmse_xy": 3.0 * rmse}
    return [replace(SUMMARY, event_ratio=ratio, **traffic, **error) for ratio in ratios]


@pytest.mark.parametrize(
    ("ratio", "steps"), [(1.0, 1), (0.8, 1), (0.7, 2), (0.1, 10), (0.098, 10), (0.093, 11)]
)
def test_periodic_sends_at_the_nearest_rate(ratio: float, steps: int) -> None:
    """Nearest as a rate: 0.7 is nearer to 1/2 than to 1."""
    assert studies.period(runs(ratio - 0.01, ratio + 0.01)) == steps


def test_the_baseline_has_at_each_value_the_rate_that_the_trigger_had_there() -> None:
    axis = GridAxis(
        "loss", (0.0, 0.5), ({"network.uplink.loss": 0.0}, {"network.uplink.loss": 0.5})
    )
    study = Study("loss", "loss", PAPER, axis, 3, 0.0)
    second = study.second({(0.0, EVENT): runs(0.1), (0.5, EVENT): runs(0.25)})
    flown = [task.scenario for task in second.tasks()]
    assert [scenario.control.trigger for scenario in flown] == ["periodic(10)", "periodic(4)"]
    assert [scenario.uplink.loss for scenario in flown] == [0.0, 0.5]


def test_jitter_grows_while_the_mean_delay_stays() -> None:
    jitter = {study.name: study for study in studies.curve_studies(PAPER, studies.full(1))}[
        "jitter"
    ]
    for (std_ms, _), task in zip(jitter.first().cells, jitter.first().tasks(), strict=True):
        for way in (task.scenario.network.uplink, task.scenario.network.downlink):
            _, slot_s, slots_mean, _ = IMPAIRMENTS.calls(way)[0].values
            assert impairments(way).mean_s == pytest.approx(0.44)
            assert slot_s * math.sqrt(slots_mean) == pytest.approx(std_ms / 1e3)


# -- verdicts ------------------------------------------------------------------------------------


def columns() -> Mapping[str, MethodFlights]:
    """Two runs each, with errors of 1, 2 and 3."""
    cells = {method: MethodFlights(runs(0.1, 0.1)) for method in TABLE_1}
    return cells | {PERIODIC: MethodFlights(runs(0.1, 0.1, rmse=0.5), 10)}


def test_a_deviation_is_what_ours_is_more_than_the_papers() -> None:
    entries = {(entry.column, entry.entry): entry for entry in studies.table_1(columns())}
    assert len(entries) == 16
    entry = entries[EVENT, "rmse_xy"]
    assert (entry.paper, entry.here, entry.ci95) == (0.2492, 3.0, 0.0)
    assert entry.deviation == pytest.approx(3.0 / 0.2492 - 1.0)
    assert entries[EVENT, "event_ratio"].deviation == pytest.approx(0.0)
    assert entries[NONE, "event_ratio"].deviation is None
    assert entries[PERIODIC, "rmse_xy"].paper is None


def test_the_report_says_who_wins_from_the_numbers() -> None:
    worse = columns()
    better = {**worse, EVENT: MethodFlights(runs(0.1, rmse=0.25))}
    said = [
        (report.verdict(studies.table_1(each), each), report.paper_table([], each).says)
        for each in (worse, better)
    ]
    assert re.search(r"\bloses\b.* 3\.000 m against 1\.500 m", said[0][0])
    assert "100% more" in said[0][1]
    assert re.search(r"\bbeats\b.* 0\.750 m against 1\.500 m", said[1][0])
    assert "50% less" in said[1][1]


def test_both_directions_count_in_the_total() -> None:
    cell = MethodFlights(runs(0.1, 0.2))
    assert cell.estimate("total_packets") == (40.0, 0.0)
    assert cell.estimate("total_bytes") == (1000.0, 0.0)


def test_a_curve_is_won_only_where_intervals_are_apart() -> None:
    """One value each: better, worse, and overlapping."""
    spread = [*runs(0.1, rmse=0.1), *runs(0.1, rmse=2.0)]
    trigger = {0.0: runs(0.1, 0.1, rmse=2.0), 1.0: runs(0.1, 0.1, rmse=0.5), 2.0: spread}
    cells = {}
    for value, errors in trigger.items():
        cells |= {
            (value, EVENT): MethodFlights(errors),
            (value, PERIODIC): MethodFlights(runs(0.1, 0.1), 10),
        }
    study = Study("x", "x", PAPER, GridAxis("x", (0.0, 1.0, 2.0)), 2, 0.0)
    assert plates.against_periodic(study, cells) == (1, 1)


# -- the command ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reproduce")
    command = [sys.executable, "-P", "-m", "skytether", *shlex.split(LINE)[1:]]
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "11 figures; 178 runs flown" in run.stdout
    return folder / shlex.split(LINE)[-1]


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.tables: dict[str, list[list[str]]] = {}
        """Rows of each table by its name, each with the heading of its group in front."""
        self.group, self.names_group = "", False
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if tag not in ("img", "meta"):
            self.open.append(tag)
        if found.get("id"):
            self.ids.append(str(found["id"]))
        self.addresses += [str(found[name]) for name in ("src", "href") if name in found]
        if tag == "table":
            self.tables[self.ids[-1]], self.group = [], ""
        if tag == "tr":
            self.names_group = found.get("class") == "group"
            begins = [self.group] if self.group and not self.names_group else []
            self.tables[self.ids[-1]].append(begins)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "td":
            self.tables[self.ids[-1]][-1].append(data)
        if self.open and self.open[-1] == "th" and self.names_group:
            self.group = data


@pytest.mark.long
def test_every_figure_is_there_three_times_and_in_a_size_to_look_at(out: Path) -> None:
    """As PNG, PDF and CSV; the PNG is one or two columns wide at 220 dots per inch."""
    assert {path.stem for path in out.glob("*.png")} == FIGURES
    for name in FIGURES:
        png = (out / f"{name}.png").read_bytes()
        width, height = struct.unpack(">II", png[16:24])
        assert width in (770, 1575)
        assert 500 < height < 1000
        assert (out / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        header, *rows = csv.reader((out / f"{name}.csv").read_text().splitlines())
        assert rows
        assert {len(row) for row in rows} == {len(header)}


@pytest.mark.long
def test_the_page_opens_offline_and_shows_all(out: Path) -> None:
    text = (out / "report.html").read_text()
    page = Page(text)
    assert page.open == []
    assert {*page.ids} == FIGURES | TABLES
    assert len(page.addresses) == len(FIGURES)
    assert all(address.startswith("data:image/png;base64,") for address in page.addresses)
    assert "http" not in text
    assert "url(" not in text
    assert LINE in text


@pytest.mark.long
def test_the_tables_on_the_page_are_those_of_the_csv_files(out: Path) -> None:
    page = Page((out / "report.html").read_text())
    entries = list(csv.DictReader((out / "table1.csv").read_text().splitlines()))
    shown = [row for row in page.tables["table1"] if row]
    assert len(entries) == len(shown) == 16
    for entry, (column, name, paper, here, ci95, deviation) in zip(entries, shown, strict=True):
        assert (column, name) == (entry["column"], entry["entry"])
        assert (here, ci95) == (f"{float(entry['here']):.4f}", f"{float(entry['ci95']):.4f}")
        if entry["paper"]:
            assert paper == f"{float(entry['paper']):.4f}"
            off = float(entry["here"]) / float(entry["paper"]) - 1.0
            assert deviation == f"{off:+.1%}"
    (udp, *_) = csv.DictReader((out / "real.csv").read_text().splitlines())
    assert page.tables["real"][1][:2] == [EVERY, f"{float(udp['rmse_xy_udp']):.4f}"]


@pytest.mark.long
def test_packets_really_took_what_was_drawn(out: Path) -> None:
    """Drawn delays follow (17), within the band of Dvoretzky, Kiefer and Wolfowitz; no packet over
    UDP took less than was drawn for it. How much more it took is the machine's affair.
    """
    rows = list(csv.DictReader((out / "fig2.csv").read_text().splitlines()))
    lattice = [row for row in rows if row["probability"]]
    assert float(lattice[0]["delay_ms"]) == 400.0
    assert float(lattice[0]["probability"]) == pytest.approx(math.exp(-2.0))
    assert sum(float(row["probability"]) for row in lattice) == pytest.approx(1.0, abs=1e-3)
    law, shown = (
        np.array([float(row[name]) for row in rows]) for name in ("cumulative", "cumulative_udp")
    )
    at_ms = np.array([float(row["delay_ms"]) for row in rows])
    took_ms, drawn_ms = np.load(out / "delays.npy").T
    drawn = (drawn_ms <= at_ms[:, np.newaxis] + 1e-6).mean(axis=1)
    assert np.abs(drawn - law).max() < math.sqrt(math.log(2.0 / 1e-4) / (2.0 * len(drawn_ms)))
    assert shown == pytest.approx((took_ms <= at_ms[:, np.newaxis]).mean(axis=1))
    assert (took_ms >= drawn_ms).all()


@pytest.mark.long
def test_the_second_time_it_only_draws(
    out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    monkeypatch.chdir(out.parent)
    assert main(shlex.split(LINE)[1:]) == 0
    assert "11 figures; 0 runs flown" in capsys.readouterr().out
    changed = {path.name for path, content in kept.items() if path.read_bytes() != content}
    assert changed == {"report.html", "calls.jsonl"}
    calls = [json.loads(line) for line in (out / "calls.jsonl").read_text().splitlines()]
    assert [call["runs"] for call in calls] == [178, 0]


@pytest.mark.long
def test_a_folder_of_another_reproduction_is_refused(
    out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reproduce", "--out", str(out)]) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"reproduce: {out}/sweeps/table1: runs: got 100, expected 4")


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--runs", "0"], "--runs: got 0, expected 1 to 100000"),
        (["--workers", "0"], "--workers: got 0, expected 1 to 1024"),
    ],
)
def test_an_impossible_reproduction_is_refused(
    argv: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = refused_before_writing(["reproduce", *argv], tmp_path, capsys)
    assert message == f"reproduce: {said}"
