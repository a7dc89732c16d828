"""Torture: trials, the faults found when a guard is switched off, and reproducibility."""

import os
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

import skytether.client.compensator
import skytether.client.endpoint
import skytether.client.failsafe
import skytether.client.pilot
import skytether.client.secure
import skytether.netem.places
import skytether.shared.wire.channel
from fuzz.engine import dumps
from fuzz.torture import __main__ as commands
from fuzz.torture import trials
from fuzz.torture.faults import RANGES, FaultKind, ScheduledFault, Trial, loads
from fuzz.torture.invariants import Violation, check_bounds
from fuzz.torture.trials import (
    CLOCK_NS,
    TrialOutcome,
    fly,
    long_trial,
    make_scenario,
    short_trial,
    shrunk,
)
from helpers import interpreted
from skytether.client.failsafe import LOCKING, TRANSITIONS
from skytether.lab.commands import pool
from skytether.netem.proxy import Proxy
from skytether.server.reception import Reception
from skytether.server.sessions import Session
from skytether.server.tick import Ticker
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.law import rule, spline
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.protocol import Mode
from skytether.shell.commandline.command import CommandError

SEEDS = Path(__file__).parents[1] / "torture_seeds.txt"
FAILED = [line for line in SEEDS.read_text().splitlines() if not line.startswith("#")]
LONG = pytest.mark.skipif("SKYTETHER_LONG" not in os.environ, reason="long: set SKYTETHER_LONG=1")

PLANS, FOLLOWS = 7, 11
"""Seeds of a trial with horizons, and of one with trajectories."""

Patch = Callable[[pytest.MonkeyPatch], None]


def fault(
    kind: FaultKind, where: str, start_s: float, length_s: float, amount: float = 1.0
) -> ScheduledFault:
    return ScheduledFault(
        kind, where, round(start_s * SECOND_NS), round(length_s * SECOND_NS), amount
    )


# -- trials ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "seed",
    [2, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, *range(3, 9)))],
)
def test_a_trial_goes_well_and_the_same_each_time(seed: int) -> None:
    outcome = fly(short_trial(seed))
    assert not outcome.failure
    assert outcome == fly(short_trial(seed))


def test_trials_differ_in_scheme_step_axes_and_vehicles() -> None:
    drawn = [make_scenario(seed) for seed in range(100)]
    control = {(scenario.control.scheme, scenario.control.feedback) for scenario, _ in drawn}
    assert control == {
        ("committed", False),
        ("committed", True),
        ("predictive", False),
        ("trajectory", True),
    }
    assert {scenario.control.dt for scenario, _ in drawn} == {0.05, 0.1}
    assert {scenario.model.axes for scenario, _ in drawn} == {2, 3}
    assert {vehicles for _, vehicles in drawn} == {1, 2}
    assert {any(scenario.terms().dead_time_s) for scenario, _ in drawn} == {False, True}


def test_trajectories_are_flown_by_a_third_or_more_with_all_that_belongs_to_them() -> None:
    drawn = [make_scenario(seed)[0] for seed in range(200)]
    some = [each for each in drawn if each.control.scheme == "trajectory"]
    assert len(some) > len(drawn) / 3
    assert {each.reference.preview for each in some} == {"all", "none", 1.0, 3.0}
    assert {each.link.heartbeat_s for each in some} == {0.1, "auto"}
    assert {each.vehicle.gain == () for each in some} == {False, True}
    for word in ("expected_gap", "cost_gap", "deviation", "heartbeat", "silence", "budget"):
        assert {word in each.control.trigger for each in some} == {False, True}
    for word in ("always", "deviation", "periodic"):
        assert {word in each.vehicle.report for each in some} == {False, True}


def test_each_step_under_a_plan_is_held_against_the_equations() -> None:
    along, planned = fly(Trial(FOLLOWS, ())).counts, fly(Trial(PLANS, ())).counts
    assert along["steps along trajectories"] > 30
    assert planned["steps by inputs"] > 30
    assert "steps by inputs" not in along
    assert "steps along trajectories" not in planned


def schedule_of(line: str) -> str:
    return line.partition('"faults"')[2]


NEWEST = {schedule_of(line): line for line in FAILED}
"""Last seed with each schedule, which flies what failed with it."""
FAULTS_MAX = 6
"""Largest number of faults of the trials that are flown each time."""


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, marks=[] if is_brief else [pytest.mark.long])
        for line in FAILED
        for is_brief in [
            line == NEWEST[schedule_of(line)] and len(loads(line).faults) <= FAULTS_MAX
        ]
    ],
)
def test_what_has_failed_once_fails_no_more(line: str) -> None:
    outcome = fly(loads(line))
    assert not outcome.failure


