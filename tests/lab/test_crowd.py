"""`skytether crowd`: the numbers of vehicles that are flown, and the criteria for flying."""

import csv
import signal
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import warm
from helpers import without_painting
from skytether.__main__ import main
from skytether.lab.commands import crowd as command
from skytether.lab.crowd import EXACT, Crowd, CrowdPoint, FlownScheme, Scheme, judge, points_csv
from skytether.shared.scenario import reading
from skytether.shared.wire.protocol import Mode
from skytether.sim.flight import fly

FAST = ("--duration", "4", "--settle", "2")


def point(vehicles: int, rmse_m: float | None = 0.3, **keys: Any) -> CrowdPoint:
    values: dict[str, Any] = dict.fromkeys(CrowdPoint.__struct_fields__, 0)
    given = {"scheme": "budget", "vehicles": vehicles, "rmse_m": rmse_m, "rmse_worst_m": rmse_m}
    return CrowdPoint(**{**values, **given, **keys})


@given(st.integers(0, 400), st.integers(1, 300))
def test_the_largest_number_that_flies_is_found(flies: int, most: int) -> None:
    """To within a twentieth, or one vehicle, without flying a number twice."""
    points: list[CrowdPoint] = []
    while (number := FlownScheme.of(points, "budget", 1.0).next(most)) is not None:
        assert 1 <= number <= most
        assert number not in {each.vehicles for each in points}
        points.append(point(number, 0.3 if number <= flies else 2.0))
    found = FlownScheme.of(points, "budget", 1.0)
    assert found.flying <= flies
    if flies >= most:
        assert found.flying == most
        assert found.too_many is None
    else:
        assert found.too_many is not None
        assert flies < found.too_many <= found.flying + max(1.0, EXACT * found.too_many)
    assert len(points) < 30


def test_points_of_other_schemes_do_not_count() -> None:
    points = [point(1), point(2, 9.0), point(5, scheme="threshold")]
    assert FlownScheme.of(points, "budget", 1.0).flying == 1
    assert FlownScheme.of(points, "threshold", 1.0).flying == 5
    assert FlownScheme.of(points, "paper", 1.0).next(8) == 1


@pytest.mark.parametrize(
    "keys", [{"rmse_m": 1.01}, {"rmse_m": None}, {"braked": 1}, {"ended": 1, "rmse_m": None}]
)
def test_what_is_no_flying(keys: dict[str, Any]) -> None:
    """An error over the limit, or one vehicle that brakes or ends early."""
    assert point(3).flies(1.0)
    assert not msgspec.structs.replace(point(3), **keys).flies(1.0)


def test_a_flight_is_judged_by_its_record() -> None:
    scenario = reading.load("crowd")
    scenario = msgspec.structs.replace(scenario, duration=6.0, settle=3.0)
    record = fly(scenario, vehicles=3)
    whole = judge(scenario, "budget", 3, record.client, record.figures["netem"])
    assert whole.flies(5.0)
    assert whole.rmse_m is not None
    assert whole.rmse_worst_m is not None
    assert 0.0 < whole.rmse_m <= whole.rmse_worst_m < 5.0
    assert whole.up_queueing_ms_p50 >= 1.0  # 67 B at 12 500 B/s are 5 ms
    assert whole.up_bytes_per_s > 100.0
    client = record.client.copy()
    late = (client["vehicle"] == 2) & (client["step"] == 80)
    client["mode"][late] = Mode.BRAKE
    assert judge(scenario, "budget", 3, client, record.figures["netem"]).braked == 1
    client["mode"][late] = Mode.MANUAL
    assert judge(scenario, "budget", 3, client, record.figures["netem"]).braked == 0
    cut = client[(client["vehicle"] != 3) | (client["step"] < 40)]
    short = judge(scenario, "budget", 3, cut, record.figures["netem"])
    assert short.ended == 1
    assert short.rmse_m is None
    nothing = judge(scenario, "budget", 3, client[:0], record.figures["netem"])
    assert nothing.ended == 3


