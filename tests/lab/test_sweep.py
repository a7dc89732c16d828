"""Sweeps: grids, journals, tables, commands and clusters."""

import csv
import importlib.util
import io
import json
import pickle
import re
import signal
import subprocess
import sys
from contextlib import ExitStack, closing, redirect_stdout
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from helpers import PATIENCE_S, refusal, refused_before_writing, until
from skytether.__main__ import main
from skytether.lab.commands import pool
from skytether.lab.engine.journal import StudyJournal, sealed
from skytether.lab.engine.sweep import CHUNK, GridAxis, Runs, Sweep, estimate, fly, parse_axis
from skytether.lab.pages import figures
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import value
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import summarise
from skytether.sim import flight

SWEEP = ["sweep", "paper", "--duration", "5", "--settle", "1", "--runs", "30"]
SWEEP += ["--grid", "control.input_weight=1:3:2", "--grid", "control.trigger=state_gap,periodic"]
"""Sweep of four cells, with two tasks each."""
TASKS = 8
TABLES = ("runs.csv", "cells.csv")

PAPER = replace(reading.load("paper"), duration=5.0, settle=1.0)


# -- grids and tasks -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "key", "values"),
    [
        ("control.input_weight=0.5:2:4", "control.input_weight", (0.5, 1.0, 1.5, 2.0)),
        ("control.input_weight=8:0.5:2", "control.input_weight", (8.0, 0.5)),
        ("control.horizon=20:40:3", "control.horizon", (20, 30, 40)),
        ("control.input_weight=1,2.5", "control.input_weight", (1, 2.5)),
        ("control.trigger=state_gap,always", "control.trigger", ("state_gap", "always")),
        ('control.trigger="state_gap"', "control.trigger", ("state_gap",)),
        ("control.input_reference=true,false", "control.input_reference", (True, False)),
        ("model.tau_s=[0.8],[0.8, 0.9]", "model.tau_s", ([0.8], [0.8, 0.9])),
        ("reference.file=a.csv, b/c.csv", "reference.file", ("a.csv", "b/c.csv")),
    ],
)
def test_a_grid_is_read_as_it_is_meant(text: str, key: str, values: tuple[Any, ...]) -> None:
    """Whole numbers stay whole, and the written form is read back."""
    axis = parse_axis(text)
    assert axis == GridAxis(key, values)
    assert list(map(type, axis.values)) == list(map(type, values))
    assert parse_axis(str(axis)) == axis


NO_GRIDS = [
    "control.input_weight",
    "control.input_weight=",
    "=1,2",
    "control.input_weight=1:2",
    "control.input_weight=1:2:1",
    "control.input_weight=1:2:3.5",
    "control.input_weight=a:b:3",
    "control.input_weight=0:inf:3",
    "control.input_weight=1,,2",
    "control.input_weight=[1,2",
]
FORM = "expected KEY=START:STOP:COUNT or KEY=VALUE,VALUE,..."


@pytest.mark.parametrize(
    ("text", "said"),
    [
        *((text, f"--grid: got {text!r}, {FORM}") for text in NO_GRIDS),
        (
            "seed=1,2",
            "--grid: got 'seed', expected another key: the seed counts the runs of a cell",
        ),
        (
            "control.input_weight=1,2,1.0",
            "--grid: control.input_weight: got 1 twice, expected values that differ",
        ),
    ],
)
def test_a_grid_that_is_none_is_refused(text: str, said: str) -> None:
    assert refusal(lambda: parse_axis(text)) == said


