"""Identification: parameters are found, steps stay inside the fence, the result can be flown."""

import csv
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from airborne import SAFE, Air, documented
from helpers import packaged
from skytether.autopilot.endpoint import Autopilot
from skytether.autopilot.flavours import FlavourName
from skytether.client import vehicles
from skytether.client.vehicle import Measurement, Vehicle
from skytether.lab.commands import identify as command_of
from skytether.lab.commands.identify import identify
from skytether.lab.identify import outcome
from skytether.lab.identify.fit import Fit, Numbers, StepResponse, fit, misfit, predicted, verdict
from skytether.lab.identify.flight import Identifying
from skytether.lab.identify.responses import responses
from skytether.lab.identify.steps import (
    Experiment,
    ExperimentPlan,
    FlownStep,
    default_hold_s,
    default_speeds,
    fenced,
)
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Reason
from skytether.shell.commandline import command
from skytether.sim import flight
from skytether.sim.hosts import Clock
from skytether.sim.world import World

CALM = {"wind": 0.0, "gust_mps2": 0.0}


def scenario(name: str = "demo", **sections: Any) -> Scenario:
    """The scenario demo without wind, with some keys changed."""
    return packaged(name, {"vehicle": CALM} | sections)


# -- the fit ---------------------------------------------------------------------------------


