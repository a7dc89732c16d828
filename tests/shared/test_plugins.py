"""Plug-ins: triggers and references from files and packages in all processes; mistakes."""

import importlib.util
import os
import re
import shlex
import subprocess
import sys
import zipfile
from contextlib import ExitStack, chdir
from functools import partial
from pathlib import Path
from textwrap import dedent
from typing import Any

import msgspec
import numpy as np
import pytest
from hatchling.build import build_wheel

from helpers import faults, packaged, refusal
from skytether.__main__ import main
from skytether.lab.commands.pool import _equipped
from skytether.lab.engine.journal import digests
from skytether.shared.scenario.catalogue import differences
from skytether.shared.scenario.registry import PLUGIN_TABLES, REFERENCES, TRIGGERS
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shell.commandline import plugins
from skytether.sim.batch import fly_batch
from skytether.sim.flight import fly

pytestmark = pytest.mark.usefixtures("plugin_tables")

ROOT = Path(__file__).parents[2]
TRIGGERS_MD, SCHEMES_MD, VEHICLES_MD, NETWORK_MD = (
    ROOT / "docs" / f"{name}.md" for name in ("triggers", "schemes", "vehicles", "network")
)
HEAD = "import numpy as np\nfrom skytether.plugin import *\n"
NEVER = """\
@trigger
def never(now):
    return np.zeros(len(now.rows), dtype=bool)
"""
SLOPE = """\
@reference
def slope(scenario, mps: float = 0.5):
    def at(t):
        state = np.zeros((*np.shape(t), scenario.model.axes, 2))
        state[..., 0, 0], state[..., 0, 1] = mps * t, mps
        return state
    return at
"""
IMPAIRING = """\
@impairment
class bad(Impairment):
    def __call__(self, fate, draws):
        {mistake}
"""


def plug(folder: Path, code: str, name: str = "mine.py") -> str:
    path = folder / name
    path.write_text(HEAD + dedent(code))
    plugins.load([str(path)])
    return str(path)


def scenario(**sections: Any) -> Scenario:
    return packaged("demo-committed", {"duration": 6.0}, sections)


def flown(trigger: str, **control: Any) -> Record:
    return fly(scenario(control={"trigger": trigger} | control))


@pytest.fixture(scope="module")
def always() -> Record:
    return flown("always")


# -- documented plug-ins ---------------------------------------------------------------------------


def example(document: Path) -> str:
    blocks: list[str] = re.findall(r"```python\n(.*?)```", document.read_text(), re.DOTALL)
    (code,) = (block for block in blocks if "skytether.plugin import" in block)
    return code


