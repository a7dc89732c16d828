"""Observations by event: the server's prediction of a vehicle, and when the vehicle reports."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import skytether
from skytether.client import reporting
from skytether.client.compensator import Compensator
from skytether.client.reporting import Reporter, distance_m
from skytether.client.reports import Unreported, make_report
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.reading import load
from skytether.shared.scenario.registry import REPORTS
from skytether.shared.telemetry.record import DOWNLINK, Record
from skytether.shared.wire.protocol import Horizon, Mode
from skytether.sim.flight import fly

STILL, ZERO = np.zeros((2, 2)), np.zeros(2)


def now(off_m: float = 0.0, steps: int = 1, *, is_news: bool = False) -> Unreported:
    """State that the vehicle has not reported yet."""
    return Unreported(off_m, is_news, steps, 0.05)


@pytest.mark.parametrize(
    ("text", "sends", "silent"),
    [
        ("always", now(), None),
        ("periodic(4)", now(steps=4), now(1.0, 3, is_news=True)),
        ("deviation(0.05)", now(0.06), now(0.05, 999)),
        ("deviation(0.05)", now(is_news=True), now()),
        ("silence(0.35)", now(steps=7), now(1.0, 6, is_news=True)),
        ("deviation(0.05) | silence(1)", now(steps=20), now(0.04, 19)),
        ("deviation(0.05) & periodic(4)", now(is_news=True, steps=4), now(1.0, 3)),
        ("deviation(0.05) & periodic(4) | silence(0.1)", now(steps=2), now(1.0, 1)),
    ],
)
def test_policies_say_when(text: str, sends: Unreported, silent: Unreported | None) -> None:
    report = make_report(text)
    assert report(sends)
    assert silent is None or not report(silent)


@pytest.mark.parametrize(
    ("text", "said"),
    [("often", "got 'often', expected a report; there are always"), ("deviation", "deviation(m")],
)
def test_what_is_no_report_is_refused(text: str, said: str) -> None:
    with pytest.raises(skytether.ConfigError) as raised:
        skytether.load("demo", **{"vehicle.report": text})
    assert "vehicle.report" in str(raised.value)
    assert said in str(raised.value)
    with pytest.raises(GrammarError):
        REPORTS.parse("cost_gap")


def reporter(text: str = "deviation(0.05)") -> tuple[Reporter, Compensator]:
    terms = load("demo").terms()._replace(scheme="predictive")
    compensator = Compensator(terms)
    return Reporter(terms, text, compensator), compensator


def horizon(step: int) -> Horizon:
    return Horizon(1, 1, step, 0, 0, np.zeros((2, 90), np.float32), np.zeros((2, 5), np.float32))


def test_what_is_news_is_told_at_once() -> None:
    """The first step of a session, another horizon in force or mode, and a step after sleep."""
    reports, compensator = reporter()

    def due(step: int, session: int = 7, mode: Mode = Mode.READY, silence: int = 0) -> bool:
        compensator.choose(step, STILL, ZERO, ZERO)
        return reports.is_due(session, step, mode, STILL, ZERO, silence)

    assert due(0)
    assert not due(1)
    assert due(2, session=8)
    assert not due(3, session=8)
    compensator.offer(horizon(3), 4, 2)
    assert due(4, session=8)
    assert not due(5, session=8)
    assert due(6, session=8, mode=Mode.TRACK)
    assert not due(7, session=8, mode=Mode.TRACK)
    assert due(10, session=8, mode=Mode.TRACK)
    assert [due(step, 8, Mode.TRACK, 5) for step in range(11, 17)] == [False, False, True] * 2


def test_a_vehicle_that_waits_for_a_horizon_reports_again() -> None:
    """At once, after about a round trip, and then at doubled intervals."""
    reports, compensator = reporter("periodic(80)")

    def sent(steps: range, mode: Mode) -> Iterator[int]:
        for step in steps:
            compensator.choose(step, STILL, ZERO, ZERO)
            if reports.is_due(7, step, mode, STILL, [0.0, 0.0], 0):
                yield step

    assert list(sent(range(10), Mode.SYNC)) == [0]
    assert list(sent(range(10, 100), Mode.READY)) == [10, 14, 18, 26, 42, 74]
    assert list(sent(range(100, 150), Mode.TRACK)) == []
    assert list(sent(range(150, 160), Mode.READY)) == [150, 154, 158]


def test_the_belief_is_the_rule_of_flight() -> None:
    """From the reported state, along the horizon in force, with its feedback and disturbance."""
    terms = load("demo").terms()._replace(scheme="predictive")
    compensator = Compensator(terms)
    feedback = np.array([[0.2, 0.1, 0.05, 1.5, 0.5]] * 2, np.float32)
    compensator.offer(horizon(3)._replace(feedback=feedback), 4, 2)
    tau_s, believed = np.array(terms.tau_s), np.zeros((2, 2))
    x = np.array([[0.5, -0.3], [-0.2, 0.4]])
    for step in range(4, 40):
        u = np.array(compensator.choose(step, x, ZERO, ZERO)[0])
        believed = compensator.foresee(x, u) if step == 4 else compensator.foresee(believed)
        x = terms.model.step(x, u + np.float32(0.05))
        assert distance_m(tau_s, believed, x) == pytest.approx(0.0, abs=1e-6)
    aside, faster = [[0.3, 0.0], [0.0, 0.0]], [[0.0, 0.1], [0.0, 0.0]]
    assert distance_m(tau_s, believed, x + aside) == pytest.approx(0.3, abs=1e-6)
    assert distance_m(tau_s, believed, x + faster) == pytest.approx(0.1 * terms.tau_s[0], abs=1e-6)


# -- flights ---------------------------------------------------------------------------------


def seconds(**keys: Any) -> Record:
    """25 s of plans of inputs, without loss and in calm air, with some keys changed."""
    still: dict[str, Any] = {"vehicle.wind": 0.0}
    for direction in ("uplink", "downlink"):
        still |= {f"network.{direction}.loss": 0.0}
    return fly(skytether.load("demo-committed", duration=25, settle=8, **(still | keys)))


def ages(flight: Record) -> np.ndarray:
    """Age of the observation that each plan was made from [steps]."""
    age: np.ndarray = flight.server["step"] - flight.server["observed_step"]
    return age


def downs(flight: Record) -> int:
    return int((flight.netem["direction"] == DOWNLINK).sum())


def without(monkeypatch: pytest.MonkeyPatch, name: str, rule: Callable[..., bool]) -> None:
    """Switch off one of the rules for a report."""
    monkeypatch.setitem(REPORTS, name, REPORTS[name].__class__(rule, REPORTS[name].parameters, ""))


PUSH = {"vehicle.gust_mps2": 3.0, "vehicle.gust_every_s": 3.0, "vehicle.gust_s": 0.5}
QUIET = {"vehicle.report": "deviation(0.05)", "link.timeout_s": 20.0, "link.heartbeat_s": 4.0}
"""Keys for few heartbeats."""


def waited_s(flight: Record) -> float:
    return float(flight.client["step"][flight.client["mode"] == Mode.TRACK][0]) * 0.05


@pytest.mark.long
def test_a_vehicle_that_reports_rarely_starts_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with half of its packets lost; without repetition it waits for its next report."""
    keys = QUIET | {"vehicle.report": "periodic(80)", "network.downlink.loss": 0.5, "duration": 20}
    soon = [waited_s(fly(skytether.load("target", seed=seed, **keys))) for seed in range(5)]
    monkeypatch.setattr(reporting, "RETRY_STEPS", 10**6)
    late = [waited_s(fly(skytether.load("target", seed=seed, **keys))) for seed in range(5)]
    assert max(soon) < 4.0
    assert max(late) > 4.0


