"""Schemes of plug-ins: flown like built-in ones, and the consequences of their mistakes."""

import re
import shlex
from contextlib import chdir
from pathlib import Path
from textwrap import dedent, indent
from typing import Any

import msgspec
import numpy as np
import pytest

from helpers import faults, packaged, refusal
from skytether.__main__ import main
from skytether.server.schemes import loading
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire.protocol import Mode
from skytether.shell.commandline import plugins
from skytether.sim.batch import fly_batch
from skytether.sim.flight import fly

pytestmark = pytest.mark.usefixtures("plugin_tables")

PAGE = (Path(__file__).parents[2] / "docs" / "schemes.md").read_text()
(CHASE,) = re.findall(r"```python\n(import numpy.*?plugin_scheme.*?)```", PAGE, re.DOTALL)
OURS = """
    import numpy as np
    from skytether.plugin_scheme import *
    from skytether.server.schemes.committed import Replay
    from skytether.server.schemes.horizons import HorizonScheme
    from skytether.server.schemes.predictive import Estimator
    from skytether.server.schemes.trajectory import Guidance
    from skytether.server.schemes.feedback import feedback_gain
    from skytether.shared.scenario.schemes import FIGURES

    class Horizons(HorizonScheme):
        def __init__(self, fleet):
            control, gain = fleet.scenario.control, feedback_gain(fleet.scenario)
            super().__init__(self.known(fleet, control, gain), fleet)

    @scheme
    class predictive_(Horizons):
        properties = SchemeProperties("predictive", ("state_gap",))
        def known(self, fleet, control, gain):
            return Estimator(fleet.terms, control, gain, fleet.capacity)

    @scheme
    class committed_(Horizons):
        properties = SchemeProperties("committed", FIGURES)
        def known(self, fleet, control, gain):
            return Replay(fleet.terms, control, gain, fleet.capacity, fleet.clock)

    @scheme
    class trajectory_(Guidance):
        properties = SchemeProperties("trajectory", FIGURES[1:], feedback=True)
"""


def plug(folder: Path, code: str) -> None:
    path = folder / "mine.py"
    path.write_text(dedent(code))
    plugins.load([str(path)])


def scenario(scheme: str, trigger: str = "periodic(5)", **control: Any) -> Scenario:
    keys = {"scheme": scheme, "trigger": trigger} | control
    return packaged("demo", {"duration": 8.0, "settle": 2.0}, {"control": keys})


def failing(method: str, wrong: str) -> str:
    """The page's scheme with a mistake that soon concerns the vehicle in row 1."""
    signature = {
        "forget": "row",
        "observe": "row, observation",
        "encode": "batch, head",
        "sent_plans": "batch",
    }.get(method, "rows, step, found" + ", event" * (method == "remember"))
    late = {
        "forget": "True",
        "observe": "row == 1 and observation.step > 20",
        "encode": "(batch.step > 60).any() and 1 in batch.rows[batch.sent]",
        "sent_plans": "(batch.step > 60).any()",
    }.get(method, "step.max() > 60 and 1 in rows")
    return f"""{CHASE}
    def does(self, {signature}):
        given = ({signature},)
{indent(wrong, " " * 8)}

    def {method}(self, {signature}):
        if {late}:
            return self.does({signature})
        return super().{method}({signature})
""".replace("class Chase(InputScheme)", "class Chase(Right)").replace(
        "@scheme", f"{RIGHT}\n\n@scheme", 1
    )


RIGHT = re.sub(r'@scheme.*\n|    """Sends.*\n', "", CHASE[CHASE.index("@scheme") :]).replace(
    "class Chase", "class Right"
)
"""The page's scheme without its registration."""


# -- same flights as built-in schemes --------------------------------------------------------------


