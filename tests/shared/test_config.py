"""Scenarios: valid, or refused in one line that names the mistake."""

import os
import re
from pathlib import Path

import numpy as np
import pytest

import helpers
from skytether.shared.base import toml
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario

COMMITTED = 'control.scheme = "committed"\n'
"""First line of scenarios whose plans of inputs have a delay bound."""

WRONG = {
    # Not the form of a scenario.
    "velocities never measured, and no filter": (
        'sensor = { velocity_every_s = "never", filter = "none" }',
        "sensor.filter: got 'none', expected 'kalman' with sensor.velocity_every_s = 'never'",
    ),
    "a key misspelt": ("sead = 3", "sead: no such key; did you mean seed?"),
    "a key misspelt two tables down": (
        "network.uplink.los = 0.1",
        "network.uplink.los: no such key; did you mean loss?",
    ),
    "a key that reads like msgspec's own words": (
        '"x` - at `$.file" = 1',
        ("x` - at `$.file: no such key …"),
    ),
    "a key like no other": (
        "model.colour = 1",
        "model.colour: no such key; there are axes, tau_s, u_max, gain, dead_time_s",
    ),
    "a text for a number": ('control.dt = "fast"', "control.dt: got 'fast', expected a number"),
    "a fraction for a whole number": (
        "control.horizon = 2.5",
        "control.horizon: got 2.5, expected a whole number",
    ),
    "yes or no for a whole number": ("seed = true", "seed: got True, expected a whole number"),
    "a number for yes or no": (
        "reference.loop = 1",
        "reference.loop: got 1, expected true or false",
    ),
    "a number for a list": ("model.tau_s = 0.8", "model.tau_s: got 0.8, expected a list"),
    "a number for a table": ("model = 3", "model: got 3, expected a table"),
    "a text within a list": (
        'control.state_weight = [1.0, "a"]',
        "control.state_weight[1]: got 'a', expected a number",
    ),
    "a text within a list of lists": (
        'reference.points_m = [[0.0, 0.0], [1.0, "a"]]',
        "reference.points_m[1][1]: got 'a', expected a number",
    ),
    "a weight too many": (
        "control.terminal_weight = [1.0, 2.0, 3.0]",
        "control.terminal_weight: got [1.0, 2.0, 3.0], expected a list of length 2",
    ),
    # Out of range.
    "no time step": ("control.dt = 0.0", "control.dt: got 0.0, expected a number >= 0.001"),
    "a horizon beyond any datagram": (
        "control.horizon = 271",
        "control.horizon: got 271, expected a whole number <= 270",
    ),
    "a negative tolerance": (
        "control.trigger = 'state_gap(-1.0)'",
        "control.trigger: got 'state_gap(-1.0)', expected … 0 <= epsilon and 0 <= decay_rate",
    ),
    "more lost than sent": (
        "network.downlink.loss = 2",
        "network.downlink: got 'loss(2)', expected loss(share) with 0 <= share <= 1",
    ),
    "a negative delay": (
        "network.uplink.paper = -0.1",
        "network.uplink: got 'paper(-0.1, 0.02, 2.0, 0.0)', expected … 0 <= minimum_s <= 3600 …",
    ),
    "a dead time that fills the memory": (
        "vehicle.dead_time_s = 11.0",
        "vehicle.dead_time_s: got 11.0, expected a number <= 10.0",
    ),
    "no number": (
        "control.observer_s = nan",
        "control.observer_s: got nan, expected a number >= 0.0",
    ),
    "a time-out that no clock can count": (
        "link.timeout_s = 1e300",
        "link.timeout_s: got 1e+300, expected a number <= 3600.0",
    ),
    "a circle faster than anything": (
        "reference.radius_m = 1e6\nreference.period_s = 0.1",
        "reference.radius_m: got 1000000.0, expected at most 12500 with reference.period_s = 0.1",
    ),
    "more digits than Python reads": (
        f"seed = 1{'0' * 5000}",
        ("no valid TOML: …"),
    ),
    "more digits than Python writes": (
        f"seed = 0x{'f' * 5000}",
        "seed: got a number of thousands of digits, expected a whole number <= 4294967295",
    ),
    "more digits than a line has room for": (
        f"control.dt = 1{'0' * 400}",
        f"control.dt: got 1{'0' * 199}…, expected a smaller number",
    ),
    "tables nested deeply": (
        f"model = {'{a=' * 5000}1{'}' * 5000}",
        "no valid TOML: nested too deeply, expected at most 32 brackets",
    ),
    # Not one of the choices.
    "a scheme that is none": (
        'control.scheme = "papr"',
        "control.scheme: got 'papr', expected … 'committed' … 'trajectory' … 'none' …",
    ),
    "a trigger nobody knows": (
        'control.trigger = "often"',
        ("control.trigger: got 'often', expected …"),
    ),
    "a number for a trigger": ("control.trigger = 3", "control.trigger: got 3, expected a text"),
    "a trigger for another scheme": (
        'control.scheme = "predictive"\ncontrol.trigger = "cost_gap"',
        ("control.scheme: got 'predictive', expected … 'committed' … 'trajectory' …"),
    ),
    "feedback without compensation": (
        'control.scheme = "none"\ncontrol.trigger = "always"\ncontrol.feedback = true',
        "control.feedback: got true, expected … control.scheme = 'none' …",
    ),
    "an argument that the trigger has not": (
        "control.trigger.cost_gap = 1.0",
        "control.trigger.cost_gap: got 'expected_gap | heartbeat', expected a text with cost_gap",
    ),
    "no argument of a policy": (
        "control.trigger.expected_gap.d = 1.0",
        "control.trigger.expected_gap.d: no such key; there are c",
    ),
    "a delay bound that is none": (
        'control.delay_bound = "fast"',
        "control.delay_bound: got 'fast', expected a number or 'auto'",
    ),
    "a shape that is none": (
        'reference.shape = "ring"',
        ("reference.shape: got 'ring', expected …"),
    ),
    # Right one by one, and impossible together.
    "three time constants in the plane": (
        "model.tau_s = [0.8, 0.8, 0.8]",
        "model.tau_s: got [0.8, 0.8, 0.8], expected … 1 … 2 … model.axes = 2 …",
    ),
    "two bounds in space": (
        "model.axes = 3\nmodel.u_max = [1.0, 2.0]",
        "model.u_max: got [1.0, 2.0], expected … 1 … 3 … model.axes = 3 …",
    ),
    "no time constant": (
        "model.tau_s = []",
        "model.tau_s: got [], expected … 1 … 2 … model.axes = 2 …",
    ),
    "three dead times in the plane": (
        "model.dead_time_s = [0.2, 0.2, 0.2]",
        "model.dead_time_s: got [0.2, 0.2, 0.2], expected … 1 … 2 … model.axes = 2 …",
    ),
    "two true gains in space": (
        "model.axes = 3\nvehicle.gain = [1.0, 0.9]",
        "vehicle.gain: got [1.0, 0.9], expected … 1 … 3 … model.axes = 3 …",
    ),
    "two true time constants in space": (
        "model.axes = 3\nvehicle.tau_s = [1.0, 2.0]",
        "vehicle.tau_s: got [1.0, 2.0], expected … 1 … 3 … model.axes = 3 …",
    ),
    "a start in space for a flight in the plane": (
        "vehicle.start_m = [0.0, 0.0, 1.0]",
        "vehicle.start_m: got [0.0, 0.0, 1.0], expected 2 numbers with model.axes = 2",
    ),
    "a steady wind along a single axis": (
        "vehicle.steady_wind_mps = [0.5]",
        "vehicle.steady_wind_mps: got [0.5], expected 2 numbers with model.axes = 2",
    ),
    "a horizon shorter than the delay": (
        'extends = "paper"\ncontrol.horizon = 4\ncontrol.dt = 0.1',
        ("control.horizon: got 4, expected … 0.4 s … 0.44 s …"),
    ),
    "a horizon shorter than half of the round trip, a fast uplink notwithstanding": (
        (
            'extends = "paper"\ncontrol.horizon = 10\n'
            "network.uplink.paper = 0.0\nnetwork.downlink.paper = 1.0"
        ),
        ("control.horizon: got 10, expected … 0.5 s … 0.54 s …"),
    ),
    "a delay bound below the delay": (
        COMMITTED + "control.delay_bound = 0.3",
        ("control.delay_bound: got 0.3, expected … 0.44 s …"),
    ),
    "a delay bound below half of the round trip, a fast uplink notwithstanding": (
        (
            COMMITTED + "control.delay_bound = 0.3\nnetwork.uplink = ''\n"
            "network.downlink.paper = 1.5"
        ),
        ("control.delay_bound: got 0.3, expected … 0.75 s …"),
    ),
    "a delay of more steps than fit a datagram": (
        COMMITTED + "control.dt = 0.002\ncontrol.horizon = 1",
        ("control.dt: got 0.002, expected … 0.44 s … 220 …"),
    ),
    "a round trip beyond the age bound": (
        "link.age_max_s = 0.9",
        "link.age_max_s: got 0.9, expected … 0.98 s …",
    ),
    "a downlink beyond the age bound": (
        "network.downlink.paper = 5.0",
        "link.age_max_s: got 5.0, expected … 5.58 s …",
    ),
    "a downlink beyond the age bound without compensation": (
        'extends = "paper-no-compensation"\nnetwork.downlink.paper = 5.0',
        "link.age_max_s: got 5.0, expected … 5.58 s …",
    ),
    "a delay bound beyond the age bound": (
        COMMITTED + "control.delay_bound = 6.0\ncontrol.dt = 0.1\ncontrol.horizon = 40",
        "link.age_max_s: got 5.0, expected … 6.64 s …",
    ),
    "a horizon in space that fits no datagram": (
        "model.axes = 3\ncontrol.horizon = 91",
        "control.horizon: got 91, expected … 90 … 3 …",
    ),
    "a horizon that leaves no room for committed steps": (
        COMMITTED + "control.horizon = 130",
        ("control.horizon: got 130, expected … 126 … 9 … 2 …"),
    ),
    "a delay bound that leaves no room for the horizon": (
        COMMITTED + "control.horizon = 80\ncontrol.delay_bound = 3.0",
        ("control.horizon: got 80, expected … 75 … 60 … 2 …"),
    ),
    "a time-out within a heartbeat": (
        "link.heartbeat_s = 2.0",
        "link.timeout_s: got 1.5, expected more than link.heartbeat_s = 2",
    ),
    # No trajectory.
    "a single waypoint": (
        'reference.shape = "waypoints"\nreference.points_m = [[1.0, 2.0]]',
        "reference.points_m: got [(1.0, 2.0)], expected … 2 … 'waypoints' …",
    ),
    "nowhere to hover": (
        'reference.shape = "hover"',
        "reference.points_m: got [], expected … 1 … 'hover' …",
    ),
    "a waypoint twice in a row": (
        'reference.shape = "waypoints"\nreference.points_m = [[1, 2], [1, 2]]',
        "reference.points_m: got [[1.0, 2.0], [1.0, 2.0]], expected …",
    ),
    "waypoints that rounding makes one": (
        'reference.shape = "waypoints"\nreference.points_m = [[0, 0], [1, 0], [1, 1e-300]]',
        ("reference.points_m: got [[0.0, 0.0], [1.0, 0.0], [1.0, 1e-300]], expected …"),
    ),
    "a loop that ends where it starts": (
        (
            'reference.shape = "waypoints"\nreference.loop = true\n'
            "reference.points_m = [[0, 0], [1, 2], [0, 0]]"
        ),
        ("reference.points_m: got [[0.0, 0.0], [1.0, 2.0], [0.0, 0.0], [0.0, 0.0]], expected …"),
    ),
    "a waypoint in space for a flight in the plane": (
        'reference.shape = "waypoints"\nreference.points_m = [[1, 2], [1, 2, 3]]',
        "reference.points_m: got [1.0, 2.0, 3.0], expected 2 numbers a point",
    ),
}
"""Invalid scenarios, and the message about each; " …" stands for any words."""


