"""Planners of plug-ins in place of the MPC: what they are given, what is flown, and mistakes."""

import json
import re
import shlex
import sys
from collections.abc import Sequence
from contextlib import chdir
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
import pytest

import skytether
from bench.planners import PAGE, documented
from helpers import faults, packaged, ran, refusal
from skytether.__main__ import main
from skytether.plugin import Problem, planner
from skytether.server.endpoint import Server
from skytether.shared.base.errors import ConfigError
from skytether.shared.law.model import Array
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shell.commandline import plugins
from skytether.sim.batch import fly_batch
from skytether.sim.flight import fly

pytestmark = pytest.mark.usefixtures("plugin_tables")

NEEDS = {"steer": "numpy", "convex": "cvxpy", "nonlinear": "casadi"}


def scenario(scheme: str = "committed", name: str = "mine", **control: Any) -> Scenario:
    base = {"committed": "demo-committed", "trajectory": "demo"}.get(scheme, "demo-paper")
    feeds_back = scheme in ("committed", "trajectory")
    keys = {"scheme": scheme, "planner": name, "feedback": feeds_back, "horizon": 40}
    return packaged(base, {"duration": 5.0, "settle": 2.0}, {"control": keys | control})


class Mine:
    """The documented policy; a subclass says what it does otherwise."""

    made = 0

    def __init__(self, problem: Problem, gain: float = 1.5) -> None:
        self.problem, self.gain = problem, gain
        type(self).made += 1
        self.number = type(self).made

    def plan(self, state: Array, reference: Array, previous: Array) -> Any:  # noqa: ARG002
        inputs, model, u_max = [], self.problem.model, self.problem.u_max
        for here, soon in pairwise(reference):
            velocity = soon[:, 1] + self.gain * (here[:, 0] - state[:, 0])
            inputs.append(np.clip((velocity - model.a11 * state[:, 1]) / model.b1, -u_max, u_max))
            state = model.step(state, inputs[-1])
        return np.array(inputs).T