@pytest.mark.long
@pytest.mark.parametrize(
    ("document", "file"),
    [
        (TRIGGERS_MD, "slip.py"),
        (SCHEMES_MD, "spiral.py"),
        (VEHICLES_MD, "cart.py"),
        (NETWORK_MD, "fading.py"),
    ],
    ids=["trigger", "reference", "vehicle", "impairment"],
)
def test_the_documented_plugin_flies_with_the_documented_command(
    document: Path, file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (line,) = re.findall(rf"^skytether .*--plugin {file}.*$", document.read_text(), re.MULTILINE)
    (tmp_path / file).write_text(example(document))
    with chdir(tmp_path):
        assert main([*shlex.split(line)[1:], "--duration", "20"]) == 0
    assert "RMSE x, y, xy" in capsys.readouterr().out


def test_the_documented_trigger_sends_where_the_velocity_is_off(tmp_path: Path) -> None:
    """More often with a tighter bound, and never later than the `silence` combined with it."""
    plug(tmp_path, example(TRIGGERS_MD))
    loose, tight = (flown(f"slip({mps}) | silence(1)").server for mps in (0.3, 0.05))
    assert 0 < loose["event"].sum() < tight["event"].sum()
    assert np.diff(loose["step"][loose["event"]]).max() <= 20


def test_the_documented_reference_moves_as_fast_as_it_says(tmp_path: Path) -> None:
    plug(tmp_path, example(SCHEMES_MD))
    wanted = {"shape": "spiral(2)", "period_s": 40.0, "radius_m": 3.0}
    at = scenario(reference=wanted).make_reference()
    times = np.linspace(1.0, 39.0, 300)
    slope = (at(times + 1e-4)[..., 0] - at(times - 1e-4)[..., 0]) / 2e-4
    np.testing.assert_allclose(at(times)[..., 1], slope, atol=1e-5)
    np.testing.assert_allclose(at(np.array(50.0)), [[3.0, 0.0], [0.0, 0.0]], atol=1e-9)


def test_the_documented_policies_are_those_that_there_are() -> None:
    rows = re.findall(r"^\| `(\w+)", TRIGGERS_MD.read_text(), re.MULTILINE)
    assert set(TRIGGERS) <= set(rows)


# -- lists -----------------------------------------------------------------------------------------


def test_triggers_are_listed_with_a_sentence_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, about = tmp_path / "mine.py", '    """Sends nothing.\n\n    More."""\n'
    path.write_text(HEAD + NEVER.replace("    return", f"{about}    return"))
    assert main(["list", "triggers", "--plugin", str(path)]) == 0
    said = capsys.readouterr().out
    assert f"never\n    Sends nothing. (from {path})\n" in said
    assert "periodic(N=10) with 1 <= N <= 1000000 (whole)\n    Sends N steps" in said
    assert all(entry.about.endswith(".") for table in PLUGIN_TABLES for entry in table.values())


# -- situation of a policy -------------------------------------------------------------------------


def test_a_policy_is_given_what_it_may_know(tmp_path: Path) -> None:
    """Every field has its shape, and the server's own arrays cannot be written."""
    code = """
        @trigger
        def look(now):
            n, axes, H = now.plan.shape
            assert (n, axes, H) == now.held.shape == (1, 2, 60)
            assert now.desired.shape == (n, axes, H + 1, 2)
            later = now.model.step(now.estimate, now.plan[:, :, 0])
            assert later.shape == now.estimate.shape == now.planned.shape
            assert now.since_sent_s.shape == now.rows.shape == (n,)
            assert now.dt_s == 0.05
            assert not now.estimate.flags.writeable and not now.figures.flags.writeable
            return now.since_sent_s >= 0.5
    """
    plug(tmp_path, code)
    flight = flown("look", horizon=60)
    assert faults(flight) == []
    sent = flight.server["step"][flight.server["event"]]
    assert len(sent) > 5
    assert set(np.diff(sent)) == {10}


def test_plan_horizon_and_desired_states_are_those_that_are_flown(tmp_path: Path) -> None:
    code = """
        @trigger
        def look(now):
            k, start = now.figures["step"][0], now.figures["start"][0]
            seen.append((k, start, now.plan[0], now.held[0], now.desired[0]))
            return now.figures["step"] % 20 == 0
    """
    plug(tmp_path, code)
    seen: list[Any] = []
    TRIGGERS["look"].make.__globals__["seen"] = seen  # type: ignore[attr-defined]
    way = "constant(0.1)"
    asked = scenario(
        control={"trigger": "look", "feedback": False},
        network={"uplink": way, "downlink": way, "mtu": 1472},
    )
    sent = {int(row["step"]): row for row in fly(asked).plan}
    compared = 0
    for step, start, plan, held, desired in seen:
        if step in sent:
            np.testing.assert_array_equal(plan, sent[step]["inputs"])
        last = max((each for each in sent if each < step), default=None)
        if last is not None:
            inputs = sent[last]["inputs"][:, start - sent[last]["begins"] :]
            # The vehicle's clamp removes the excess of a rounded float32 over the bound.
            np.testing.assert_allclose(held[:, : inputs.shape[1]], inputs, rtol=1e-7)
            compared += 1
        times = (start + np.arange(desired.shape[1])) * asked.control.dt
        truth = asked.make_reference()(times).transpose(1, 0, 2)
        np.testing.assert_allclose(desired, truth, atol=1e-9)
    assert compared > 60


def test_what_is_held_aboard_is_known_with_committed_inputs_alone(tmp_path: Path) -> None:
    """With other schemes asking is a mistake, which is logged."""
    plug(tmp_path, "@trigger\ndef look(now):\n    return now.held[:, 0, 0] > 0.0\n")
    (said,) = faults(flown("look", scheme="predictive"))
    known = "held: expected control.scheme = 'committed'"
    assert said == f"the trigger look: ValueError: {known}; when it fails, a horizon is sent"


@pytest.mark.parametrize("scheme", ["predictive", "none", "trajectory"])
def test_every_other_field_is_known_with_every_scheme(scheme: str, tmp_path: Path) -> None:
    """With a trajectory a plan is the velocity alone."""
    code = """
        @trigger
        def look(now):
            assert now.plan.shape[:2] == now.desired.shape[:2] == (len(now.rows), 2)
            assert np.isfinite(now.desired).all()
            return now.since_sent_s > 0.2
    """
    plug(tmp_path, code)
    flight = flown("look", scheme=scheme, feedback=scheme != "none")
    assert faults(flight) == []
    assert flight.server["event"].any()


def test_a_vehicle_that_was_sent_nothing_is_sent_to_whatever_a_function_says(
    tmp_path: Path,
) -> None:
    plug(tmp_path, NEVER)
    assert flown("never").server["event"].sum() == 1


def test_a_class_remembers_what_was_sent(tmp_path: Path) -> None:
    code = """
        @trigger(name="every")
        class Every(Trigger):
            def __init__(self, control, capacity, N: int):
                self.period, self.step = N, np.zeros(capacity, dtype=np.int64)

            def forget(self, row):
                self.step[row] = 0

            def test(self, now):
                step, fresh = now.figures["step"], now.figures["fresh"]
                self.step[now.rows[fresh]] = step[fresh] - self.period
                event = step - self.step[now.rows] >= self.period
                gap = now.figures["state_gap"]
                return Verdict(event, gap, np.zeros(len(event)), Compared.NOTHING)

            def sent(self, rows, figures):
                self.step[rows] = figures["step"]
    """
    plug(tmp_path, code)
    assert flown("every(7)").trace_hash() == flown("periodic(7)").trace_hash()


def test_figures_of_a_plugin_are_recorded_and_a_batch_is_its_singles(tmp_path: Path) -> None:
    code = """
        @trigger
        def far(now, m: float = 0.2):
            return above(now, np.abs(now.estimate[:, 0, 0]), m)
    """
    plug(tmp_path, code)
    one = scenario(control={"trigger": "far & periodic(3)"})
    assert set(fly(one).server["threshold"]) == {0.2}
    alone = [fly(msgspec.structs.replace(one, seed=seed)).trace_hash() for seed in (1, 2)]
    assert [each.trace_hash() for each in fly_batch(one, [1, 2])] == alone


# -- checks ----------------------------------------------------------------------------------------

SLIP = "slip(mps, N) with 0 <= mps <= 5 and 1 <= N (whole)"


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("slip(-1, 2)", SLIP),
        ("slip(1)", SLIP),
        ("slip(1, 2.5)", SLIP),
        ("slop(1, 2)", "a policy; did you mean slip?"),
    ],
)
def test_arguments_of_a_plugin_are_checked_like_ours(
    written: str, expected: str, tmp_path: Path
) -> None:
    code = """
        from typing import Annotated
        from msgspec import Meta

        @trigger
        def slip(now, mps: Annotated[float, Meta(ge=0, le=5)], N: Annotated[int, Meta(ge=1)]):
            return now.figures["fresh"]
    """
    plug(tmp_path, code)
    said = refusal(lambda: scenario(control={"trigger": written}))
    assert said == f"test: control.trigger: got {written!r}, expected {expected}"
    scenario(control={"trigger": "slip(1, 2) | always"})