def refusal(path: Path | str) -> str:
    return helpers.refusal(lambda: reading.load(str(path)))


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(("text", "said"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said_with_file_key_given_and_expected(
    text: str, said: str, tmp_path: Path
) -> None:
    path = write(tmp_path, "mine.toml", text)
    parts = [re.escape(part) for part in f"{path}: {said}".split(" …")]
    assert re.fullmatch(".*".join(parts), refusal(path))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("reference.altitude_m", "nan"),
        ("reference.points_m", "[[nan, 0.0]]"),
        ("vehicle.start_m", "[-inf, 0.0]"),
        ("network.downlink.paper.slots_mean", "inf"),
    ],
)
def test_a_number_that_is_not_finite_is_refused(key: str, value: str, tmp_path: Path) -> None:
    path = write(tmp_path, "mine.toml", f"{key} = {value}")
    assert refusal(path).startswith(
        f"{path}: {key.removesuffix('.slots_mean').removesuffix('.paper')}"
    )


@pytest.mark.parametrize("key", ["minimum_s", "slot_s", "slots_mean"])
def test_a_delay_that_no_clock_can_count_is_refused(key: str, tmp_path: Path) -> None:
    """Drawing it would end the flight with an overflow."""
    path = write(tmp_path, "mine.toml", f"network.downlink.paper.{key} = 1e19")
    assert refusal(path).startswith(f"{path}: network.downlink: got 'paper(")