def answered(
    truth: Numbers, rng: np.random.Generator, *, noise: float = 0.0, count: int = 8
) -> list[StepResponse]:
    """Steps out and back of a first-order vehicle, simulated in small time steps."""
    made = []
    for number in range(count):
        size = (1.0, -1.0)[number % 4 // 2] * 0.8
        before, after = (0.0, size) if number % 2 == 0 else (size, 0.0)
        times = np.sort(rng.uniform(-0.75, 3.0, 80))
        v, at, told = truth.gain * before, -1.0, []
        for time in times:  # before the input acts, and after
            for end, u in ((min(max(truth.dead_time_s, at), time), before), (time, after)):
                v = truth.gain * u + (v - truth.gain * u) * math.exp(-(end - at) / truth.tau_s)
                at = end
            told.append(v)
        offset = rng.uniform(-0.3, 0.3)
        velocity = np.array(told) + offset + noise * rng.standard_normal(len(times))
        made.append(StepResponse(before, after, np.array([[0.0, after - before]]), times, velocity))
    return made


def found(made: Sequence[StepResponse]) -> Fit:
    best = fit(made)
    assert best is not None
    return best


@settings(max_examples=15, deadline=None)
@given(
    gain=st.floats(0.6, 1.3),
    tau=st.floats(0.1, 0.9),
    late=st.floats(0.0, 0.6),
    noise=st.floats(0.0, 0.1),
    seed=st.integers(0, 1000),
)
def test_numbers_that_were_true_are_found(
    gain: float, tau: float, late: float, noise: float, seed: int
) -> None:
    """Within twice their intervals, from noisy velocities with irregular stamps, in any wind."""
    truth = Numbers(gain, tau, late)
    best = found(answered(truth, np.random.default_rng(seed), noise=noise))
    for true, number, within in zip(truth, best.numbers, best.within, strict=True):
        assert abs(number - true) <= 2.0 * within + 1e-4
    assert "will not do" not in verdict(best)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """Nominally 95 %; at least 90 % of 75 parameters here."""
    truth, shares = Numbers(0.9, 0.45, 0.27), []
    for seed in range(25):
        best = found(answered(truth, np.random.default_rng(seed), noise=0.05))
        shares += (np.abs(np.array(best.numbers) - truth) / best.within).tolist()
    assert np.mean(np.array(shares) <= 1.0) >= 0.9
    assert np.mean(shares) > 0.2  # no interval is uselessly wide


def second_order(damping: float) -> list[StepResponse]:
    made = []
    for response in answered(Numbers(1.0, 0.3, 0.1), np.random.default_rng(1)):
        w, t = 3.0 * math.sqrt(1.0 - damping**2), np.maximum(response.times, 0.0)
        swing = np.cos(w * t) + 3.0 * damping / w * np.sin(w * t)
        velocity = response.after - response.height * np.exp(-3.0 * damping * t) * swing
        made.append(response._replace(velocity=velocity))
    return made


def test_what_is_no_first_order_is_said_to_be_none() -> None:
    """An oscillating one is rejected; a nearly aperiodic one is not."""
    assert "will not do" in verdict(found(second_order(0.2)))
    assert "will do" in verdict(found(second_order(0.95)))


def test_what_noise_hides_is_said_to_be_unknown() -> None:
    best = found(answered(Numbers(1.0, 0.4, 0.2), np.random.default_rng(3), noise=1.0, count=4))
    assert "it is unclear whether" in verdict(best)


def test_a_model_of_another_vehicle_is_off_by_as_much_as_the_vehicles_differ() -> None:
    """0.1 s more of dead time gives an error of the rise within that time."""
    truth = Numbers(1.0, 0.5, 0.1)
    made = answered(truth, np.random.default_rng(0))
    off = misfit(made, truth._replace(dead_time_s=0.2))
    assert off.largest == pytest.approx(1.0 - math.exp(-0.1 / 0.5), abs=0.04)
    assert off.at_s == pytest.approx(0.2, abs=0.05)
    assert misfit(made, truth).largest < 1e-9


def test_too_few_steps_tell_nothing() -> None:
    made = answered(Numbers(1.0, 0.4, 0.2), np.random.default_rng(0))
    assert fit(made[:1]) is None
    assert fit(made[:2]) is not None


def test_inputs_before_a_step_are_answered_as_well() -> None:
    """The unsettled response to an earlier step is part of the prediction."""
    changes = np.array([[-1.0, 1.0], [0.0, -1.0]])
    times = np.array([0.0, 0.1, 0.5])
    response = StepResponse(1.0, 0.0, changes, times, times)
    numbers = Numbers(2.0, 1.0, 0.1)
    rises = 1.0 - np.exp(-(times + 0.9))
    falls = np.where(times > 0.1, 1.0 - np.exp(-(times - 0.1)), 0.0)
    assert predicted(response, numbers) == pytest.approx(2.0 * (rises - falls))


def test_measurements_belong_to_a_step_by_their_stamps() -> None:
    """In any order of arrival; without measurements that have no velocity, and steps with few."""
    second = 1_000_000_000
    inputs = [(0, [0.0]), (second, [1.0]), (2 * second, [0.0])]
    measured = [Measurement(n * second // 20, [0.0], [float(n)]) for n in reversed(range(45))]
    measured.append(Measurement(second, [0.0], None))
    steps = [
        FlownStep(0, 0.0, 1.0, second, 2 * second),
        FlownStep(0, 1.0, 0.0, 2 * second, 3 * second),  # 5 measurements
        FlownStep(1, 1.0, 0.0, 0, second),
    ]
    (one,) = responses(inputs, measured, steps, 0)
    assert sorted(one.velocity.tolist()) == list(range(15, 40))  # including a time before the step
    assert one.changes.tolist() == [[0.0, 1.0]]


# -- the flight ------------------------------------------------------------------------------


def flown(
    asked: Scenario, plan: ExperimentPlan | None = None, flies: Vehicle | None = None
) -> tuple[Identifying, World]:
    plan = plan or ExperimentPlan(default_speeds(asked), default_hold_s(asked), 1)
    within = fenced(asked, plan)
    endpoint = Identifying(within, flies or vehicles.make(asked, 1), Experiment(within, plan))
    world = World()
    world.add("vehicle", endpoint)
    world.run(lambda: endpoint.finished, limit_ns=3600 * 10**9)
    return endpoint, world


def fits(endpoint: Identifying) -> list[Fit | None]:
    steps = endpoint.experiment.steps
    return [
        fit(responses(endpoint.inputs, endpoint.measured, steps, axis))
        for axis in range(len(endpoint.experiment.plan.speeds))
    ]


def test_a_simulated_vehicle_is_found_out() -> None:
    truth = {"gain": [1.1, 0.9], "tau_s": [0.5, 0.3], "dead_time_s": [0.27, 0.0]}
    endpoint, _ = flown(scenario(vehicle=CALM | truth))
    assert endpoint.why == ""
    assert len(endpoint.experiment.steps) == 8
    for axis, each in enumerate(fits(endpoint)):
        assert each is not None
        expected = [values[axis] for values in truth.values()]
        assert list(each.numbers) == pytest.approx(expected, abs=1e-4)


def test_a_vehicle_comes_back_to_where_it_began() -> None:
    endpoint, _ = flown(scenario(vehicle=CALM | {"start_m": [3.0, -2.0]}))
    path = np.array([each.position for each in endpoint.measured]) - (3.0, -2.0)
    plan = endpoint.experiment.plan
    assert np.hypot(*path.T).max() <= 1.01 * plan.speeds[0] * plan.hold_s
    assert np.hypot(*path[-1]) < 0.5


@pytest.mark.parametrize("seed", range(4))
def test_an_experiment_stays_inside_the_fence(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, high = -rng.uniform(2.5, 7.0, 2), rng.uniform(2.5, 7.0, 2)
    truth = {
        "gain": [rng.uniform(0.8, 1.2)],
        "tau_s": [rng.uniform(0.4, 1.1)],
        "dead_time_s": [rng.uniform(0.0, 0.3)],
        "steady_wind_mps": rng.uniform(-0.3, 0.3, 2).tolist(),
        "start_m": [0.0, 0.0],
    }
    asked = scenario(
        vehicle=CALM | truth,
        model={"tau_s": [0.7], "dead_time_s": 0.2},
        fence={"low_m": low.tolist(), "high_m": high.tolist(), "wind_mps": 0.5},
        reference={"shape": "hover", "points_m": [[0.0, 0.0]]},
    )
    endpoint, _ = flown(asked, ExperimentPlan((rng.uniform(0.2, 1.5),) * 2, 3.0, 2))
    path = np.array([each.position for each in endpoint.measured])
    assert (path >= low).all()
    assert (path <= high).all()
    experiment = endpoint.experiment
    assert len(experiment.steps) + sum(experiment.cut) == 16
    flown_at = dict(endpoint.inputs)
    for step in experiment.steps:  # used steps were flown at full size throughout
        during = [u for t, u in flown_at.items() if step.began_ns <= t < step.ended_ns]
        assert {u[step.axis] for u in during} == {step.after}


def test_steps_without_room_are_not_flown() -> None:
    """The message says what would help; the other axis is still identified."""
    asked = scenario(
        fence={"low_m": [-30.0, -2.2], "high_m": [30.0, 2.2]},
        reference={"shape": "hover", "points_m": [[0.0, 0.0]]},
    )
    endpoint, _ = flown(asked, ExperimentPlan((1.0, 1.0), 3.0, 1))
    assert endpoint.experiment.cut == [0, 4]
    assert max(abs(each.position[1]) for each in endpoint.measured if each.position) < 0.01
    one, other = fits(endpoint)
    assert one is not None
    assert other is None
    assert "(0, 4 cut)" in outcome.describe(outcome.AxisOutcome(1.0, 4, [], None))


def test_a_step_down_needs_a_floor() -> None:
    """Without a lower bound the altitude goes up and back, even below a low ceiling."""
    space = {"model": {"axes": 3}, "reference": {"altitude_m": 5.0}}
    plan = ExperimentPlan((0.4, 0.4, 0.4), 3.0, 1)
    ceiling = {"high_m": [30.0, 30.0, 7.5]}
    endpoint, _ = flown(scenario(**space, fence=ceiling), plan)
    assert endpoint.experiment.cut == [0, 0, 4]
    floor = {"low_m": [-30.0, -30.0, 0.0], "high_m": [30.0, 30.0, 7.5]}
    endpoint, _ = flown(scenario(**space, fence=floor), plan)
    assert endpoint.experiment.cut == [0, 0, 0]
    heights = [each.position[2] for each in endpoint.measured if each.position]
    assert min(heights) < 4.0


class Told(Endpoint):
    """Line to hardware that records its closing."""

    closed = False

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Nothing comes."""

    def wake(self, *, now_ns: int) -> None:
        """Nothing is due."""

    def next_wake_ns(self) -> None:
        """Never."""

    def close(self, *, now_ns: int) -> None:  # noqa: ARG002
        self.closed = True


class Cart(Vehicle):
    """Vehicle that reaches any velocity at once, ready after 2 s, maybe hindered after 10 s."""

    def __init__(self, hindrance: Reason | None = None, *, blind: bool = False) -> None:
        self.port = Told()
        self.inputs: list[Array] = []
        self.landed = self.down = False
        self._hindrance, self._blind = hindrance, blind
        self._p, self._v, self._at = np.zeros(2), np.zeros(2), 0

    def fly(self, velocity: Array) -> None:
        self.inputs.append(velocity)
        self._v = velocity

    def measurements(self, *, now_ns: int) -> Sequence[Measurement]:
        self._p = self._p + self._v * (now_ns - self._at) / 1e9
        self._at = now_ns
        known = [] if self._blind and now_ns > 5 * 10**9 else [0]
        position = [math.nan, 0.0] if self._blind else self._p.tolist()
        return [Measurement(now_ns, position, self._v.tolist()) for _ in known]

    def take_off(self, *, now_ns: int) -> bool:
        self._at = now_ns
        return now_ns >= 2 * 10**9

    def hindrance(self, *, now_ns: int) -> Reason | None:
        return self._hindrance if now_ns > 10 * 10**9 else None

    def land(self) -> bool:
        self.landed = True
        return True

    @property
    def is_down(self) -> bool:
        return self.landed


@pytest.mark.parametrize("why", [Reason.TAKEN, Reason.BATTERY, Reason.ASTRAY, Reason.DISARMED])
def test_what_hinders_a_vehicle_ends_its_flight_at_once(why: Reason) -> None:
    """It lands, unless a pilot has taken over; afterwards only zero is commanded."""
    cart = Cart(why)
    endpoint, world = flown(scenario(), flies=cart)
    assert endpoint.finished
    assert endpoint.why == str(why)
    assert world.now_ns == pytest.approx(10 * 10**9, abs=10**8)
    assert cart.landed is (why is not Reason.TAKEN)
    if cart.landed:
        assert not cart.inputs[-1].any()
    assert endpoint.measured


def test_a_vehicle_whose_state_is_unknown_is_not_flown() -> None:
    cart = Cart(blind=True)
    endpoint, world = flown(scenario(), flies=cart)
    assert endpoint.why == str(Reason.NOT_FINITE)
    assert world.now_ns < 4 * 10**9
    assert not np.any(cart.inputs)


def test_a_flight_that_is_broken_off_closes_the_line() -> None:
    cart = Cart()
    asked = scenario()
    plan = ExperimentPlan((0.5, 0.5), 3.0, 1)
    within = fenced(asked, plan)
    endpoint = Identifying(within, cart, Experiment(within, plan))
    world = World()
    world.add("vehicle", endpoint)
    world.run(lambda: False, limit_ns=12 * 10**9)
    endpoint.close(now_ns=world.now_ns)
    assert cart.port.closed
    assert endpoint.why == "interrupted"
    assert endpoint.flown_s == pytest.approx(10.0, abs=0.1)
    assert len(endpoint.experiment.steps) == 2


def over_mavlink(asked: Scenario, flavour: FlavourName, plan: ExperimentPlan) -> Identifying:
    """Identification of a simulated autopilot, flown to its end in virtual time."""
    within = fenced(asked, plan)
    autopilot = Autopilot(asked, flavour, ready_s=1.0)
    autopilot.flight.parameters |= SAFE[flavour]
    endpoint = Identifying(within, vehicles.make(asked, 1), Experiment(within, plan))
    world = World()
    world.add("autopilot", autopilot)
    world.add("client", endpoint, clock=Clock(10**12, 20_000))
    world.run(lambda: endpoint.finished, limit_ns=300 * 10**9)
    assert (endpoint.finished, endpoint.why) == (True, "")
    assert not autopilot.flight.armed
    return endpoint


@pytest.mark.long
@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_the_documented_field_flies_at_once_with_the_model_identified(
    flavour: FlavourName, tmp_path: Path
) -> None:
    """With steps of the default size inside the fence of docs/fly-a-real-one.md."""
    file = tmp_path / "field.toml"
    file.write_text(documented())
    loaded = reading.load(str(file))
    line = msgspec.structs.replace(loaded.vehicle, address="udpout:autopilot:0")
    asked = msgspec.structs.replace(loaded, vehicle=line)
    speeds = default_speeds(asked)
    endpoint = over_mavlink(asked, flavour, ExperimentPlan(speeds, default_hold_s(asked), 1))
    axes = [
        outcome.AxisOutcome(speed, 0, [], each)
        for speed, each in zip(speeds, fits(endpoint), strict=True)
    ]
    text = outcome.scenario_text(asked, str(file), loaded, axes)
    assert text is not None
    (tmp_path / "scenario.toml").write_bytes(text)
    written = reading.load(str(tmp_path / "scenario.toml"))
    assert (written.u_max * written.model_gain > written.fence.wind_mps).all()
    air = Air(flavour, **reading.to_table(written))
    air.fly()
    air.run(20.0)
    assert air.rmse(written.settled_s) < {"ardupilot": 0.1, "px4": 0.3}[flavour]


@pytest.mark.parametrize("flavour", ["ardupilot", pytest.param("px4", marks=pytest.mark.long)])
def test_an_autopilot_is_identified(flavour: Any) -> None:
    asked = scenario(
        model={"u_max": [3.0]},
        reference={"radius_m": 5.0},
        vehicle=CALM | {"kind": "mavlink", "address": "udpout:autopilot:0"},
    )
    endpoint = over_mavlink(asked, flavour, ExperimentPlan((1.0, 1.0), 3.0, 1))
    expected = {"ardupilot": (0.97, 0.46, 0.28), "px4": (0.75, 0.44, 0.14)}[flavour]
    errs = flavour == "px4"
    for each in fits(endpoint):
        assert each is not None
        # PX4 estimates its velocity within 0.16 m/s; one repetition of steps of 1 m/s.
        assert list(each.numbers) == pytest.approx(expected, abs=0.15 if errs else 0.04)
        assert each.misfit.largest < (0.3 if errs else 0.1)


# -- the command -----------------------------------------------------------------------------


def test_what_is_identified_flies_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    changed = ["--vehicle.tau-s", "0.4", "--vehicle.dead-time-s", "0.2", "--vehicle.gain", "0.8"]
    changed += ["--duration", "20", "--vehicle.wind", "0", "--repeats", "1"]
    assert command.main(identify, ["simulated", *changed], "identify") == 0
    assert "no fence: the vehicle stays" in capsys.readouterr().err
    written = reading.load("identified/scenario.toml")
    assert written.duration == 20.0
    assert written.model.tau_s == pytest.approx((0.4, 0.4), rel=1e-3)
    assert written.model.dead_time_s == pytest.approx((0.2, 0.2), abs=1e-3)
    assert written.model.gain == pytest.approx((0.8, 0.8), rel=1e-3)
    assert written.vehicle.tau_s == (0.4, 0.4)
    before = msgspec.structs.replace(written, model=scenario().model)
    assert rmse(written) < 0.3 * rmse(before)
    text = Path("identified/scenario.toml").read_text()
    assert "# x: gain 0.800 ± 0.000, time constant 0.400 ± 0.000 s" in text
    assert Path("identified/steps.png").stat().st_size > 10_000


def rmse(asked: Scenario) -> float:
    """RMS error of a flight in the plane [m]."""
    record = flight.fly(asked)
    wanted = asked.make_reference()(record.client["step"] * asked.control.dt)
    off = record.client["state"][200:, :, 0] - wanted[200:, :, 0]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def test_other_sizes_of_step_and_files_for_programs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A first-order vehicle has the same model at any size, so the error of a wrong size is 0."""
    monkeypatch.chdir(tmp_path)
    argv = ["simulated", "--speed", "0.5", "--also", "0.2", "--repeats", "1", "--hold", "3"]
    assert command.main(identify, [*argv, "--vehicle.wind", "0"], "identify") == 0
    content = json.loads(Path("identified/identified.json").read_text())
    assert (content["ended"], content["hold_s"]) == ("", 3.0)
    assert [each["steps"] for each in content["axes"]] == [4, 4]
    assert [each["step_mps"] for each in content["sizes"][0]] == [0.2, 0.2]
    assert all(off < 0.001 for cost in content["costs"] for off in cost.values())
    rows = list(csv.DictReader(Path("identified/measured.csv").read_text().splitlines()))
    assert set(rows[0]) == {"time_s", "p_x", "p_y", "v_x", "v_y", "u_x", "u_y"}
    assert {float(row["u_x"]) for row in rows if 3.1 < float(row["time_s"]) < 6.0} == {0.5}


def test_what_was_measured_until_ctrl_c_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    asked = iter(range(10**6))

    @contextmanager
    def interruptible() -> Iterator[Callable[[], bool]]:
        yield lambda: next(asked) > 400

    monkeypatch.setattr(command_of.command, "interruptible", interruptible)
    argv = ["simulated", "--repeats", "1", "--vehicle.wind", "0"]
    assert command.main(identify, argv, "identify") == command.INTERRUPTED
    assert "interrupted" in capsys.readouterr().err
    assert not Path("identified/scenario.toml").exists()
    assert len(Path("identified/measured.csv").read_text().splitlines()) > 400


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["sim"], "vehicle.kind: got 'sim', expected"),
        (["simulated", "--scenario", "dem"], "dem: no such scenario"),
        (["simulated", "--speed", "2"], "--speed: got 2, expected 0.05 to 1.6 m/s"),
        (["simulated", "--speed", "1", "1", "1"], "--speed: got 3 numbers, expected 1 or 2"),
        (["simulated", "--also", "0"], "--also: got 0, expected 0.05 to 1.6 m/s"),
        (["simulated", "--repeats", "0"], "--repeats: got 0, expected 1 to 100"),
        (["simulated", "--hold", "0.1"], "--hold: got 0.1, expected 0.5 to 60 s"),
        (["simulated", "--set-parameters"], "--set-parameters: got vehicle.kind = 'simulated'"),
        (["mavlink", "--vehicle.address", "here"], "vehicle.address: got 'here', expected udp:"),
        (
            ["mavlink", "--also", "1", "--vehicle.address", "udp:127.0.0.1:0"],
            "--also: got a vehicle with hardware",
        ),
    ],
)
def test_what_cannot_be_flown_is_refused(
    argv: list[str],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command.main(identify, argv, "identify") == command.CONFIGURATION
    err = capsys.readouterr().err
    assert f"identify: {said}" in err or said in err
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_steps_are_as_large_as_what_will_be_flown() -> None:
    """The figure eight's speed; at least half of it on an axis at rest, and less within limits."""
    assert default_speeds(scenario()) == (0.42, 0.42)
    space = {"model": {"axes": 3}, "reference": {"altitude_m": 5.0, "radius_m": 5.0}}
    assert default_speeds(scenario(**space)) == (1.05, 1.05, 0.52)
    slow = space | {"model": {"axes": 3, "u_max": [1.6, 1.6, 0.3]}}
    assert default_speeds(scenario(**slow)) == (1.05, 1.05, 0.3)
    hover = {"reference": {"shape": "hover", "points_m": [[0.0, 0.0]]}}
    assert default_speeds(scenario(**hover)) == (0.5, 0.5)