@pytest.mark.parametrize(
    ("bound", "right", "wrong", "form"),
    [
        ("float, Meta(gt=0)", "0.1", "0", "0 < n"),
        ("float, Meta(gt=-1, lt=1)", "0", "-1", "-1 < n < 1"),
        ("int, Meta(multiple_of=5)", "10", "12", "n (whole) (a multiple of 5)"),
    ],
)
def test_every_bound_of_msgspec_holds(
    bound: str, right: str, wrong: str, form: str, tmp_path: Path
) -> None:
    code = f"""
        from typing import Annotated
        from msgspec import Meta

        @trigger
        def slip(now, n: Annotated[{bound}]):
            return now.figures["fresh"]
    """
    plug(tmp_path, code)
    said = refusal(lambda: scenario(control={"trigger": f"slip({wrong})"}))
    assert said.endswith(f"got 'slip({wrong})', expected slip(n) with {form}")
    scenario(control={"trigger": f"slip({right})"})


@pytest.mark.parametrize(
    ("bound", "right", "wrong", "form"),
    [
        ("File, Meta(pattern='^[a-z]+[.]csv$')", "a.csv", "a.txt", "a file (with the pattern"),
        ("File, Meta(max_length=5)", "a.csv", "ab.csv", "a file (of a length up to 5)"),
        ("Literal['up', 'down']", "up", "left", "up or down"),
    ],
)
def test_every_bound_of_a_text_holds(
    bound: str, right: str, wrong: str, form: str, tmp_path: Path
) -> None:
    code = f"""
        from typing import Annotated, Literal
        from msgspec import Meta
        from skytether.plugin import Impairment, impairment
        from skytether.shared.scenario.registry import File

        @impairment(name="fading")
        class Fading(Impairment):
            def __init__(self, n: Annotated[{bound}, "a name"]):
                pass

            def __call__(self, fate, draws):
                pass
    """
    plug(tmp_path, code)
    for written, refused in ((right, False), (wrong, True)):
        network = {"uplink": f"fading({written})"}
        with chdir(tmp_path):
            Path(written).touch()
            if refused:
                assert form in refusal(partial(scenario, network=network))
            else:
                scenario(network=network)