@pytest.mark.parametrize(("horizon", "dt"), [(40, 0.011), (44, 0.01), (22, 0.02)])
def test_a_horizon_that_just_covers_the_delay_is_right(horizon: int, dt: float) -> None:
    """Rounding of 40 · 0.011 s = 0.44 s does not matter."""
    control = {"scheme": "predictive", "trigger": "always", "horizon": horizon, "dt": dt}
    table = {"control": control}
    assert reading.check(table, "mine.toml").control.horizon == horizon


@pytest.mark.parametrize("bound", [0.55, "auto"])
def test_a_delay_bound_is_a_time_or_seen(bound: float | str, tmp_path: Path) -> None:
    """Both forms survive being written and read."""
    scenario = reading.check({"control": {"delay_bound": bound}}, "mine.toml")
    assert scenario.control.delay_bound == bound
    path = tmp_path / "copy.toml"
    path.write_bytes(reading.to_toml(scenario))
    assert reading.load(str(path)) == scenario


@pytest.mark.parametrize("bound", [0.44, 1.5, 4.4])
def test_a_delay_bound_may_be_longer_than_the_horizon(bound: float) -> None:
    """From the delay on; the part within the datagram and the age bound is planned beyond it."""
    control = {"horizon": 10, "dt": 0.05, "delay_bound": bound}
    assert reading.check({"control": control}, "mine.toml").control.delay_bound == bound