EFFECTS = [
    (fault(FaultKind.LOSS, "both", 5, 4, 0.9), "packets: loss"),
    (fault(FaultKind.BURST, "uplink", 5, 4, 10.0), "packets: burst"),
    (fault(FaultKind.DUPLICATES, "both", 5, 4, 0.9), "packets: duplicates"),
    (fault(FaultKind.REORDERING, "both", 5, 4, 2.0), "packets: reordering"),
    (fault(FaultKind.PARTITION, "both", 5, 4), f"brake: {Reason.LOST}"),
    (fault(FaultKind.PARTITION, "both", 5, 14), f"land: {Reason.ALONE}"),
    (fault(FaultKind.RESTART, "server", 5, 0.05), f"brake: {Reason.LOST}"),
    (fault(FaultKind.RESTART, "client", 5, 1.0), "lives of client"),
    (fault(FaultKind.RESTART, "netem", 5, 1.5), f"brake: {Reason.LOST}"),
    (fault(FaultKind.FREEZE, "client", 5, 1.0), f"brake: {Reason.STALLED}"),
    (fault(FaultKind.FREEZE, "server", 5, 2.0), f"brake: {Reason.LOST}"),
    (fault(FaultKind.SOLVER, "server", 5, 4), "brake: the solver has found no plan"),
    (fault(FaultKind.OVERLOAD, "server", 5, 6, 20.0), f"brake: {Reason.LOST}"),
    (fault(FaultKind.REPLAY, "both", 5, 4, 1.0), "packets: replay"),
    (fault(FaultKind.DELAY, "uplink", 5, 6, 3.0), f"brake: {Reason.LOST}"),
    (fault(FaultKind.CORRUPTION, "both", 5, 4, 0.9), f"brake: {Reason.LOST}"),
    (fault(FaultKind.FLOOD, "server", 5, 2, 500.0), "packets: flood"),
    (fault(FaultKind.FLOOD, "client", 5, 2, 500.0), "packets: flood"),
    (fault(FaultKind.COPY, "both", 5, 6), "packets: copy"),
    (fault(FaultKind.KEYS, "server", 5, 3), f"brake: {Reason.LOST}"),
    (fault(FaultKind.CROWD, "netem", 5, 6, 200.0), "packets: crowd"),
    (fault(FaultKind.PORT, "client", 5, 0), "faults: port"),
]


@cache
def undisturbed() -> TrialOutcome:
    return fly(Trial(1, ()))


@pytest.mark.parametrize(("one", "effect"), EFFECTS)
def test_each_fault_has_its_effect_and_is_survived(one: ScheduledFault, effect: str) -> None:
    assert not undisturbed().counts.get(effect)
    outcome = fly(Trial(1, (one,)))
    assert not outcome.failure
    assert outcome.counts[effect] > 0


SIEGE = Trial(
    1, (fault(FaultKind.CROWD, "netem", 3, 12, 200.0), fault(FaultKind.PORT, "client", 8, 0))
)
"""An observer occupies netem's capacity, and the vehicles' ports change."""


def test_an_observer_at_netem_keeps_no_vehicle_from_flying() -> None:
    """It copies packets of vehicles and sends from more ports than netem's capacity."""
    outcome = fly(SIEGE)
    assert not outcome.failure
    assert outcome.counts["packets: crowd"] > 2000