def test_a_plugin_may_take_negative_numbers_and_have_defaults(tmp_path: Path) -> None:
    code = """
        @trigger
        def slip(now, a: float = -2.0, b: int = 3):
            assert (a, b) in ((-2.0, 3), (-1.5, 3), (-1.5, 4))
            return now.figures["fresh"]
    """
    plug(tmp_path, code)
    for written in ("slip", "slip(-1.5)", "slip(-1.5, 4)"):
        assert faults(flown(written)) == []
    said = refusal(lambda: scenario(control={"trigger": "slip(1, 2.5)"}))
    assert said.endswith("expected slip(a=-2.0, b=3) with b (whole)")


def test_a_plugin_that_needs_a_scheme_is_refused_with_another(tmp_path: Path) -> None:
    code = """
        @trigger(needs="held")
        def mine(now):
            return now.held[:, 0, 0] > 0.0
    """
    plug(tmp_path, code)
    said = refusal(lambda: scenario(control={"trigger": "mine", "scheme": "predictive"}))
    assert said.endswith("got 'predictive', expected 'committed' with the trigger mine")


def test_a_trigger_that_cannot_be_made_is_refused_before_a_flight(tmp_path: Path) -> None:
    code = """
        @trigger(name="between")
        class Between(Trigger):
            def __init__(self, control, capacity, low: float, high: float):
                if low > high:
                    raise ValueError("low is above high")
    """
    plug(tmp_path, code)
    said = refusal(lambda: scenario(control={"trigger": "between(2, 1)"}))
    assert said.endswith("expected a trigger that can be made (ValueError: low is above high)")


IMPORTS = "from typing import Annotated\nfrom msgspec import Meta\n"
ADDS = (
    "expected @planner, @trigger, @scheme, @reference, @vehicle or @impairment on a function or "
    "class, see docs"
)
OURS = "skytether.server.triggers.schedules"
WRONG = {
    "a syntax error": ("def f(:\n", "line 3: SyntaxError: invalid syntax"),
    "an exception": ("\n1 / 0\n", "line 4: ZeroDivisionError: division by zero"),
    "an exit": ("raise SystemExit(0)\n", "line 3: SystemExit: 0"),
    "nothing": (
        "def slip(now):\n    return now\n",
        f"adds nothing, {ADDS}",
    ),
    "a name of ours": (
        "@trigger\ndef silence(now):\n    return now\n",
        f"policy silence: expected another name: {OURS} has an entry of this name",
    ),
    "a text": (
        "@trigger\ndef slip(now, how: str):\n    return now\n",
        "policy slip: how: str: expected a number, as in how: float",
    ),
    "no situation": (
        "@trigger\ndef slip():\n    return 1\n",
        "policy slip: got 0 parameters, expected at least 1",
    ),
    "any number of numbers": (
        "@trigger\ndef slip(now, *numbers: float):\n    return 1\n",
        "policy slip: *numbers: float: expected a number, as in numbers: float",
    ),
    "a default out of bounds": (
        "@trigger\ndef slip(now, N: int = 1.5):\n    return 1\n",
        "policy slip: got the default N = 1.5, expected N (whole)",
    ),
    "a bound that msgspec does not know": (
        f"{IMPORTS}@trigger\ndef slip(now, n: Annotated[float, range(3)]):\n    return 1\n",
        "policy slip: got range(0, 3) with n, expected bounds as in msgspec.Meta(ge=0)",
    ),
    "an impossible name": (
        "@trigger(name='my trigger')\ndef slip(now):\n    return 1\n",
        "policy my trigger: expected a name of letters, digits and _",
    ),
}