def test_the_network_of_a_former_flyaway_is_flown_now() -> None:
    """Half of its round trip is 0.775 s, and its horizon 0.4 s."""
    table = reading.to_table(reading.load("demo"))
    table["control"] |= {"dt": 0.02, "horizon": 20}
    table["network"] = {
        "uplink": "constant(0.05) & loss(0.1)",
        "downlink": "constant(1.5) & loss(0.1)",
    }
    assert reading.check(table, "mine.toml")


def test_an_unknown_scenario_is_refused_with_the_nearest_name() -> None:
    assert refusal("papr") == "papr: no such scenario; did you mean paper?"
    assert refusal("xyz") == f"xyz: no such scenario; there are {', '.join(reading.names())}"


def test_a_file_of_scenarios_holds_one_in_each_table(tmp_path: Path) -> None:
    path = write(tmp_path, "many.toml", '[one]\nextends = "paper"\nseed = 9\n["two.5"]\nseed = 8')
    mine = write(tmp_path, "mine.toml", 'extends = "many.toml/one"\nduration = 7.0')
    assert reading.names(str(path)) == [f"{path}/one", f"{path}/two.5"]
    paper = reading.to_table(reading.load("paper"))
    assert reading.to_table(reading.load(f"{path}/one")) == {**paper, "seed": 9}
    assert reading.to_table(reading.load(str(mine))) == {**paper, "seed": 9, "duration": 7.0}
    assert reading.load(f"{path}/two.5").seed == 8
    with pytest.raises(ConfigError, match=r"many.toml/on: no such scenario; did you mean one\?"):
        reading.load(f"{path}/on")


def test_the_compared_scenarios_are_no_scenario_themselves() -> None:
    assert refusal("compare").startswith("compare: no such scenario; there are 5g-")
    assert reading.load("compare/paper-event-gusts").vehicle.gust_mps2 == 1.0
    said = "compare/paper-evnt-gusts: no such scenario; did you mean paper-event-gusts?"
    assert refusal("compare/paper-evnt-gusts") == said


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    assert refusal(path) == f"{path}: cannot be read: No such file or directory"


@pytest.mark.parametrize("content", [b"dt = ", b"= 3", b"seed = 1\nseed = 2", b'title = "\xff"'])
def test_a_file_that_is_no_toml_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(content)
    assert refusal(path).startswith(f"{path}: no valid TOML: ")