@pytest.mark.parametrize(
    ("grids", "said"),
    [
        (
            ["control.horizom=1,2"],
            "paper with control.horizom=1: control.horizom: no such key; did you mean horizon?",
        ),
        (["seed.x=1,2"], "seed.x: no such key"),
        (
            ["control.input_weight=1,2", "control.horizon=40,0"],
            (
                "paper with control.input_weight=1, control.horizon=0: "
                "control.horizon: got 0, expected a whole number >= 1"
            ),
        ),
        (
            ["control.input_weight=1,2", "control.input_weight=3,4"],
            "--grid: control.input_weight: got it twice, expected each key once",
        ),
    ],
)
def test_a_cell_that_cannot_be_flown_is_refused_before_any_is(grids: list[str], said: str) -> None:
    assert refusal(lambda: Sweep("paper", PAPER, list(map(parse_axis, grids)), 3)) == said


def test_seeds_end_where_a_scenarios_do() -> None:
    last = replace(PAPER, seed=2**32 - 3)
    assert next(Sweep("paper", last, [], 3).tasks()).seeds[-1] == 2**32 - 1
    with pytest.raises(ConfigError, match="expected at most 4294967292 for 4 runs"):
        Sweep("paper", last, [], 4)


def test_a_sweep_is_every_combination_in_chunks_of_seeds() -> None:
    """The last grid changes fastest; the last chunk is smaller."""
    axes = [parse_axis("control.input_weight=1,2"), parse_axis("control.trigger=state_gap,always")]
    tasks = list(Sweep("paper", replace(PAPER, seed=7), axes, CHUNK + 5).tasks())
    controls = [(t.scenario.control.input_weight, t.scenario.control.trigger) for t in tasks[::2]]
    assert controls == [(1.0, "state_gap"), (1.0, "always"), (2.0, "state_gap"), (2.0, "always")]
    assert [(task.cell, task.chunk) for task in tasks[:3]] == [(0, 0), (0, 1), (1, 0)]
    assert tasks[2].seeds + tasks[3].seeds == tuple(range(7, 7 + CHUNK + 5))
    assert len(tasks[0].seeds) == CHUNK


def test_a_task_gives_the_summaries_of_its_flights_one_by_one() -> None:
    (task,) = Sweep("paper", PAPER, [parse_axis("control.trigger=periodic")], 3).tasks()
    for seed, run in zip((1, 2, 3), fly(task), strict=True):
        flown = replace(task.scenario, seed=seed)
        alone = flight.fly(flown)
        assert run == summarise(flown, "paper", alone.client, alone.server, alone.netem)


def test_a_run_that_never_flew_has_no_error_and_spoils_no_mean() -> None:
    deaf = "paper(0.4, 0.02, 2.0) & loss(0.85)"
    scenario = replace(
        PAPER,
        duration=2.0,
        network=replace(PAPER.network, uplink=deaf),
        link=replace(PAPER.link, connect_s=5.0),
    )
    sweep = Sweep("paper", scenario, [], 6)
    (task,) = sweep.tasks()
    done = {(0, 0): fly(task)}
    rows = list(csv.DictReader(sweep.runs_csv(done).splitlines()))
    failed = [row for row in rows if row["steps"] == "0"]
    assert 0 < len(failed) < 6
    assert {(row["rmse_xy"], row["duration_s"]) for row in failed} == {("", "0.0")}
    (cell,) = csv.DictReader(sweep.cells_csv(done).splitlines())
    assert (cell["runs"], cell["flown"]) == ("6", str(6 - len(failed)))
    errors = [float(row["rmse_xy"]) for row in rows if row["rmse_xy"]]
    assert float(cell["rmse_xy"]) == pytest.approx(np.mean(errors))
    sent = [float(row["uplink_horizons"]) for row in rows if row["uplink_horizons"]]
    by_cause = float(cell["uplink_above"]) + float(cell["uplink_due"])
    assert by_cause == pytest.approx(np.mean(sent))
    assert by_cause > 0


def test_the_interval_is_students() -> None:
    """1, 2, 3, 4: mean 2.5, deviation 1.291, t = 3.182 with three degrees of freedom."""
    run = summarise(PAPER, "paper", flight.fly(PAPER).client)
    runs = [replace(run, stale=stale) for stale in (1, 2, 3, 4)]
    mean, half = estimate(runs, "stale")
    assert mean == 2.5
    assert half == pytest.approx(3.1824 * 1.2910 / 2, rel=1e-4)
    assert estimate(runs[:1], "stale") == (1.0, None)
    assert estimate(runs, "rmse_z") == (None, None)