@pytest.mark.parametrize(("code", "said"), WRONG.values(), ids=WRONG)
def test_a_file_that_is_no_plugin_is_refused_in_one_line(
    code: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.py"
    path.write_text(HEAD + code)
    assert main(["fly", "demo", "--virtual", "--plugin", str(path)]) == 2
    assert capsys.readouterr().err == f"fly: --plugin: {path}: {said}\n"


def test_a_file_that_fails_adds_nothing(tmp_path: Path) -> None:
    assert "line 6: ZeroDivisionError" in refusal(lambda: plug(tmp_path, NEVER + "1 / 0\n"))
    assert "never" not in TRIGGERS
    assert plugins.flags() == []


def test_a_file_that_cannot_be_read_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path, why in (
        (tmp_path / "no.py", "No such file or directory"),
        (tmp_path, "Is a directory"),
    ):
        assert main(["server", "--plugin", str(path)]) == 2
        assert capsys.readouterr().err == f"server: --plugin: {path}: cannot be read: {why}\n"


def test_two_files_cannot_have_one_name(tmp_path: Path) -> None:
    """A file that is imported again, with other content, replaces itself."""
    one = plug(tmp_path, NEVER, "one.py")
    said = refusal(lambda: plug(tmp_path, NEVER, "two.py"))
    assert said.endswith(f"policy never: expected another name: {one} has an entry of this name")
    plug(tmp_path, NEVER.replace("never", "rarely"), "one.py")
    assert "never" not in TRIGGERS
    assert TRIGGERS["rarely"].source == one


# -- mistakes in flight ----------------------------------------------------------------------------

MISTAKES = {
    "raises": ("return now.figures['nothing']", "ValueError: no field of name nothing"),
    "another shape": (
        "return np.zeros((len(now.rows), 2), dtype=bool)",
        "ValueError: got bool of shape (1, 2), expected bool of shape (1,)",
    ),
    "no yes or no": (
        "return above(now, now.estimate[:, 0, 0], 1)._replace(event=now.estimate[:, 0, 0])",
        "ValueError: got float64 of shape (1,), expected bool of shape (1,)",
    ),
    "writes": (
        "now.planned[:] = 9.0\n    return now.figures['fresh']",
        "ValueError: assignment destination is read-only",
    ),
}


@pytest.mark.parametrize(("body", "said"), MISTAKES.values(), ids=MISTAKES)
def test_a_trigger_that_fails_sends_and_is_told_once(
    body: str, said: str, always: Record, tmp_path: Path
) -> None:
    plug(tmp_path, f"@trigger\ndef bad(now):\n    {body}\n")
    flight = flown("bad")
    assert faults(flight) == [f"the trigger bad: {said}; when it fails, a horizon is sent"]
    np.testing.assert_array_equal(flight.server["event"], always.server["event"])
    assert flight.client.tobytes() == always.client.tobytes()
    assert faults(always) == []


def test_a_budget_caps_a_trigger_that_fails(tmp_path: Path) -> None:
    plug(tmp_path, "@trigger\ndef bad(now):\n    raise RuntimeError\n")
    assert 0 < flown("bad & budget(1, 2)").server["event"].sum() <= 12


def test_a_class_may_fail_anywhere(always: Record, tmp_path: Path) -> None:
    code = """
        @trigger(name="bad")
        class Bad(Trigger):
            def __init__(self, control, capacity):
                pass

            def test(self, now):
                return above(now, now.figures["error"], -1.0)

            def sent(self, rows, figures):
                raise KeyError("sent")

            def forget(self, row):
                raise KeyError("forget")
    """
    plug(tmp_path, code)
    flight = flown("bad")
    assert len(faults(flight)) == 1
    assert flight.client.tobytes() == always.client.tobytes()


@pytest.mark.parametrize("command", ["fly demo", "fleet demo --vehicles 2"])
def test_errors_of_a_trigger_are_counted_in_the_summary_and_the_exit_code(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.py").write_text(
        HEAD + "@trigger\ndef bad(now):\n    raise RuntimeError('no')\n"
    )
    kept = tmp_path / "flown.json"
    asked = f"--virtual --duration 3 --settle 0 --plugin {tmp_path}/mine.py --json {kept}"
    assert main([*shlex.split(f"{command} {asked}"), "--control.trigger", "bad"]) == 1
    errors = msgspec.json.decode(kept.read_bytes())["plugin_errors"]
    assert errors["trigger"] > 30
    shown = capsys.readouterr()
    assert f"trigger {errors['trigger']}" in shown.out
    assert "the plug-in's trigger failed" in shown.err


def test_a_batch_with_a_trigger_that_fails_is_no_measurement(tmp_path: Path) -> None:
    plug(tmp_path, "@trigger\ndef bad(now):\n    raise RuntimeError('no')\n")
    said = refusal(lambda: fly_batch(scenario(control={"trigger": "bad"}), [1, 2]))
    assert said == "the trigger bad: RuntimeError: no; when it fails, a horizon is sent"


# -- references ------------------------------------------------------------------------------------


def test_a_reference_of_a_plugin_is_flown(tmp_path: Path) -> None:
    plug(tmp_path, SLOPE)
    asked = scenario(reference={"shape": "slope(0.4)"}, vehicle={"wind": 0.0})
    assert fly(asked).client[-1]["state"][0, 1] == pytest.approx(0.4, abs=0.05)
    assert asked.make_reference()(np.array([2.0]))[0, 0].tolist() == [0.8, 0.4]
    bare = scenario(reference={"shape": "slope"}).make_reference()
    assert bare(np.array(2.0))[0].tolist() == [1.0, 0.5]


UNFLYABLE = {
    "raises": ("raise RuntimeError('no map')", "RuntimeError: no map"),
    "another shape": (
        "return lambda t: np.zeros(3)",
        "ValueError: got float64 of shape (3,) at 1 times, expected floats of shape (2, 2)",
    ),
    "whole numbers": (
        "return lambda t: np.zeros((*t.shape, 2, 2), dtype=np.int64)",
        "ValueError: got int64 of shape (2, 2) at 1 times, expected floats of shape (2, 2)",
    ),
    "no number": (
        "return lambda t: np.full((*t.shape, 2, 2), np.nan)",
        "ValueError: expected at most 1e+06 m from the origin, and 1e+06 m/s",
    ),
    "far away": (
        "return lambda t: np.full((*t.shape, 2, 2), 1.1e6)",
        "ValueError: expected at most 1e+06 m from the origin, and 1e+06 m/s",
    ),
}


@pytest.mark.parametrize(("body", "said"), UNFLYABLE.values(), ids=UNFLYABLE)
def test_a_reference_that_cannot_be_flown_is_refused(body: str, said: str, tmp_path: Path) -> None:
    plug(tmp_path, f"@reference\ndef mine(scenario):\n    {body}\n")
    message = refusal(lambda: scenario(reference={"shape": "mine"}))
    expected = f"expected a trajectory that can be flown ({said})"
    assert message == f"test: reference.shape: got 'mine', {expected}"


@pytest.mark.parametrize(
    "shape", [" circle", "circle()", "slope & circle", "slope(1, 2)", "circle(1)"]
)
def test_a_shape_is_written_in_one_way(shape: str, tmp_path: Path) -> None:
    """Code that compares a shape with a name must meet only one form."""
    plug(tmp_path, SLOPE)
    assert f"reference.shape: got {shape!r}" in refusal(
        lambda: scenario(reference={"shape": shape})
    )


def test_ends_whose_references_differ_have_other_terms(tmp_path: Path) -> None:
    terms = []
    for states in ("mps * t", "t * mps + 1e-9", "0.999 * mps * t"):
        plug(tmp_path, SLOPE.replace("mps * t", states))
        terms.append(scenario(reference={"shape": "slope(0.4)"}).terms())
    here, rounded, other = terms
    assert rounded == here
    (difference,) = differences(here, other)
    assert difference.key == "reference.shape"
    assert difference.here.startswith("slope(0.4) ")
    assert scenario(reference={"shape": "slope( .4 )"}).terms() == other
    (difference,) = differences(other, scenario(reference={"shape": "slope(0.41)"}).terms())
    assert difference.there.startswith("slope(0.41) ")


def test_a_long_shape_fits_the_wire(tmp_path: Path) -> None:
    name = "a_name_that_is_a_good_deal_longer_than_others"
    plug(tmp_path, SLOPE.replace("slope", name))
    shapes = [scenario(reference={"shape": f"{name}({mps})"}).terms().shape for mps in (0.1, 0.2)]
    assert [len(shape) for shape in shapes] == [32, 32]
    assert shapes[0] != shapes[1]


def test_the_terms_of_our_shapes_are_their_names() -> None:
    for shape in ("circle", "figure-eight", "square", "target", "live"):
        assert scenario(reference={"shape": shape}).terms().shape == shape
    assert all(entry.is_ours for entry in REFERENCES.values())


# -- other processes -------------------------------------------------------------------------------


def test_a_worker_is_given_the_plugin_with_its_content(tmp_path: Path) -> None:
    path = plug(tmp_path, NEVER)
    job = partial(_equipped, lambda name: name in TRIGGERS, plugins.loaded())
    Path(path).unlink()
    plugins._loaded.clear()
    del TRIGGERS["never"]
    assert job("never")
    assert plugins.flags() == ["--plugin", path]


def test_a_journal_knows_the_plugins_that_its_results_follow_from(tmp_path: Path) -> None:
    """By the digest of their content; unused plug-ins do not count."""
    path = plug(tmp_path, NEVER)
    plug(tmp_path, SLOPE, "unused.py")
    named = scenario(control={"trigger": "never | silence(1)"})
    before = digests([named, scenario()])
    assert list(before) == [path]
    plug(tmp_path, NEVER + "\n")
    assert digests([named])[path] != before[path]
    assert digests([scenario()]) == {}


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["sweep", "paper", "--out", "out", "--runs", "0"], "--runs: got 0"),
        (["margins", "demo", "--runs", "0"], "--runs: got 0"),
    ],
    ids=lambda argv: argv[0],
)
def test_commands_of_the_laboratory_take_the_flag_several_times(
    argv: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / "one.py", tmp_path / "two.py"]
    for path, code in zip(files, (NEVER, SLOPE), strict=True):
        path.write_text(HEAD + code)
    given = [word for path in files for word in ("--plugin", str(path))]
    with chdir(tmp_path):
        assert main([*argv, *given]) == 2
    assert said in capsys.readouterr().err
    assert plugins.flags() == given