def test_only_a_plain_file_of_a_thought_of_size_is_read(tmp_path: Path) -> None:
    """A pipe would block, and a device would never end."""
    path, link = tmp_path / "mine.toml", tmp_path / "link.toml"
    os.mkfifo(path)
    assert refusal(path) == f"{path}: cannot be read: it is not a plain file"
    path.unlink()
    path.mkdir()
    assert refusal(path) == f"{path}: cannot be read: Is a directory"
    link.symlink_to("/dev/zero")
    assert refusal(link) == f"{link}: cannot be read: it is not a plain file"
    link.unlink()
    link.symlink_to(link)
    assert refusal(link).startswith(f"{link}: cannot be read: ")
    link.unlink()
    link.write_bytes(b"#" * (toml.BYTES_MAX + 1))
    assert refusal(link) == f"{link}: cannot be read: it is larger than 1000000 bytes"


def test_a_long_chain_of_scenarios_is_refused(tmp_path: Path) -> None:
    for number in range(30):
        write(tmp_path, f"{number}.toml", f'extends = "{number + 1}.toml"')
    write(tmp_path, "30.toml", "seed = 9")
    assert reading.load(str(tmp_path / "10.toml")).seed == 9
    said = f"{tmp_path}/30.toml: extends: got a chain of more than 20 scenarios"
    assert refusal(tmp_path / "9.toml") == said


def test_extends_needs_the_name_of_a_scenario(tmp_path: Path) -> None:
    number = write(tmp_path, "number.toml", "extends = 3")
    assert refusal(number) == f"{number}: extends: got 3, expected the name of a scenario"
    unknown = write(tmp_path, "unknown.toml", 'extends = "papr"')
    assert refusal(unknown) == "papr: no such scenario; did you mean paper?"


@pytest.mark.parametrize("name", ["a.toml", "../{folder}/a.toml"])
def test_scenarios_that_extend_each_other_are_refused(name: str, tmp_path: Path) -> None:
    path = write(tmp_path, "a.toml", 'extends = "b.toml"')
    write(tmp_path, "b.toml", f'extends = "{name.format(folder=tmp_path.name)}"')
    said = refusal(path)
    assert said.startswith(f"{path}: extends: got a circle of {path} → ")
    assert said.count("→") == 2


def test_a_path_with_a_zero_byte_is_refused(tmp_path: Path) -> None:
    """No file system has such a name."""
    path = write(tmp_path, "mine.toml", r'extends = "a\u0000.toml"')
    assert "cannot be read" in refusal(path)


def test_extends_lays_a_scenario_over_another_key_by_key(tmp_path: Path) -> None:
    write(
        tmp_path,
        "base.toml",
        "seed = 5\nnetwork.uplink = 'constant(0.4) & loss(0.2)'\ncontrol.horizon = 30",
    )
    write(tmp_path, "middle.toml", "extends = 'base.toml'\nnetwork.uplink.loss = 0.3")
    top = write(tmp_path, "top.toml", "extends = 'middle.toml'\ncontrol.dt = 0.1")
    scenario = reading.load(str(top))
    assert (scenario.seed, scenario.control.horizon, scenario.control.dt) == (5, 30, 0.1)
    assert scenario.network.uplink == "constant(0.4) & loss(0.3)"
    assert scenario.downlink.loss == 0.1


def test_what_is_left_out_is_the_default(tmp_path: Path) -> None:
    assert reading.load(str(write(tmp_path, "empty.toml", ""))) == Scenario()


@pytest.mark.parametrize("name", reading.names())
def test_every_scenario_that_comes_with_skytether_can_be_flown(name: str, tmp_path: Path) -> None:
    """Its reference has as many axes as its model, and it survives being written and read."""
    scenario = reading.load(name)
    assert scenario.title
    assert "\n" not in scenario.title
    start = scenario.make_reference()(np.array(0.0))
    assert start.shape == (scenario.model.axes, 2)
    path = tmp_path / "copy.toml"
    path.write_bytes(reading.to_toml(scenario))
    assert reading.load(str(path)) == scenario


def test_the_names_of_scenarios_are_sorted_and_the_papers_are_there() -> None:
    assert reading.names() == sorted(reading.names())
    assert {"demo", "paper", "paper-every-step", "paper-no-compensation"} <= set(reading.names())


TRAJECTORY = "t,x,y\n0,1,2\n1,3,4\n"