def test_the_documented_scheme_flies_with_the_documented_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (line,) = re.findall(r"^skytether .*--plugin chase.py.*$", PAGE, re.MULTILINE)
    (tmp_path / "chase.py").write_text(CHASE)
    assert len(CHASE.splitlines()) <= 40
    with chdir(tmp_path):
        assert main([*shlex.split(line)[1:], "--duration", "20"]) == 0
        assert main(["list", "schemes", "--plugin", "chase.py"]) == 0
    said = capsys.readouterr().out
    assert "RMSE x, y, xy" in said
    assert "chase(gain=0.8)\n    Sends inputs that follow" in said


def test_the_documented_scheme_follows_the_reference(tmp_path: Path) -> None:
    plug(tmp_path, CHASE)
    flight = fly(scenario("chase"))
    late = flight.server[flight.server["step"] > 130]
    off = np.linalg.norm((late["reference"] - late["estimate"])[..., 0], axis=1)
    assert off.max() < 0.2
    assert faults(flight) == []


@pytest.mark.parametrize(
    ("base", "scheme"),
    [("paper", "predictive"), ("demo-committed", "committed"), ("demo", "trajectory")],
)
def test_our_schemes_fly_the_same_as_plugins(base: str, scheme: str, tmp_path: Path) -> None:
    plug(tmp_path, OURS)
    short = {"duration": 4.0, "settle": 2.0}
    ours = packaged(base, short, {"control": {"scheme": scheme}})
    theirs = packaged(base, short, {"control": {"scheme": f"{scheme}_"}})
    assert fly(theirs).trace_hash() == fly(ours).trace_hash()


def test_a_batch_is_its_singles(tmp_path: Path) -> None:
    plug(tmp_path, CHASE)
    one = scenario("chase(0.5)")
    alone = [fly(msgspec.structs.replace(one, seed=seed)).trace_hash() for seed in (1, 2)]
    assert [each.trace_hash() for each in fly_batch(one, [1, 2])] == alone


def test_a_vehicle_may_name_the_scheme_that_it_is_flown_as(tmp_path: Path) -> None:
    """Then the vehicle's host needs no plug-in."""
    plug(tmp_path, CHASE)
    assert scenario("chase").terms() == scenario("predictive").terms()


def test_a_scheme_calls_no_kernels_of_ours_but_those_that_send(tmp_path: Path) -> None:
    plug(tmp_path, CHASE)
    others = loading.others(scenario("chase"))
    assert "skytether.server.schemes.horizons" not in others
    assert {"skytether.server.mpc.exact", "skytether.server.planning.splines"} <= others


# -- checks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("chose", "'committed' or 'predictive' or 'trajectory' or 'none' or 'chase'"),
        ("chase(1, 2)", "chase(gain=0.8)"),
        ("chase()", "a scheme such as 'trajectory', or 'name(1.5)'"),
    ],
)
def test_a_scheme_is_named_as_it_is_written(written: str, expected: str, tmp_path: Path) -> None:
    plug(tmp_path, CHASE)
    said = refusal(lambda: scenario(written))
    assert said == f"test: control.scheme: got {written!r}, expected {expected}"


def test_a_trigger_fits_where_the_scheme_computes_what_it_compares(tmp_path: Path) -> None:
    plug(tmp_path, CHASE)
    said = refusal(lambda: scenario("chase", "cost_gap"))
    able = "'committed' or 'trajectory' with the trigger cost_gap"
    assert said == f"test: control.scheme: got 'chase', expected {able}"
    plug(tmp_path, CHASE.replace('"predictive")', '"predictive", figures=("cost_gap",))'))
    assert "cost_gap" in (fly(scenario("chase", "cost_gap")).server.dtype.names or ())