SHORT = "--settle 0 --duration 4 --reference.shape slope(0.4)"


def run(line: str, *more: str, folder: Path, path: str = "", code: int = 0) -> str:
    argv = [sys.executable, "-P", "-m", "skytether", *line.split(), *more]
    # With ROOT, for another checkout may be the installed one.
    env = os.environ | {"PYTHONPATH": f"{ROOT}:{path}"}
    done = subprocess.run(argv, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("installed")
    with chdir(ROOT / "tests" / "plugin_package"):
        wheel = build_wheel(str(folder))
    zipfile.ZipFile(folder / wheel).extractall(folder)
    return str(folder)


INSTALLED = {
    "triggers": (
        "slip(mps=0.3) with 0 <= mps",
        "--control.trigger slip&silence(1) --reference.shape slope(0.4)",
    ),
    "vehicles": ("rail\n", "--vehicle.kind rail"),
    "schemes": ("beacon\n", "--control.scheme beacon --control.trigger deviation(0.1)"),
    "impairments": ("dark(every_s) with 1 <= every_s", "--network.uplink constant(0.2)&dark(2)"),
}
"""List in which an entry of the package is, the entry, and flags that fly with it."""


@pytest.mark.long
@pytest.mark.parametrize("table", INSTALLED)
def test_an_installed_package_adds_entries_that_fly(
    table: str, installed: str, tmp_path: Path
) -> None:
    entry, flags = INSTALLED[table]
    assert f"\n{entry}" in "\n" + run(f"list {table}", folder=tmp_path, path=installed)
    line = f"fly demo --virtual --settle 0 --duration 8 {flags}"
    assert "RMSE" in run(line, folder=tmp_path, path=installed)


def test_a_package_whose_entry_point_leads_nowhere_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    info = tmp_path / "broken-2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 2.0\n")
    (info / "entry_points.txt").write_text("[skytether.triggers]\nslip = no_such_module:slip\n")
    monkeypatch.syspath_prepend(tmp_path)
    plugins._load_installed.cache_clear()
    assert main(["list", "triggers"]) == 2
    assert capsys.readouterr().err == (
        "list: entry point slip = no_such_module:slip of broken 2.0: "
        "ModuleNotFoundError: No module named 'no_such_module'\n"
    )