# -- what a planner is given and what is flown -----------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", NEEDS)
def test_the_documented_planner_flies_with_the_documented_command(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a whole file of at most 30 lines."""
    pytest.importorskip(NEEDS[name])
    (line,) = re.findall(rf"^skytether .*--plugin {name}.py.*$", PAGE.read_text(), re.MULTILINE)
    code = documented()[name]
    assert len(code.splitlines()) <= 30
    (tmp_path / f"{name}.py").write_text(code)
    with chdir(tmp_path):
        given = [*shlex.split(line)[1:], "--duration", "4", "--json", "flight.json"]
        assert main(given) == 0
    assert "RMSE x, y, xy" in capsys.readouterr().out
    assert json.loads((tmp_path / "flight.json").read_text())["rmse_xy"] < 1.0


@pytest.mark.parametrize("scheme", ["committed", "predictive", "none", "trajectory"])
def test_a_planner_is_given_what_it_may_know(scheme: str) -> None:
    seen: list[tuple[Array, Array, Array, Array]] = []

    @planner(name="mine")
    class Looking(Mine):
        def plan(self, state: Array, reference: Array, previous: Array) -> Any:
            plan = super().plan(state, reference, previous)
            seen.append((state, reference, previous, plan))
            return plan

    flown = scenario(scheme)
    flight = fly(flown)
    assert faults(flight) == []
    H, axes = flown.control.horizon, flown.model.axes
    assert len(seen) == len(flight.server)
    for state, reference, previous, _ in seen:
        assert (state.shape, reference.shape) == ((axes, 2), (H + 1, axes, 2))
        assert previous.shape == (axes, H)
    assert not seen[0][2].any()
    begins = (flight.server["step"] + flight.server["ahead"]).tolist()
    truth = flown.make_reference()(flown.control.dt * (begins[60] + np.arange(H + 1)))
    np.testing.assert_allclose(seen[60][1], truth, atol=1e-9)
    gap = begins[61] - begins[60]
    np.testing.assert_array_equal(seen[61][2][:, : H - gap], seen[60][3][:, gap:])
    np.testing.assert_array_equal(seen[61][2][:, -1], seen[60][3][:, -1])


def test_inputs_are_sent_without_the_disturbance_and_within_their_bounds() -> None:
    @planner(name="mine")
    class Wild(Mine):
        def plan(self, *given: Array) -> Any:
            return 3.0 * super().plan(*given)

    windy = {"vehicle.steady_wind_mps": (0.3, 0.0)}
    plans = skytether.fly(scenario(), **windy).record.plan
    assert np.abs(plans["inputs"]).max() <= np.float32(1.6)
    assert np.abs(plans["inputs"]).max() > 1.5


def test_wind_is_compensated_for_a_planner_that_knows_nothing_of_it() -> None:
    planner(name="mine")(Mine)
    wind = {"vehicle.steady_wind_mps": (0.3, 0.0), "vehicle.wind": 0.0, "duration": 10.0}
    seen, blind = (
        skytether.fly(scenario(observer_s=s, feedback=False), settle=6.0, **wind).summary.rmse_xy
        for s in (2.0, 0.0)
    )
    assert seen is not None
    assert blind is not None
    assert seen < 0.5 * blind


def test_numbers_of_a_planner_stand_in_the_scenario() -> None:
    gains = set()

    @planner(name="mine")
    class Told(Mine):
        def plan(self, *given: Array) -> Any:
            gains.add(self.gain)
            return super().plan(*given)

    fly(scenario(name="mine(0.7)"))
    skytether.fly(scenario(name="mine(0.7)"), **{"control.planner.mine.gain": 0.9})
    assert gains == {0.7, 0.9}


def test_states_are_sent_as_a_spline_near_them() -> None:
    """A planner that returns the reference itself is followed as the reference."""

    @planner(name="mine")
    class Still(Mine):
        def plan(self, *given: Array) -> Any:
            assert not given[2].any()
            return given[1]

    flown = scenario("trajectory")
    flight = fly(flown)
    assert faults(flight) == []
    times = flown.control.dt * flight.plan["begins"]
    wanted = flown.make_reference()(times)
    far = np.linalg.norm(flight.plan["state"][..., 0] - wanted[..., 0], axis=1)
    assert far.max() <= flown.control.spline_error_m + 1e-6


def test_plans_are_compared_with_the_plan_sent_last() -> None:
    """The planned state is where the last plan sent leads, however many were made since."""
    planner(name="mine")(Mine)
    flight = fly(scenario("predictive", trigger="periodic(10)", observer_s=0.0))
    model = scenario().terms().model
    sent = {int(row["step"]): row for row in flight.plan}
    compared = 0
    for row in flight.server[20:]:
        last = max((step for step in sent if step < row["step"]), default=None)
        if last is not None:
            since = int(row["step"]) - last
            states = model.roll(sent[last]["state"], sent[last]["inputs"].astype(float))
            np.testing.assert_allclose(row["planned"], states[since], atol=1e-6)
            compared += since > 1
    assert compared > 50


def test_a_batch_is_its_singles() -> None:
    planner(name="mine")(Mine)
    one = scenario(trigger="cost_gap(3.0) | silence(1)")
    one = msgspec.structs.replace(one, duration=4.0, settle=2.0)
    alone = [fly(msgspec.structs.replace(one, seed=seed)).trace_hash() for seed in (1, 2)]
    assert [each.trace_hash() for each in fly_batch(one, [1, 2])] == alone


def test_the_library_flies_a_class() -> None:
    named = skytether.fly("demo", duration=2, planner=Mine)
    assert named.scenario.control.planner == "Mine"
    same = skytether.fly("demo", duration=2, **{"control.planner": "Mine"})
    assert same.record.trace_hash() == named.record.trace_hash()
    assert same.record.trace_hash() != skytether.fly("demo", duration=2).record.trace_hash()
    with pytest.raises(ConfigError, match="udp: got True with a planner of this process"):
        skytether.fly("demo", planner=Mine, udp=True)
    with pytest.raises(TypeError, match="expected a class"):
        skytether.fly("demo", planner=object())  # type: ignore[arg-type]


# -- mistakes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (np.full((2, 40), np.nan), "ValueError: expected a plan of finite numbers"),
        (np.full((2, 40), np.inf), "ValueError: expected a plan of finite numbers"),
        (np.zeros((40, 2)), "got a plan of shape (40, 2), expected (2, 40)"),
        (np.zeros((41, 2, 2)), "got a plan of shape (41, 2, 2), expected (2, 40)"),
        (None, "got a plan of shape (), expected (2, 40)"),
        ("left", "ValueError: could not convert string to float"),
        ([[0.0], [0.0, 1.0]], "ValueError: "),
    ],
    ids=["NaN", "infinite", "shape", "states", "nothing", "words", "ragged"],
)
def test_what_cannot_be_flown_is_no_plan(answer: Any, said: str) -> None:
    """It is counted each time, and told once; the other vehicle has its plan."""
    planner(name="mine")(Scripted)
    server = Server(scenario(), boot_id=1, entropy=bytes, capacity=2)
    own = server.controller.scheme.planner._planners  # type: ignore[attr-defined]
    given = np.arange(2), np.array([5, 5]), np.zeros((2, 2, 2)), np.zeros((2, 2, 41, 2))
    for _ in range(3):
        Scripted.answers = [answer, np.full((2, 40), 5.0)]
        nothing, plan = own.plan(*given)
        assert nothing is None
        np.testing.assert_array_equal(plan, 1.6)
    (told,) = server.controller.faults
    assert said in told
    assert told.endswith("; a vehicle for which it fails is sent no plan at that step")
    assert server.controller.counts["planner_errors"] == 3


class Scripted:
    answers: ClassVar[list[Any]] = []

    def __init__(self, _: Problem) -> None:
        pass

    def plan(self, *_: Array) -> Any:
        return self.answers.pop(0)


@pytest.mark.parametrize(
    ("scheme", "raised"),
    [("committed", RuntimeError), ("trajectory", RuntimeError), ("committed", SystemExit)],
)
def test_a_mistake_costs_its_vehicle_the_plan_and_nobody_else(
    scheme: str, raised: type[BaseException]
) -> None:
    """The other vehicle's flight is the same to the last bit, though the planner has also
    overwritten its arguments, and has tried to overwrite the problem.
    """

    @planner(name="mine")
    class Wrong(Mine):
        fails = False

        def plan(self, state: Array, reference: Array, previous: Array) -> Any:
            plan = super().plan(state, reference, previous)
            if self.fails and self.number == 2:
                state[:] = reference[:] = previous[:] = np.nan
                for array in (self.problem.u_max, *self.problem.model):
                    with pytest.raises(ValueError, match="read-only"):
                        array[:] = 0.9
                raise raised("no")
            return plan

    flown = msgspec.structs.replace(scenario(scheme), duration=3.0)
    right = fly(flown, vehicles=2)
    Wrong.made, Wrong.fails = 0, True
    wrong = fly(flown, vehicles=2)
    (told,) = faults(wrong)
    assert told.startswith("the planner mine: RuntimeError: ")
    counts = wrong.figures["server"]["counts"]
    assert counts["planner_errors"] == counts["unsolved"] > 20
    (failing,) = set(wrong.server["vehicle"][~wrong.server["solved"]].tolist())
    other = 3 - failing
    assert rows_of(right, other) == rows_of(wrong, other)
    assert rows_of(right, failing) != rows_of(wrong, failing)


def rows_of(flight: Record, vehicle: int) -> list[bytes]:
    parts = flight.client, flight.server, flight.plan
    return [part[part["vehicle"] == vehicle].tobytes() for part in parts]


def test_a_mistake_that_passes_costs_its_steps_alone() -> None:
    """Afterwards planning goes on from the last plan, in the same flight."""

    @planner(name="mine")
    class Late(Mine):
        calls = 0

        def plan(self, *given: Array) -> Any:
            self.calls += 1
            if 60 <= self.calls < 70:
                raise RuntimeError("no")
            return super().plan(*given)

    flight = fly(scenario())
    assert flight.figures["server"]["counts"]["planner_errors"] == 10
    assert (~flight.server["solved"]).sum() == 10
    assert flight.server["solved"][-1]


@pytest.mark.parametrize("before", [(0, 1), (0,)], ids=["asked", "made"])
def test_a_vehicle_that_takes_the_row_of_one_whose_planner_is_late_is_planned_for(
    before: tuple[int, ...],
) -> None:
    """It has a planner of its own, which is not taken for the one that is still called."""
    planner(name="mine")(Mine)
    asked, late, answers = set[int](), set[int](), list[int]()

    def planning(calls: Sequence[tuple[int, Any]]) -> list[Any]:
        asked.update(number for number, _ in calls)
        late.update(asked - set(answers) if answers else ())
        return [TimeoutError("no") if number in late else call() for number, call in calls]

    server = Server(scenario(), boot_id=1, entropy=bytes, capacity=2, planning=planning)
    own = server.controller.scheme.planner._planners  # type: ignore[attr-defined]

    def plans(*rows: int) -> list[bool]:
        n = len(rows)
        given = np.full(n, 5), np.zeros((n, 2, 2)), np.zeros((n, 2, 41, 2))
        return [plan is not None for plan in own.plan(np.array(rows), *given)]

    assert all(plans(*before))
    answers.append(min(asked))
    assert plans(0, 1) == [True, False]
    assert server.controller.counts["planner_late"] == 1
    answers.clear()
    assert plans(0, 1) == [True, False]
    own.forget(1)
    assert plans(0, 1) == [True, True]


HANGS = """
import time
import numpy as np
from skytether.plugin import planner

@planner(name="hangs")
class Hangs:
    calls = 0
    def __init__(self, problem):
        self.inputs = np.zeros((problem.axes, problem.horizon))
    def plan(self, state, reference, previous):
        self.calls += 1
        time.sleep(3600.0 * (self.calls > 20))
        return self.inputs
"""


@pytest.mark.realtime
@pytest.mark.long
def test_a_planner_that_hangs_over_udp_is_told_once_and_its_flight_ends(tmp_path: Path) -> None:
    (tmp_path / "hangs.py").write_text(HANGS)
    own = "--plugin", "hangs.py", "--control.planner", "hangs", "--duration", "8"
    made = ran(sys.executable, "-m", "skytether", "fly", "demo", *own, cwd=tmp_path)
    assert made.stderr.count("TimeoutError: got no plan after 0.025 s, half a step") == 1
    assert "Traceback" not in made.stderr


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"control": {"planner": "mino"}}, "got 'mino', expected a planner; did you mean mine?"),
        ({"control": {"planner": "mine(a)"}}, "got 'mine(a)', expected"),
        (
            {"control": {"planner": "mine"}, "reference": {"shape": "swap"}},
            "got 'mine', expected 'mpc' on a mission",
        ),
    ],
)
def test_a_planner_that_cannot_be_flown_is_refused(keys: dict[str, Any], expected: str) -> None:
    planner(name="mine")(Mine)
    assert f"control.planner: {expected}" in refusal(lambda: packaged("demo", keys))


def test_a_scheme_of_a_plugin_plans_itself(tmp_path: Path) -> None:
    planner(name="mine")(Mine)
    code = """from skytether.plugin_scheme import InputScheme, SchemeProperties, scheme
@scheme(name="chase")
class Chase(InputScheme):
    properties = SchemeProperties("predictive")
    def forget(self, row): pass
    def observe(self, row, observation): return True
    def foresee(self, rows, step, foresight): pass
    def plan(self, rows, step, foresight): pass
"""
    (tmp_path / "chase.py").write_text(code)
    plugins.load([str(tmp_path / "chase.py")])
    told = refusal(lambda: scenario("chase", trigger="periodic(5)"))
    assert "control.planner: got 'mine', expected 'mpc' with control.scheme = 'chase'" in told


@pytest.mark.parametrize("scheme", ["committed", "trajectory"])
def test_a_planner_that_cannot_be_made_is_refused_as_its_server_begins(scheme: str) -> None:
    @planner(name="mine")
    class Broken:
        def __init__(self, _: Problem) -> None:
            raise RuntimeError("no")

    with pytest.raises(ConfigError) as said:
        fly(scenario(scheme))
    expected = "expected a planner that can be made (RuntimeError: no)"
    assert str(said.value) == f"control.planner: got 'mine', {expected}"

    @planner(name="mine")
    class Without:
        def __init__(self, _: Problem) -> None:
            pass

    with pytest.raises(ConfigError, match="AttributeError"):
        fly(scenario(scheme))