WRONG = {
    "no plan": (
        CHASE.replace("def plan(", "def planned("),
        "scheme chase: expected the methods plan, too",
    ),
    "no class": (
        "from skytether.plugin_scheme import scheme\n@scheme\ndef mine(fleet):\n    pass\n",
        "got 'mine', expected a class that extends one of skytether.plugin_scheme",
    ),
    "no scheme": (
        (
            "from skytether.plugin_scheme import scheme\n@scheme\nclass mine:\n"
            "    def __init__(self, fleet):\n        pass\n"
        ),
        "got 'mine', expected a class that extends one of skytether.plugin_scheme",
    ),
    "no such flight": (
        CHASE.replace('"predictive"', '"sideways"'),
        "expected flown_as from committed, predictive, trajectory, none",
    ),
    "no such figure": (
        CHASE.replace('"predictive"', '"predictive", figures=("worth",)'),
        "and figures from state_gap, cost_gap, expected_gap, deviation_m",
    ),
}


@pytest.mark.parametrize(("code", "expected"), WRONG.values(), ids=WRONG)
def test_what_is_no_scheme_is_refused_before_a_flight(
    code: str, expected: str, tmp_path: Path
) -> None:
    def read() -> None:
        plug(tmp_path, code)
        scenario("mine" if "mine" in code else "chase")

    with pytest.raises(ConfigError) as said:
        read()
    assert expected in str(said.value)


@pytest.mark.parametrize(
    ("right", "wrong", "why"),
    [
        ("super().__init__(fleet)", "raise RuntimeError('no')", "RuntimeError: no"),
        (
            '"predictive")',
            '"trajectory")',
            "TypeError: a scheme with flown_as='trajectory' must not extend InputScheme",
        ),
    ],
)
def test_a_scheme_that_cannot_be_made_is_refused_as_its_server_begins(
    right: str, wrong: str, why: str, tmp_path: Path
) -> None:
    plug(tmp_path, CHASE.replace(right, wrong))
    with pytest.raises(ConfigError) as said:
        fly(scenario("chase"))
    expected = f"a scheme that can be made ({why})"
    assert str(said.value) == f"control.scheme: got 'chase', expected {expected}"


# -- mistakes in flight ----------------------------------------------------------------------------

BAD_PLAN = "super().plan(*given)\nfound.horizons[rows == 1, :, :80] = {}"


@pytest.mark.parametrize(
    ("method", "wrong", "said"),
    [
        ("observe", "raise RuntimeError('no')", "RuntimeError: no"),
        ("foresee", "raise RuntimeError('no')", "RuntimeError: no"),
        ("plan", "raise RuntimeError('no')", "RuntimeError: no"),
        ("plan", BAD_PLAN.format("np.nan"), "ValueError: expected inputs within ±model.u_max"),
        ("plan", "found.ahead[:] = 1", "ValueError: expected delay bounds from 0 to 0"),
        ("remember", "raise RuntimeError('no')", "RuntimeError: no"),
        ("encode", "raise RuntimeError('no')", "RuntimeError: no"),
    ],
)
def test_a_mistake_costs_its_vehicle_the_plan_and_nobody_else(
    method: str, wrong: str, said: str, tmp_path: Path
) -> None:
    """Logged once; the vehicle flies its plan to the end and hovers, the other one flies on."""
    plug(tmp_path, failing(method, wrong))
    flight = fly(scenario("chase"), vehicles=2)
    (fault,) = faults(flight)
    assert fault.startswith(f"the scheme chase: {said}")
    assert fault.endswith("; a vehicle for which it fails is sent no plan at that step")
    assert flight.figures["server"]["counts"]["scheme_errors"] > 10
    last = {int(row["vehicle"]): row["mode"] for row in flight.client}
    assert [mode == Mode.TRACK for mode in last.values()].count(True) == 1
    assert set(last.values()) <= {Mode.TRACK, Mode.COAST, Mode.BRAKE, Mode.HOVER}


@pytest.mark.parametrize("method", ["forget", "sent_plans"])
def test_a_mistake_beside_the_plans_costs_no_plan(method: str, tmp_path: Path) -> None:
    plug(tmp_path, failing(method, "raise RuntimeError('no')"))
    flight = fly(scenario("chase"))
    assert faults(flight)[0].startswith("the scheme chase: RuntimeError: no")
    assert flight.client["mode"][-1] == Mode.TRACK