def misjudged_m(flight: Record) -> float:
    """RMS error of the server's estimate from 8 s on [m]."""
    client = {row["step"]: row["state"][:, 0] for row in flight.client}
    off = [
        row["estimate"][:, 0] - client[row["step"]]
        for row in flight.server
        if row["step"] > 160 and row["step"] in client
    ]
    return float(np.sqrt((np.array(off) ** 2).sum(axis=1).mean()))


def test_a_gust_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without deviation the server's estimate is wrong for seconds."""
    keys = PUSH | QUIET | {"vehicle.report": "deviation(0.05) | silence(3)"}
    whole = misjudged_m(seconds(**keys))
    without(monkeypatch, "deviation", lambda now, _: now.is_news)
    blind = misjudged_m(seconds(**keys))
    assert whole < 0.8 * blind


def test_every_horizon_is_acknowledged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the server receives few acknowledgements, and learns little of the delay."""
    flight = seconds(**QUIET)
    known = set(flight.client["in_force"].tolist()) - {-1}
    assert downs(flight) >= len(known) > 15
    without(monkeypatch, "deviation", lambda now, metres: now.off_m > metres)
    assert downs(seconds(**QUIET)) < len(known)


def test_silence_bounds_the_age_of_what_is_planned_from(monkeypatch: pytest.MonkeyPatch) -> None:
    """At most a second and a delay; without `silence`, as long as heartbeats allow."""
    keys = QUIET | {"vehicle.report": "deviation(0.3) & periodic(200) | silence(1)"}
    worst = ages(seconds(**keys))[40:].max()
    assert worst <= 20 + 14
    without(monkeypatch, "silence", lambda *_: False)
    assert ages(seconds(**keys))[40:].max() > worst + 20


def test_a_longer_delay_is_found_with_few_reports() -> None:
    """Uplink packets take 0.3 s more from 15 s on, and d follows."""
    keys = {"vehicle.report": "deviation(0.05)"}
    scenario = skytether.load("demo-committed", duration=25, settle=8, **keys)
    rows = fly(scenario, changes=[(15.0, {"network.uplink.paper": 0.7})]).server
    before = rows["ahead"][rows["step"] < 13 * 20].max()
    longer = rows["step"][rows["ahead"] >= before + 3]
    assert len(longer)
    assert 13.5 < longer[0] * 0.05 < 15.0 + 4.5


@pytest.mark.long
def test_nobody_calls_a_quiet_vehicle_lost() -> None:
    for seed in (1, 2, 3):
        flight = fly(skytether.load("demo", seed=seed))
        names = [type(each.event).__name__ for each in flight.events]
        assert not {"PlanningStopped", "StateDoubted", "SessionEnded"} & set(names[:-1])
        assert names.count("SessionOpened") == 1
        assert downs(flight) < 5.0 * 38


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "error_m", "share"), [("demo", 0.018, 0.19), ("demo-committed", 0.0233, 0.21)]
)
def test_the_demo_takes_a_fifth_of_the_paper_s_packets(
    name: str, error_m: float, share: float
) -> None:
    """The paper sends 39 packets a second; the error is that of a report at every step."""
    flights = skytether.fly_batch(name, range(1, 25))
    packets = [flight.summary.packets_per_s or 0.0 for flight in flights]
    errors = [flight.summary.rmse_xy or 1.0 for flight in flights]
    assert np.mean(packets) <= share * 39
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(error_m, rel=0.05)


def test_summary_counts_both_ways() -> None:
    flown = skytether.fly("demo", duration=10, settle=4)
    s, rows = flown.summary, flown.record.netem
    assert s.packets_per_s == pytest.approx(len(rows) / s.duration_s)
    assert s.bytes_per_s == pytest.approx((rows["bytes"].sum() + 28 * len(rows)) / s.duration_s)
    assert s.packets_per_s == pytest.approx(s.uplink_packets_per_s + s.downlink_packets_per_s)
    assert s.bytes_per_s == pytest.approx(s.uplink_bytes_per_s + s.downlink_bytes_per_s)