@pytest.mark.parametrize(
    "mistake",
    [
        "raise RuntimeError('no')",
        "fate.delay_ns = -1",
        "fate.delay_ns = None",
        "fate.copies = 101",
        "fate.flipped = 1.0",
    ],
)
def test_a_mistake_of_an_impairment_ends_no_flight(mistake: str, tmp_path: Path) -> None:
    plug(tmp_path, IMPAIRING.format(mistake=mistake))
    network = {"uplink": "constant(0.2) & bad", "downlink": "constant(0.2)"}
    flight = fly(scenario(network=network, duration=2.0))
    assert len(faults(flight)) == 1
    plain = fly(scenario(network=dict.fromkeys(network, "constant(0.2)"), duration=2.0))
    assert np.array_equal(flight.client, plain.client)


@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.timeout(900)
def test_every_process_of_a_flight_knows_the_plugin(tmp_path: Path) -> None:
    """Over UDP: a trigger's mistake is logged, and both ends know the reference."""
    bad = "@trigger\ndef bad(now):\n    raise RuntimeError('no')\n"
    (tmp_path / "mine.py").write_text(HEAD + SLOPE + bad)
    plugged = f"{SHORT} --plugin mine.py --record flight.mcap"
    bad = f"fly demo --page 127.0.0.1:0 {plugged} --control.trigger bad"
    said = run(bad, folder=tmp_path, code=1)
    assert said.count("the trigger bad: RuntimeError: no; when it fails, a horizon is sent") == 1
    assert "goes on without a page" not in said
    run("report flight.mcap --plugin mine.py", folder=tmp_path)