def test_if_one_answer_earned_a_place_an_observer_would_shut_vehicles_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ablation: a single answer earns a flow for a minute."""
    monkeypatch.setattr(skytether.netem.places, "EXCHANGES", 1)
    monkeypatch.setattr(skytether.netem.places, "EARNED_NS", 60 * SECOND_NS)
    monkeypatch.setattr(skytether.netem.places, "HOST_FLOWS", 128)
    assert fly(SIEGE).invariant == "recovers"


@pytest.mark.parametrize("amount", [3600.0, -3600.0])
def test_a_clock_that_is_set_costs_nothing(amount: float) -> None:
    """No vehicle brakes, whichever clock is set."""
    braked = f"brake: {Reason.STALLED}"
    for where in ("client", "server"):
        outcome = fly(Trial(1, (fault(FaultKind.STEP, where, 5, 0, amount),)))
        assert not outcome.failure
        assert braked not in outcome.counts


def test_every_kind_of_fault_is_tried() -> None:
    assert {one.kind for one, _ in EFFECTS} | {FaultKind.STEP, FaultKind.SKEW} == set(RANGES)


# -- ablations of guards ---------------------------------------------------------------------


class Unchecked:
    def __init__(self, key: bytes) -> None:
        self._key = key
        self.encrypt = ChaCha20Poly1305(key).encrypt

    def decrypt(self, nonce: bytes, data: bytes, _: bytes) -> bytes:
        algorithm = algorithms.ChaCha20(self._key, (1).to_bytes(4, "little") + nonce)
        return Cipher(algorithm, mode=None).decryptor().update(data[:-16])


def no_clamp(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(skytether.client.pilot, "clamped", lambda wanted, *_, **__: list(wanted))


def no_feedback_at_the_end(patch: pytest.MonkeyPatch) -> None:
    """Feedback aboard that stops after the last input."""
    step = rule.step

    def end(
        held: rule.AxisHorizon, stage: int, *states: float
    ) -> tuple[float, float, float, float]:
        """Feedback up to the last input."""
        if stage >= held.length:
            held = held._replace(gain_p=0.0, gain_v=0.0)
        return step(held, stage, *states)

    patch.setattr(rule, "step", end)


def no_window(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(skytether.shared.wire.channel.ReplayWindow, "is_new", lambda *_: True)


def no_tag(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(skytether.shared.wire.channel, "ChaCha20Poly1305", Unchecked)


def no_age(patch: pytest.MonkeyPatch) -> None:
    """No bound on the age of the observation behind an input, aboard."""
    patch.setattr(skytether.client.compensator, "lasting", lambda length, *_: length)


def no_brake_without_link(patch: pytest.MonkeyPatch) -> None:
    table = {
        (mode, cause): after for (mode, cause), after in TRANSITIONS.items() if cause != Reason.LOST
    }
    patch.setattr(skytether.client.endpoint, "TRANSITIONS", table)


def no_lock_at_restart(patch: pytest.MonkeyPatch) -> None:
    """No dropping of horizons, and no waiting, when the server has restarted."""
    dropping = skytether.client.pilot.DROPPING - {Reason.RESTARTED}
    patch.setattr(skytether.client.pilot, "DROPPING", dropping)
    patch.setattr(skytether.client.failsafe, "LOCKING", LOCKING - {Reason.RESTARTED})


def no_stall(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(skytether.client.failsafe, "STALL_NS", 2**62)


def no_lock(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(skytether.client.failsafe, "LOCKING", frozenset())


def no_good_link(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(skytether.client.failsafe, "GOOD_NS", 0)


def no_steady(patch: pytest.MonkeyPatch) -> None:
    def as_it_is(endpoint: Endpoint) -> Endpoint:
        return endpoint

    patch.setattr(trials, "Steady", as_it_is)


def no_latch(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(
        skytether.client.endpoint,
        "TRANSITIONS",
        {**TRANSITIONS, (Mode.LAND, Reason.HORIZON): Mode.TRACK},
    )


def no_home(patch: pytest.MonkeyPatch) -> None:
    """Packets go only to the address of the newest observation."""

    def sealed(self: Session, payload: bytes, *_: float) -> tuple[Datagram]:
        return (Datagram(self.line.seal(payload), self.address),)

    patch.setattr(Session, "sealed", sealed)


def no_second_try(patch: pytest.MonkeyPatch) -> None:
    """Only the first challenge is answered, and its cookie is kept."""
    patch.setattr(skytether.client.secure, "AGAIN_NS", skytether.client.secure.ATTEMPT_NS)


@cache
def goes_well(trial: Trial) -> bool:
    """Whether a trial passes with all guards; several ablations are of the same trial."""
    return not fly(trial).failure


def violated(trial: Trial, ablate: Patch, patch: pytest.MonkeyPatch) -> str:
    """Invariant that a trial violates after an ablation; without the ablation the trial passes.

    Runs in plain Python: compiled code does not call replaced functions.
    """
    assert goes_well(trial)
    ablate(patch)
    with interpreted():
        return fly(trial).invariant


ABLATIONS: list[tuple[Patch, str, tuple[ScheduledFault, ...]]] = [
    (no_clamp, "slew", ()),
    (no_window, "once", (fault(FaultKind.REPLAY, "downlink", 5, 2, 0.5),)),
    (no_window, "once", (fault(FaultKind.DUPLICATES, "uplink", 5, 2, 0.9),)),
    (no_tag, "authentic", (fault(FaultKind.CORRUPTION, "both", 5, 2, 0.9),)),
    (no_tag, "authentic", (fault(FaultKind.FLOOD, "server", 5, 2, 500.0),)),
    (no_age, "expired", (fault(FaultKind.LOSS, "downlink", 5, 5),)),
    (no_brake_without_link, "brakes", (fault(FaultKind.PARTITION, "both", 5, 3),)),
    (no_lock_at_restart, "good link", (fault(FaultKind.RESTART, "server", 5, 0.05),)),
    (no_stall, "asleep", (fault(FaultKind.FREEZE, "client", 5, 0.6),)),
    (no_lock, "good link", (fault(FaultKind.PARTITION, "both", 5, 3),)),
    (no_good_link, "good link", ()),
    (no_steady, "recovers", (fault(FaultKind.STEP, "client", 5, 0, -3600.0),)),
    (no_steady, "recovers", (fault(FaultKind.STEP, "server", 5, 0, -3600.0),)),
    (no_latch, "table", (fault(FaultKind.PARTITION, "both", 5, 14),)),
    (
        no_home,
        "recovers",
        (fault(FaultKind.COPY, "both", 3, 20), fault(FaultKind.COPY, "both", 5, 15)),
    ),
    (
        no_second_try,
        "recovers",
        (
            fault(FaultKind.COPY, "both", 4, 20),
            fault(FaultKind.RESTART, "server", 6, 0.5),
            fault(FaultKind.LOSS, "both", 6, 3, 0.7),
        ),
    ),
]


def test_feedback_that_ends_too_early_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight with feedback and lost observations brakes, and holds its place in wind."""
    seed = next(
        seed
        for seed in range(100)
        if make_scenario(seed)[0].control.scheme == "committed"
        and make_scenario(seed)[0].control.feedback
    )
    trial = Trial(seed, (fault(FaultKind.LOSS, "downlink", 5, 8),))
    assert violated(trial, no_feedback_at_the_end, monkeypatch) == "follows"


