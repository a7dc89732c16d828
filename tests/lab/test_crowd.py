"""Vehicles on one shared network: the numbers that are flown, and the criteria for flying."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench import crowd
from bench.crowd import EXACT, Cell, CrowdPoint, FlownScheme, Scheme, judge, scenario_of
from helpers import without_painting
from skytether.shared.scenario import reading
from skytether.shared.wire.protocol import Mode
from skytether.sim.flight import fly


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
    schemes: tuple[Scheme, ...] = ("paper", "threshold", "budget")
    paper, threshold, budget = map(scenario_of, schemes)
    assert paper.network == threshold.network == budget.network
    assert paper.reference == threshold.reference == budget.reference
    assert (paper.control.scheme, paper.control.trigger) == ("predictive", "always")
    assert threshold == reading.load("crowd")
    assert budget.control == msgspec.structs.replace(threshold.control, shared_bytes_per_s=10_000.0)


def test_it_draws_a_picture_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ("--out", str(tmp_path), "--schemes", "budget", "--vehicles")
    with without_painting():
        crowd.main([*argv, "1"])
        assert "one budget for all vehicles: 1 fly, no more were tried" in capsys.readouterr().out
        journal = (tmp_path / "journal.jsonl").read_text()
        crowd.main([*argv, "1", "2"])
    assert "one budget for all vehicles: 2 fly, no more were tried" in capsys.readouterr().out
    assert (tmp_path / "journal.jsonl").read_text().startswith(journal)
    assert (tmp_path / "crowd.png").exists()


@pytest.mark.realtime
@pytest.mark.long
def test_it_flies_over_udp(monkeypatch: pytest.MonkeyPatch) -> None:
    short = msgspec.structs.replace(scenario_of("budget"), duration=6.0, settle=3.0)
    monkeypatch.setattr(crowd, "scenario_of", lambda _: short)
    flown = crowd.fly(True, Cell("budget", 2))
    assert flown.rmse_m is not None
    assert np.isfinite(flown.rmse_m)
    assert flown.up_bytes_per_s > 0.0