def test_axes_of_pictures_have_units_where_these_are_known() -> None:
    labels = {key: figures.label(key) for key in LABELS}
    assert labels == LABELS
    table = reading.to_table(PAPER)
    for key in figures.OTHER_UNITS:
        if not key.startswith("control.trigger."):  # exists with one policy only
            value(table, key)


LABELS = {
    "control.trigger.state_gap.decay_rate": "control.trigger.state_gap.decay_rate [1/s]",
    "network.uplink.paper.minimum_s": "network.uplink.paper.minimum_s [s]",
    "vehicle.gust_mps2": "vehicle.gust_mps2 [m/s²]",
    "control.input_weight": "control.input_weight",
    "control.change_weight": "control.change_weight",
    "model.axes": "model.axes",
}


# -- journals ------------------------------------------------------------------------------------

ONE = Sweep("paper", PAPER, [parse_axis("control.input_weight=1,2")], 3)
OTHERS = {
    "runs: got 4, expected 3": Sweep("paper", PAPER, ONE.axes, 4),
    "name: got 'demo', expected 'paper'": Sweep("demo", PAPER, ONE.axes, 3),
    "grid: got ['control.input_weight=1,3'], expected ['control.input_weight=1,2']": Sweep(
        "paper", PAPER, [parse_axis("control.input_weight=1,3")], 3
    ),
    "control.change_weight: got 2.0, expected 0.03": Sweep(
        "paper", replace(PAPER, control=replace(PAPER.control, change_weight=2.0)), ONE.axes, 3
    ),
    "network.uplink: got 'none', expected 'paper(0.4, 0.02, 2.0) & loss(0.1)'": Sweep(
        "paper", replace(PAPER, network=replace(PAPER.network, uplink="none")), ONE.axes, 3
    ),
}


def journal_of(plan: Sweep, folder: Path) -> StudyJournal[Runs]:
    return StudyJournal(folder, plan.settings(), Runs)


@pytest.mark.parametrize(("said", "other"), OTHERS.items(), ids=OTHERS)
def test_a_sweep_with_other_settings_is_refused(said: str, other: Sweep, tmp_path: Path) -> None:
    journal_of(ONE, tmp_path).close()
    message = refusal(lambda: journal_of(other, tmp_path))
    assert message == f"{tmp_path}: {said} to continue there; or choose another --out"


def test_another_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal_of(ONE, tmp_path).close()
    here = metadata.version("skytether")
    monkeypatch.setattr(metadata, "version", lambda _: "2")
    with pytest.raises(ConfigError, match=rf"version: got '2', expected '{here}'"):
        journal_of(ONE, tmp_path)


def test_two_sweeps_do_not_write_to_one_folder(tmp_path: Path) -> None:
    refused = pytest.raises(OSError, match="another command is writing it")
    with closing(journal_of(ONE, tmp_path)), refused:
        journal_of(ONE, tmp_path)
    journal_of(ONE, tmp_path).close()


def test_results_without_settings_are_not_taken_for_ours(tmp_path: Path) -> None:
    (tmp_path / "journal.jsonl").write_text("{}\n")
    said = "got journal.jsonl without settings.toml, expected both"
    with pytest.raises(ConfigError, match=said):
        journal_of(ONE, tmp_path)