def test_a_trajectory_is_looked_for_beside_the_scenario_that_names_it(tmp_path: Path) -> None:
    """A scenario elsewhere that extends it finds the trajectory there as well."""
    for folder in ("base", "mine"):
        (tmp_path / folder).mkdir()
    write(tmp_path / "base", "path.csv", TRAJECTORY)
    named = '[reference]\nshape = "csv"\nfile = "path.csv"'
    paths = [
        write(tmp_path / "base", "base.toml", named),
        write(tmp_path / "mine", "mine.toml", 'extends = "../base/base.toml"'),
    ]
    for path in paths:
        state = reading.load(str(path)).make_reference()(np.array(0.5))
        assert state.tolist() == [[2.0, 2.0], [3.0, 2.0]]


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (None, "a file that can be read"),
        ("t,x\n0,1\n1,2\n", "a table of the trajectory (line 1: "),
        ("t,x,y\n0,1,2\n1,nan,4\n", "a table of the trajectory"),
    ],
)
def test_a_trajectory_that_cannot_be_flown_is_refused(
    table: str | None, said: str, tmp_path: Path
) -> None:
    path = write(tmp_path, "mine.toml", '[reference]\nshape = "csv"\nfile = "path.csv"')
    trajectory = tmp_path / "path.csv"
    if table is not None:
        trajectory.write_text(table)
    got = f"{path}: reference.file: got {str(trajectory)!r}, expected {said}"
    assert refusal(path).startswith(got)


def test_only_a_plain_table_of_a_thought_of_size_is_read(tmp_path: Path) -> None:
    """A pipe is not awaited, and ten gigabytes are not read."""
    trajectory = tmp_path / "path.csv"
    path = write(tmp_path, "mine.toml", '[reference]\nshape = "csv"\nfile = "path.csv"')
    before = f"{path}: reference.file: got {str(trajectory)!r}, expected a file that can be read"
    os.mkfifo(trajectory)
    assert refusal(path) == f"{before} (it is not a plain file)"
    trajectory.unlink()
    with trajectory.open("wb") as file:
        file.truncate(10**10)  # takes no space
    assert refusal(path) == f"{before} (it is larger than 16000000 bytes)"


@pytest.mark.parametrize("table", ["t,x,y\n0,0,0\n1,2e6,0\n", "t,x,y\n0,0,0\n1e-300,1,0\n"])
def test_a_trajectory_out_of_this_world_is_refused(table: str, tmp_path: Path) -> None:
    write(tmp_path, "path.csv", table)
    path = write(tmp_path, "mine.toml", '[reference]\nshape = "csv"\nfile = "path.csv"')
    assert re.search(r"reference\.file: got .* at most 1e\+06 m", refusal(path))


def test_one_value_is_for_all_axes() -> None:
    scenario = reading.check(
        {"model": {"axes": 3, "tau_s": [0.5], "u_max": [1.0, 2.0, 3.0]}}, "mine.toml"
    )
    assert scenario.tau_s.tolist() == [0.5, 0.5, 0.5]
    assert scenario.u_max.tolist() == [1.0, 2.0, 3.0]


def test_the_vehicle_is_what_the_model_says_unless_it_is_told_otherwise() -> None:
    model = {"tau_s": [0.5, 0.6]}
    same = reading.check({"model": model}, "mine.toml")
    other = reading.check({"model": model, "vehicle": {"tau_s": [0.9]}}, "mine.toml")
    assert same.true_tau_s.tolist() == [0.5, 0.6]
    assert other.true_tau_s.tolist() == [0.9, 0.9]


def test_the_terms_hold_what_both_ends_must_agree_on() -> None:
    terms = Scenario().terms()
    assert terms[:5] == (50_000_000, 80, 2, (0.84, 0.84), (1.0, 1.0))
    assert terms[5:7] == ((0.0, 0.0), (1.6, 1.6))
    assert terms[7:11] == ("trajectory", True, "brake", 2.0)
    assert terms[11:14] == (5.0, 0.0, 10.0)
    assert terms[14:22] == ("circle", 1.55, 27.5, 0.0, "none", 1.0, False, "none")
    assert terms[22:] == (0.5, 0.0, 0.15)


@pytest.mark.parametrize(("duration", "steps"), [(60.0, 1200), (0.12, 2), (0.001, 1)])
def test_a_flight_has_as_many_steps_as_fit_its_duration(duration: float, steps: int) -> None:
    assert reading.check({"duration": duration}, "mine.toml").steps == steps