@pytest.mark.parametrize(("switch_off", "invariant", "faults"), ABLATIONS)
def test_a_guard_that_is_switched_off_is_caught(
    switch_off: Patch,
    invariant: str,
    faults: tuple[ScheduledFault, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its invariant is violated; with the guard the same flight passes."""
    assert violated(Trial(PLANS, faults), switch_off, monkeypatch) == invariant


OF_LINKS = (no_window, no_tag, no_steady)
"""Guards that act on packets and clocks, whether these bring horizons or trajectories."""


@pytest.mark.parametrize(
    ("switch_off", "invariant", "faults"),
    [
        pytest.param(*each, marks=[pytest.mark.long] if each[0] in OF_LINKS else [])
        for each in ABLATIONS
        if each[0] not in (no_home, no_second_try)
    ],
)
def test_a_guard_of_trajectories_that_is_switched_off_is_caught(
    switch_off: Patch,
    invariant: str,
    faults: tuple[ScheduledFault, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As for horizons.

    Two guards are left out, because they belong to the link alone. A server that accepts forgeries
    may also violate "recovers".
    """
    found = violated(Trial(FOLLOWS, faults), switch_off, monkeypatch)
    assert found in (invariant, "recovers")


def test_a_vehicle_with_a_new_port_is_reached_behind_faster_copies(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not at the copier's address alone, nor at the one of the newest HELLO, which is dead."""
    trial = loads(next(line for line in FAILED if '"seed":2711171' in line))

    def no_other(patch: pytest.MonkeyPatch) -> None:
        patch.setattr(Reception, "_note_repeat", lambda *_: None)

    assert violated(trial, no_other, monkeypatch) == "recovers"


def no_disturbance(patch: pytest.MonkeyPatch) -> None:
    follow = spline.follow
    patch.setattr(spline, "follow", lambda *given: follow(*given[:-1], 0.0))


def no_end(patch: pytest.MonkeyPatch) -> None:
    """Braking begins a step too late."""
    guided = spline.guided
    late = lambda guide, stage: guided(guide._replace(length=guide.length + 1), stage)  # noqa: E731
    patch.setattr(spline, "guided", late)


@pytest.mark.parametrize(
    ("wrong", "invariant", "faults"),
    [
        (no_disturbance, "follows", ()),
        (no_end, "follows", (fault(FaultKind.LOSS, "downlink", 5, 8),)),
    ],
)
def test_a_rule_of_trajectories_that_is_broken_is_caught(
    wrong: Patch,
    invariant: str,
    faults: tuple[ScheduledFault, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert violated(Trial(FOLLOWS, faults), wrong, monkeypatch) == invariant


def test_a_solver_that_fails_is_nothing_to_trajectories() -> None:
    counts = fly(Trial(FOLLOWS, (fault(FaultKind.SOLVER, "server", 5, 4),))).counts
    assert counts["steps along trajectories"] > 100
    assert not any(name.startswith("brake") for name in counts)


@LONG
@pytest.mark.parametrize("switch_off", dict.fromkeys(patch for patch, _, _ in ABLATIONS))
def test_schedules_that_are_drawn_catch_each_guard(
    switch_off: Patch, monkeypatch: pytest.MonkeyPatch
) -> None:
    switch_off(monkeypatch)
    assert any(fly(short_trial(seed)).failure for seed in range(1, 401))


@LONG
def test_two_hours_go_well() -> None:
    outcome = fly(long_trial(1, 2.0))
    assert not outcome.failure


def test_a_failure_shrinks_to_the_fault_that_matters(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five faults shrink to the relevant one, which fails again from its JSON."""
    no_stall(monkeypatch)
    culprit = fault(FaultKind.FREEZE, "client", 6, 1.0)
    others = (
        fault(FaultKind.DUPLICATES, "both", 3, 2, 0.5),
        fault(FaultKind.SKEW, "server", 3, 9, 200.0),
        fault(FaultKind.REPLAY, "both", 4, 4, 1.0),
        culprit,
        fault(FaultKind.FLOOD, "client", 9, 1, 100.0),
    )
    failed = fly(Trial(1, others))
    assert failed.invariant == "asleep"
    short = shrunk(failed)
    assert short.failure
    (left,) = short.trial.faults
    assert (left.kind, left.start_ns) == (FaultKind.FREEZE, culprit.start_ns)
    assert left.length_ns < culprit.length_ns
    assert fly(loads(dumps(short.trial))) == short


def test_an_endpoint_that_raises_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    def raise_(*_: Any, **__: Any) -> None:
        raise ValueError("no such thing")

    monkeypatch.setattr(Ticker, "tick", raise_)
    outcome = fly(Trial(1, ()))
    assert outcome.invariant == "raises"
    assert "ValueError no such thing" in outcome.failure


def test_a_container_without_a_bound_is_found() -> None:
    scenario, _ = make_scenario(1)
    netem = Proxy(scenario, server=("server", 0), flows=10**6)
    for port in range(2100):
        netem.receive(Datagram(b"%d" % port, ("host", port)), now_ns=CLOCK_NS)
    with pytest.raises(Violation, match=r"bounded memory: netem[.\w]+ holds 2100"):
        check_bounds("netem", netem)


# -- the command -----------------------------------------------------------------------------


@pytest.mark.parametrize("in_processes", [False, pytest.param(True, marks=[pytest.mark.long])])
@pytest.mark.usefixtures("here")
def test_the_command_counts_what_its_flights_met(
    in_processes: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if not in_processes:
        monkeypatch.setattr(pool, "_executor", lambda _: pool._thread())
    commands.main(["--seed", "1", "--runs", "2", "--workers", "2"])
    printed = capsys.readouterr().out
    assert "torture from seed 1" in printed
    counted = re.findall(r"│ (flights|steps) +│ +(\d+)", printed)
    steps = sum(fly(short_trial(seed)).counts["steps"] for seed in (1, 2))
    assert counted == [("flights", "2"), ("steps", str(steps))]


@pytest.mark.parametrize(
    ("argv", "error", "said"),
    [
        (["--schedule", "{"], ConfigError, "expected a schedule, as printed for a failure"),
        (["--schedule", "{}", "--seed", "1"], CommandError, "expected neither --seed nor --hours"),
        (["--hours", "-1"], CommandError, "--hours: got -1, expected more than 0, at most 10000"),
        (["--seed", "-1"], CommandError, "--seed: got -1, expected 0 to 4294967295"),
        (["--schedule", "/nowhere"], CommandError, "--schedule: /nowhere: "),
    ],
)
def test_what_cannot_be_flown_is_refused(
    argv: list[str], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        commands.main(argv)


@pytest.mark.usefixtures("here")
def test_a_failure_is_printed_with_its_schedule_and_flies_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    no_stall(monkeypatch)
    file = tmp_path / "seeds.txt"
    frozen = Trial(1, (fault(FaultKind.FREEZE, "client", 5, 0.6),))
    file.write_text(f"# two\n{dumps(Trial(1, ()))}\n{dumps(frozen)}\n")
    for argv in (["--schedule", str(file)], ["--schedule", dumps(frozen)]):
        with pytest.raises(CommandError, match=r"1 of (1 flight|2 flights) failed") as refused:
            commands.main(argv)
        assert refused.value.code == 1
        printed = capsys.readouterr().out
        assert "asleep: " in printed
        assert 'python -m fuzz.torture --schedule \'{"seed":1,' in printed