@pytest.mark.parametrize("cut", [1, 8, 20])
def test_half_a_line_at_the_end_is_overwritten(cut: int, tmp_path: Path) -> None:
    """A killed writer may leave half a line; everything before it is kept."""
    with closing(journal_of(ONE, tmp_path)) as journal:
        journal.add("one", ())
        journal.add("two", ())
    file = tmp_path / "journal.jsonl"
    whole = file.read_bytes()
    file.write_bytes(whole[:-cut])
    with closing(journal_of(ONE, tmp_path)) as journal:
        assert journal.results == {"one": ()}
        journal.add("two", ())
    assert file.read_bytes() == whole
    with closing(journal_of(ONE, tmp_path)) as journal:
        assert journal.results == {"one": (), "two": ()}


def test_a_line_that_is_no_result_is_named(tmp_path: Path) -> None:
    """A killed writer cannot leave such a line."""
    with closing(journal_of(ONE, tmp_path)) as journal:
        journal.add("one", ())
    with (tmp_path / "journal.jsonl").open("ab") as file:
        file.write(sealed(b'["one", {}]'))
    said = r"journal.jsonl: line 2 has been altered: Expected `array`, got `object`"
    with pytest.raises(ConfigError, match=said):
        journal_of(ONE, tmp_path)


@pytest.mark.parametrize("bit", [0, 5])
def test_a_line_with_a_flipped_bit_is_refused(bit: int, tmp_path: Path) -> None:
    """Anywhere except in the end of the last line, which may be incomplete after a kill."""
    with closing(journal_of(ONE, tmp_path)) as journal:
        journal.add("one", ())
        journal.add("two", ())
    file = tmp_path / "journal.jsonl"
    whole = file.read_bytes()
    for place in range(len(whole) - 1):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << bit]) + whole[place + 1 :])
        with pytest.raises(ConfigError, match=r"line \d has been altered"):
            journal_of(ONE, tmp_path)


def test_a_changed_number_in_a_journal_ends_the_command_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "_executor", lambda _: pool._thread())
    argv = ["sweep", "paper", "--duration", "2", "--settle", "0", "--runs", "1", "--workers", "1"]
    assert main([*argv, "--out", str(tmp_path)]) == 0
    file = tmp_path / "journal.jsonl"
    file.write_text(file.read_text().replace('"steps":40', '"steps":41'))
    capsys.readouterr()
    assert main([*argv, "--out", str(tmp_path)]) == 2
    said = f"sweep: {file}: line 1 has been altered: its checksum is wrong\n"
    assert capsys.readouterr().err == said


def along(path: Path) -> Scenario:
    path.write_text(LINE)
    table = reading.to_table(PAPER) | {"reference": {"shape": "csv", "file": str(path)}}
    return reading.check(table, "mine")


LINE, OTHER_LINE = "t,x,y\n0,0,0\n5,1,1\n", "t,x,y\n0,0,0\n5,1,2\n"


def test_a_trajectory_edited_between_two_sweeps_is_refused(tmp_path: Path) -> None:
    """Otherwise a cell would mix flights along both."""
    paths = [tmp_path / name for name in ("one.csv", "two.csv")]
    scenario, _ = map(along, paths)
    grid = parse_axis(f"reference.file={paths[0]},{paths[1]}")
    plan = Sweep("mine", scenario, [grid], 3)
    journal_of(plan, tmp_path / "out").close()
    journal_of(plan, tmp_path / "out").close()
    paths[1].write_text(OTHER_LINE)
    message = refusal(lambda: journal_of(Sweep("mine", scenario, [grid], 3), tmp_path / "out"))
    assert message.startswith(f"{tmp_path}/out: files.{paths[1]}: got '")


def test_a_task_flies_along_its_file_as_it_was_when_the_sweep_began(tmp_path: Path) -> None:
    """Also on another machine, where there is no such file."""
    path = tmp_path / "path.csv"
    (task,) = Sweep("mine", along(path), [], 1).tasks()
    sent = pickle.dumps(task)
    path.unlink()
    flown = pickle.loads(sent).scenario
    assert flown == task.scenario
    assert flown.make_reference()(np.array([5.0]))[0, :, 0].tolist() == [1.0, 1.0]