@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.timeout(900)
def test_workers_of_every_kind_know_the_plugin(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(HEAD + SLOPE + NEVER)
    here = f"--workers 2 --plugin mine.py {SHORT}"
    grid = 'control.trigger="never | silence(1)","always"'
    run(f"sweep demo --out swept --runs 2 {here} --grid", grid, folder=tmp_path)
    search = "--objective rmse --runs 1 --generations 1 --population 4 --control.trigger"
    run(f"calibrate demo {here} {search}", "never | cost_gap", folder=tmp_path)
    run(f"fleet --vehicles 2 {here}", folder=tmp_path)


@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="needs `distributed`")
def test_a_dask_worker_knows_the_plugin(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(HEAD + NEVER)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    with ExitStack() as stack:

        def dask(name: str, *argv: str) -> "subprocess.Popen[str]":
            line = [sys.executable, "-P", "-m", f"distributed.cli.dask_{name}", *argv]
            child = stack.enter_context(
                subprocess.Popen(line, cwd=elsewhere, stderr=subprocess.PIPE, text=True)
            )
            stack.callback(child.kill)
            return child

        scheduler = dask("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        assert scheduler.stderr is not None
        at = next(line for line in scheduler.stderr if "Scheduler at:" in line).split()[-1]
        dask("worker", at, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        flags = f"--settle 0 --duration 4 --plugin mine.py --scheduler {at} --control.trigger"
        run(f"sweep demo --out swept --runs 2 {flags}", "never | silence(1)", folder=tmp_path)