def test_schemes_share_the_network_and_the_target() -> None:
    """They differ in the server's packets; the paper's vehicles report at every step."""
    plan = Crowd("crowd", reading.load("crowd"), udp=False)
    schemes: tuple[Scheme, ...] = ("paper", "threshold", "budget")
    paper, threshold, budget = map(plan.of, schemes)
    assert paper.network == threshold.network == budget.network == plan.scenario.network
    assert paper.reference == threshold.reference == budget.reference
    assert (paper.control.scheme, paper.control.trigger) == ("predictive", "always")
    assert threshold.control == plan.scenario.control
    assert budget.control == msgspec.structs.replace(threshold.control, shared_bytes_per_s=10_000.0)
    given = reading.check(reading.to_table(plan.scenario) | {}, "test")
    given = msgspec.structs.replace(
        given, control=msgspec.structs.replace(given.control, shared_bytes_per_s=900.0)
    )
    plan = Crowd("crowd", given, udp=False)
    assert plan.of("budget").control.shared_bytes_per_s == 900.0
    assert plan.of("threshold").control.shared_bytes_per_s == 0.0


@pytest.mark.usefixtures("here")
def test_it_writes_a_table_and_a_picture_and_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ("crowd", "--out", str(tmp_path / "c"), "--schemes", "threshold", "budget", *FAST)
    with without_painting():
        assert main([*argv, "--limit", "5", "--vehicles", "1", "2"]) == 0
    said = capsys.readouterr().out
    assert "one budget for all vehicles: 2 vehicles fly, no more were tried" in said
    journal = (tmp_path / "c" / "journal.jsonl").read_text()
    assert main([*argv, "--limit", "5", "--vehicles", "2", "3"]) == 0
    assert (tmp_path / "c" / "journal.jsonl").read_text().startswith(journal)
    rows = list(csv.DictReader((tmp_path / "c" / "crowd.csv").read_text().splitlines()))
    numbers = [(row["scheme"], row["vehicles"]) for row in rows]
    assert numbers == [(scheme, n) for scheme in ("threshold", "budget") for n in "123"]
    assert (tmp_path / "c" / "crowd.png").stat().st_size > 10_000


@pytest.mark.usefixtures("here", "unpainted")
def test_ctrl_c_keeps_what_was_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = command.flight.fly

    def interrupt(*args: Any, **keys: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return whole(*args, **keys)

    monkeypatch.setattr(command.flight, "fly", interrupt)
    argv = ["--schemes", "budget", "--most", "2", "--limit", "5", *FAST]
    argv = ["crowd", "--out", str(tmp_path), *argv]
    assert main(argv) == 130
    told = capsys.readouterr()
    assert "interrupted with 0 of 1 schemes done" in told.err
    assert "1 vehicle flies" in told.out
    monkeypatch.setattr(command.flight, "fly", whole)
    assert main(argv) == 0
    assert "2 vehicles fly" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--vehicles", "0"), "--vehicles: got 0, expected 1 to 4096"),
        (("--most", "5000"), "--most: got 5000, expected 1 to 4096"),
        (("--limit", "0"), "--limit: got 0, expected more than 0"),
        (("--control.shared-bytes-per-s", "-3"), "control.shared_bytes_per_s: got -3"),
    ],
)
def test_bad_options_are_one_line(
    flags: tuple[str, ...], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["crowd", "--out", str(tmp_path / "c"), *flags]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "c").exists()


def test_a_table_of_points_has_a_column_for_each_figure() -> None:
    lines = points_csv([point(3)]).splitlines()
    assert lines[0].split(",") == list(CrowdPoint.__struct_fields__)
    assert lines[1].startswith("budget,3,0.3,")


@pytest.mark.realtime
@pytest.mark.long
def test_it_flies_over_udp(tmp_path: Path) -> None:
    out = tmp_path / "c"
    command = f"crowd --udp --out {out} --schemes budget --vehicles 2 --limit 5 --duration 6"
    run = warm.skytether(*command.split(), "--settle", "3")
    assert run.returncode == 0, run.stderr
    (row,) = csv.DictReader((out / "crowd.csv").read_text().splitlines())
    assert np.isfinite(float(row["rmse_m"]))
    assert np.isfinite(float(row["up_bytes_per_s"]))