@pytest.mark.long
def test_a_sweep_does_not_go_on_along_another_trajectory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "path.csv", tmp_path / "out"
    along(path)
    (tmp_path / "mine.toml").write_text(
        'extends = "paper"\nreference = { shape = "csv", file = "path.csv" }\n'
    )
    argv = ["sweep", str(tmp_path / "mine.toml"), "--duration", "2", "--settle", "0"]
    argv += ["--runs", "2", "--workers", "1", "--out", str(out)]
    assert main(argv) == 0
    path.write_text(OTHER_LINE)
    assert main(argv) == 2
    assert f"sweep: {out}: files.{path}: got '" in capsys.readouterr().err
    path.write_text(LINE)
    assert main(argv) == 0


# -- the command ---------------------------------------------------------------------------------


def command(*argv: str) -> list[str]:
    return [sys.executable, "-P", "-m", "skytether", *argv]


def run(*argv: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*argv), capture_output=True, text=True, timeout=800, check=False)


def lines(out: Path) -> int:
    file = out / "journal.jsonl"
    return file.read_bytes().count(b"\n") if file.exists() else 0


def tables(out: Path) -> list[bytes]:
    return [(out / name).read_bytes() for name in TABLES]


def broken_off(number: signal.Signals, out: Path) -> subprocess.CompletedProcess[str]:
    """Sweep with one worker, ended by a signal a few tasks after its start, with its workers."""
    with subprocess.Popen(
        command(*SWEEP, "--out", str(out), "--workers", "1"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as sweep:
        until(lambda: lines(out) >= 2)
        children = Path(f"/proc/{sweep.pid}/task/{sweep.pid}/children").read_text().split()
        assert children
        sweep.send_signal(number)
        stdout, stderr = sweep.communicate(timeout=PATIENCE_S)
    until(lambda: not any(map(running, children)))
    assert 2 <= lines(out) < TASKS
    return subprocess.CompletedProcess(sweep.args, sweep.returncode, stdout, stderr)


def running(pid: str) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sweep") / "deep" / "whole"
    with redirect_stdout(io.StringIO()):
        assert main([*SWEEP, "--out", str(out), "--workers", "2"]) == 0
    return out


@pytest.fixture(scope="module")
def brief(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same sweep, of shorter flights."""
    out = tmp_path_factory.mktemp("sweep") / "deep" / "brief"
    argv = [*SWEEP, "--duration", "1.5", "--settle", "0.5", "--out", str(out), "--workers", "1"]
    with redirect_stdout(io.StringIO()) as said:
        assert main(argv) == 0
    assert "vehicle-steps" in said.getvalue()
    assert lines(out) == TASKS
    return out


def test_the_tables_hold_every_run_and_every_cell(brief: Path) -> None:
    runs, cells = (list(csv.DictReader((brief / name).read_text().splitlines())) for name in TABLES)
    assert len(runs) == 4 * 30
    assert [int(row["seed"]) for row in runs[30:60]] == list(range(1, 31))
    assert {(row["control.input_weight"], row["control.trigger"]) for row in runs[30:60]} == {
        ("1", "periodic")
    }
    assert {row["steps"] for row in runs} == {"30"}
    assert [row["flown"] for row in cells] == ["30"] * 4
    mean = np.mean([float(row["rmse_xy"]) for row in runs[30:60]])
    assert float(cells[1]["rmse_xy"]) == pytest.approx(mean)
    assert float(cells[1]["rmse_xy_ci95"]) < 0.2 * mean


def test_two_keys_make_maps(brief: Path) -> None:
    for name in ("rmse_xy.png", "event_ratio.png"):
        assert (brief / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.realtime
@pytest.mark.long
def test_a_killed_sweep_goes_on_and_loses_nothing(whole: Path, tmp_path: Path) -> None:
    broken_off(signal.SIGKILL, tmp_path)
    kept = (tmp_path / "journal.jsonl").read_bytes()
    resumed = run(*SWEEP, "--out", str(tmp_path), "--workers", "1")
    assert resumed.returncode == 0, resumed.stderr
    assert (tmp_path / "journal.jsonl").read_bytes().startswith(kept.rpartition(b"\n")[0])
    assert lines(tmp_path) == TASKS
    assert tables(tmp_path) == tables(whole)


@pytest.mark.realtime
@pytest.mark.long
def test_ctrl_c_ends_a_sweep_in_one_line_and_keeps_what_was_done(tmp_path: Path) -> None:
    ended = broken_off(signal.SIGINT, tmp_path)
    assert (ended.returncode, ended.stdout) == (130, "")
    said = re.fullmatch(
        r"sweep: interrupted with (\d+) of 120 runs done; the same command goes on from here\n",
        ended.stderr,
    )
    assert said
    kept = map(json.loads, (tmp_path / "journal.jsonl").read_text().splitlines())
    assert sum(len(runs) for _, (_, runs) in kept) == int(said[1])


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["--runs", "0"], "--runs: got 0, expected 1 to 100000"),
        (["--workers", "0"], "--workers: got 0, expected 1 to 1024"),
        (
            ["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"],
            "--workers: got --scheduler as well, with its own workers",
        ),
        (["--grid", "control.input_weight"], f"--grid: got 'control.input_weight', {FORM}"),
    ],
)
def test_an_impossible_sweep_is_refused(
    argv: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = refused_before_writing(["sweep", "paper", *argv], tmp_path, capsys)
    assert message == f"sweep: {line}"


# -- a cluster -----------------------------------------------------------------------------------

needs_dask = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason="needs the extra `cluster`"
)


def dask(stack: ExitStack, argv: list[str], folder: Path) -> subprocess.Popen[str]:
    process = stack.enter_context(
        subprocess.Popen(
            [sys.executable, "-P", "-m", f"distributed.cli.dask_{argv[0]}", *argv[1:]],
            cwd=folder,
            stderr=subprocess.PIPE,
            text=True,
        )
    )
    stack.callback(process.kill)
    return process


@pytest.mark.realtime
@pytest.mark.long
@needs_dask
def test_a_cluster_gives_the_same_though_a_worker_is_killed(whole: Path, tmp_path: Path) -> None:
    with ExitStack() as stack:
        argv = ["scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        scheduler = dask(stack, argv, tmp_path)
        assert scheduler.stderr is not None
        at = next(line for line in scheduler.stderr if "Scheduler at:" in line).split()[-1]
        workers = [
            dask(stack, ["worker", at, "--nthreads", "1", "--no-nanny", "--no-dashboard"], tmp_path)
            for _ in range(2)
        ]
        for worker in workers:
            assert worker.stderr is not None
            next(line for line in worker.stderr if "Registered to" in line)
        out = tmp_path / "out"
        sweep = stack.enter_context(
            subprocess.Popen(
                command(*SWEEP, "--out", str(out), "--scheduler", at),
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        until(lambda: lines(out) >= 2)
        workers[0].kill()
        _, stderr = sweep.communicate(timeout=PATIENCE_S)
        assert sweep.returncode == 0, stderr
    assert tables(out) == tables(whole)


@needs_dask
@pytest.mark.long
def test_a_scheduler_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["sweep", "paper", "--runs", "1", "--out", str(tmp_path), "--scheduler", "nowhere"]
    assert main(argv) == 1
    said = "sweep: --scheduler: nowhere cannot be reached: missing port number in address 'nowhere'"
    assert capsys.readouterr().err.strip() == said


def test_without_dask_a_scheduler_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    argv = ["sweep", "paper", "--runs", "1", "--out", str(tmp_path), "--scheduler", "tcp://h:1"]
    assert main(argv) == 2
    said = "distributed is not installed, install it: pip install 'skytether[cluster]'"
    assert capsys.readouterr().err.startswith(f"sweep: {said}")
