"""Contenders and cases of `skytether compare`, and the file of each contender's weights.

The file contains the best weights of each contender in each case. A search finds them
(`search_start`, `calibration.Rmse`), on seeds that the comparison does not fly. `budgets` then
chooses a threshold for each budget of packets. Some cases are flown with the weights of another
case, to show how well weights transfer.
"""

import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from skytether.shared.base.errors import ConfigError
from skytether.shared.base.hint import hint
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import flat, set_keys, text_key, value
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.whole import Scenario

SEARCH_SEED = 1001
PACKETS = 0.1
"""Largest event ratio in a search, for a contender whose trigger uses the state."""
SCOUTS = 16
"""Number of scouting flights of a point, on seeds of the search."""
ROUNDS = 4
"""Number of rounds in which thresholds are bisected near each budget.

In the case `target`, at 1 packet/s, 5 % more packets reduce the error by a fifth. With coarse
thresholds, contenders would leave part of a budget unused, and their errors would be too large.
"""
NEAR = (0.1, 0.3, 1, 3, 10, 30, 100)
"""Factors by which thresholds are multiplied for scouting flights."""
PERIODS = (0.1, 0.2, 0.5, 1, 2, 4, 8)
"""Factors by which a period of ten steps is multiplied for scouting flights."""


@dataclass(frozen=True, slots=True)
class Contender:
    name: str
    """Name of the contender in tables, files and scenarios."""
    scheme: str
    trigger: str
    control: Mapping[str, Any]
    """Keys of `control` that define the contender, and the initial weights of its search."""
    threshold: str = ""
    """Key of `control` that determines the number of packets; empty if there is none."""
    keys: Mapping[str, Any] = field(default_factory=dict)
    """Dotted keys and values of a user's contender; empty for a built-in one."""
    base: "Contender | None" = None
    """Built-in contender whose weights a user's contender uses; None: the case's weights."""

    @property
    def title(self) -> str:
        return f"{self.scheme}, {self.trigger}" if self.trigger else self.scheme

    @property
    def factors(self) -> Sequence[float]:
        """Factors for the threshold that the search found, one for each point of a curve."""
        if not self.threshold:
            return ()
        return PERIODS if self.threshold == "trigger.periodic" else NEAR


LOOSE = {
    "state_weight": [7.1, 3.0],
    "terminal_weight": [1e5, 1e5],
    "input_weight": 5.0,
    "change_weight": 200.0,
}
"""Initial weights of a search with the paper's scheme, which keep successive plans similar."""
TIGHT = {
    "state_weight": [7.1, 1.0],
    "terminal_weight": [50.0, 20.0],
    "input_weight": 0.3,
    "change_weight": 0.01,
}
"""Initial weights of a search with committed inputs, without a weight on changes of the plan."""

PAPER = {"scheme": "predictive", "feedback": False, "observer_s": 0.0, "horizon": 40} | LOOSE
"""The paper's scheme, with the horizon that reproduces its Table 1."""
COMMITTED = {
    "scheme": "committed",
    "feedback": False,
    "observer_s": 4.0,
    "horizon": 60,
} | TIGHT
"""Scheme with committed inputs. The search varies the time constant of the scheme's observer; a
long time constant has the same effect as no observer.
"""
FEEDBACK = COMMITTED | {"feedback": True}
TRAJECTORY = {
    "scheme": "trajectory",
    "feedback": True,
    "horizon": 80,
    "state_weight": [7.1, 0.1],
    "terminal_weight": [50.0, 20.0],
    "input_weight": 0.1,
    "change_weight": 0.5,
}
"""Scheme that sends a trajectory; a regulator on the vehicle follows it."""

ALWAYS = {"trigger": "always"}
PERIODIC = {"trigger": "periodic(10)"}
STATE_GAP = {"trigger": "state_gap(5e4, 1.5)"}
COST_GAP = {"trigger": "cost_gap(300.0)"}
EXPECTED_GAP = {"trigger": "expected_gap(300.0)"}
SILENT = {"trigger": "cost_gap(3.0) | silence(1)"}
ACKNOWLEDGED = {"trigger": "expected_gap(3.0) | heartbeat"}
"""Trigger for trajectories. Its threshold is smaller than for horizons, because the cost covers one
step, not all steps of a horizon.
"""


def _contenders() -> tuple[Contender, ...]:
    every, periodic, gap, expected = "every step", "periodic", "cost gap", "expected gap"
    steps, cost, doubted = "trigger.periodic", "trigger.cost_gap", "trigger.expected_gap"
    committed, aboard, spline = "committed", "committed with feedback", "trajectory"
    return (
        Contender("paper-every-step", "paper", every, PAPER | ALWAYS),
        Contender("paper-event", "paper", "eq. (16)", PAPER | STATE_GAP, "trigger.state_gap"),
        Contender("paper-periodic", "paper", periodic, PAPER | PERIODIC, steps),
        Contender("committed-gap", committed, gap, COMMITTED | COST_GAP, cost),
        Contender("feedback-every-step", aboard, every, FEEDBACK | ALWAYS),
        Contender("feedback-periodic", aboard, periodic, FEEDBACK | PERIODIC, steps),
        Contender("feedback-gap", aboard, gap, FEEDBACK | COST_GAP, cost),
        Contender("feedback-expected", aboard, expected, FEEDBACK | EXPECTED_GAP, doubted),
        Contender("trajectory-every-step", spline, every, TRAJECTORY | ALWAYS),
        Contender("trajectory-periodic", spline, periodic, TRAJECTORY | PERIODIC, steps),
        Contender(
            "trajectory-gap",
            spline,
            "cost gap or a second",
            TRAJECTORY | SILENT,
            cost,
        ),
        Contender(
            "trajectory-expected",
            spline,
            expected,
            TRAJECTORY | ACKNOWLEDGED,
            doubted,
        ),
    )


CONTENDERS = _contenders()
BESIDE = "feedback-gap"
"""Contender whose weights are used for the floor."""
REGULATED = "trajectory-expected"
"""Contender whose weights are used for flights with the reference aboard."""
ABOARD = Contender("aboard", "reference aboard", "no packets", {})
"""Baseline for cases in which the reference is known before the flight."""


@dataclass(frozen=True, slots=True)
class Case:
    name: str
    title: str
    """Name of the case in the report."""
    plant: str
    """Name of the scenario with the vehicle, reference and network of all contenders."""
    keys: Mapping[str, Any]
    """Dotted keys that differ from the plant's scenario, and their values."""
    effort_mps: float = math.inf
    """Largest effort in a search: RMS change of the command from step to step [m/s]."""
    weights: str = ""
    """Name of the case whose weights are used; empty if the case has its own."""
    contenders: Sequence[str] = ()
    start: Mapping[str, float] = field(default_factory=dict)


TARGET = {
    "control.input_reference": True,
    "link.heartbeat_s": 1.0,
    "link.timeout_s": 5.0,
    "vehicle.report": "always",
    "duration": 35.0,
}
"""Keys of every case with a target: heartbeats as rare as in the paper's scenario, and costs of
inputs relative to the target's velocity (`control.input_reference`).
"""
CIRCLE = ("paper-every-step", "paper-event", "committed-gap", "feedback-gap", "trajectory-expected")
"""Contenders on the circle, where the reference is known in advance, so that a vehicle could follow
the circle without a network.
"""


def _unsearched(name: str, title: str, keys: Mapping[str, Any]) -> Case:
    return Case(name, title, "target", {**TARGET, **keys}, weights="target")


def _circle(name: str, title: str, keys: Mapping[str, Any], effort_mps: float) -> Case:
    """Case on the paper's circle, where costs and thresholds are hundreds of times smaller."""
    small = {"trigger.cost_gap": 1.0, "trigger.expected_gap": 1.0, "trigger.state_gap": 300.0}
    round_ = {**keys, "duration": 32.5}  # one full circle after `settle`, which RMSE leaves out
    return Case(name, title, "paper", round_, effort_mps, contenders=CIRCLE, start=small)


def _network(argument: str, value: Any) -> Mapping[str, Any]:
    """Keys that set an argument, or with "" all impairments, in both directions of the network."""
    at = f".{argument}" if argument else ""
    return {f"network.{way}{at}": value for way in ("uplink", "downlink")}


def _noise(position_m: float) -> Mapping[str, Any]:
    """Keys of the sensor's noise; the velocity's noise [m/s] is 2.5 times the position's [m]."""
    return {
        "sensor.position_noise_m": position_m,
        "sensor.velocity_noise_mps": 2.5 * position_m,
    }


BURSTS = "paper(0.4, 0.02, 2.0) & gilbert_elliott(0.1, 2.0)"
GUSTS = {"vehicle.gust_mps2": 1.0, "vehicle.gust_every_s": 10.0, "vehicle.gust_s": 1.0}
WINDY = {"vehicle.wind": 0.3, "vehicle.gain": 0.8}
CASES = (
    Case("target", "a target that only the server sees", "target", TARGET, 0.3),
    Case(
        "turns",
        "a target that turns every 4 s on average",
        "target",
        {**TARGET, "reference.turn_every_s": 4.0},
        0.3,
    ),
    _unsearched("loss-0.3", "loss of 0.3 each way", _network("loss", 0.3)),
    _unsearched("loss-0.5", "loss of 0.5 each way", _network("loss", 0.5)),
    _unsearched("wind-gain", "wind of 0.3 m/s per √s, and a gain of 0.8", WINDY),
    _unsearched("jitter", "jitter doubled", _network("", "paper(0.36, 0.04, 2.0) & loss(0.1)")),
    _unsearched(
        "burst-2",
        "bursts of 2 s",
        _network("", BURSTS),
    ),
    _unsearched("noise-10", "noise of 10 cm", _noise(0.1)),
    _unsearched(
        "measured",
        "a target that the server measures with noise of 20 cm",
        {"reference.noise_m": 0.2},
    ),
    Case(
        "route",
        "a route that only the server knows, for 4 s",
        "target",
        {**TARGET, "reference.preview": 4.0},
        0.3,
    ),
    Case(
        "bounds",
        "a target nearly as fast as the vehicle",
        "target",
        {**TARGET, "reference.speed_mps": 1.5, "reference.agility": 0.6},
        0.6,
    ),
    _circle("wind-0.1", "circle, wind of 0.1 m/s per √s", {"vehicle.wind": 0.1}, 0.1),
    _circle("wind-0.3", "circle, wind of 0.3 m/s per √s", {"vehicle.wind": 0.3}, 0.35),
    _circle("gusts", "circle, gusts of 1 m/s²", GUSTS, 0.1),
)
"""All cases; the first is the benchmark."""


def cases(names: Sequence[str]) -> Sequence[Case]:
    """Cases by name; all if no name is given.

    Raises ConfigError if a name is unknown.
    """
    by_name = {case.name: case for case in CASES}
    for name in names:
        if name not in by_name:
            raise ConfigError(f"--cases: got {name!r}, expected a case; {hint(name, by_name)}")
    return [by_name[name] for name in names] or CASES


@dataclass(frozen=True, slots=True)
class ComparisonSize:
    """Number and length of the flights of a comparison; defaults as in docs/compare.md."""

    runs: int
    """Number of flights of each chosen point; half as many in a case without its own weights."""
    generations: int
    population: int = 8
    search_runs: int = 6
    search_duration: float = 30.0
    cases: Sequence[Case] = CASES
    contenders: Sequence[Contender] = CONTENDERS
    """Contenders of the comparison; a case may leave some out."""
    scouts: int = SCOUTS
    rounds: int = ROUNDS
    """Number of rounds in which more thresholds are tried near the budgets."""
    budgets: Sequence[float] = ()
    """Budgets for which points are chosen and flown; by default all."""
    duration: float = math.inf
    """Largest length of a flight [s]."""

    def scenario(self, case: Case) -> Scenario:
        """Scenario of a case, without the keys of a contender."""
        table = reading.to_table(reading.load(case.plant))
        set_keys(case.keys, table)
        table["duration"] = min(table["duration"], self.duration)
        return reading.check(table, case.title)

    def who(self, case: Case) -> list[Contender]:
        return [
            each
            for each in self.contenders
            if each.keys or not case.contenders or each.name in case.contenders
        ]

    @property
    def searched(self) -> list[tuple[Contender, Case]]:
        """Every contender in every case for which weights are searched."""
        return [
            (contender, case)
            for case in self.cases
            if not case.weights
            for contender in self.who(case)
        ]


QUICK = ("paper-every-step", "paper-event", "feedback-gap", "trajectory-expected")


def quick(scale: ComparisonSize) -> ComparisonSize:
    """Reduced size for `--quick`, at most as large as requested."""
    few = [case for case in scale.cases if case is CASES[0]]
    return ComparisonSize(
        runs=min(scale.runs, 10),
        generations=min(scale.generations, 1),
        population=4,
        search_runs=2,
        search_duration=20.0,
        cases=few or scale.cases[:1],
        contenders=[each for each in scale.contenders if each.keys or each.name in QUICK],
        scouts=4,
        rounds=2,
        duration=40.0,
    )


# -- contenders of a user ------------------------------------------------------------------------

SETTABLE = ("control", "link", "vehicle.report")
"""Sections and keys that a user's contender may set, except `control.dt`; cases set the rest."""


def of_user(files: Sequence[Path]) -> list[Contender]:
    """User's contenders, each with the name of its file.

    Raises:
        ConfigError: a file cannot be read, sets a key of the case, or has another contender's name.
    """
    found = {each.name: each for each in (*CONTENDERS, ABOARD)}
    built_in = len(found)
    for file in files:
        if file.stem in found:
            expected = f"expected another name than {', '.join(found)}"
            raise ConfigError(f"--contender: {file}: got the name {file.stem!r}, {expected}")
        found[file.stem] = _of_user(file)
    return list(found.values())[built_in:]


def _of_user(file: Path) -> Contender:
    raw = reading.read_toml(file, str(file))
    texts = {key: raw.pop(key, "") for key in ("title", "extends", "threshold")}
    keys, weighted = dict(flat(raw)), {each.name: each for each in CONTENDERS}
    for key in keys:
        if key == "control.dt" or not {key.partition(".")[0], text_key(key)} & {*SETTABLE}:
            expected = (
                f"{', '.join(texts)}, or keys of {', '.join(SETTABLE)}: the case sets all others"
            )
            raise ConfigError(f"{file}: got {key}, expected {expected}")
    if not keys:
        raise ConfigError(f"{file}: got no keys, expected some of {', '.join(SETTABLE)}")
    for key, text in texts.items():
        if not isinstance(text, str):
            raise ConfigError(f"{file}: {key}: got {text!r}, expected a text")
    title, extends, threshold = texts.values()
    if extends and extends not in weighted:
        expected = f"the name of a built-in contender; {hint(extends, weighted)}"
        raise ConfigError(f"{file}: extends: got {extends!r}, expected {expected}")
    return Contender(
        file.stem,
        title or file.stem,
        trigger="",
        control={},
        threshold=threshold.removeprefix("control."),
        keys=keys,
        base=weighted.get(extends),
    )


# -- weights -------------------------------------------------------------------------------------


def tuned(contender: Contender, case: Case, weights: str) -> Scenario:
    """Scenario of a contender in a case, with weights from a file and a user's own keys.

    Raises:
        ConfigError: the file lacks the contender, or has unknown ones, or the keys cannot be flown.
    """
    base, where = contender.base or contender, f"{contender.name}, {case.name}"
    if case.contenders and contender.base and base.name not in case.contenders:
        there = ", ".join(case.contenders)
        raise ConfigError(f"{where}: extends: got {base.name!r}, expected one of {there}")
    if contender.keys and base is contender:
        table = reading.to_table(reading.load(case.plant))
        set_keys(case.keys, table)
    else:
        table = reading.to_table(_with_weights(base, case, weights))
    set_keys(contender.keys, table)
    scenario = reading.check(table, where)
    if contender.threshold:
        number = None
        with suppress(KeyError, TypeError, GrammarError):
            number = value(reading.to_table(scenario), f"control.{contender.threshold}")
        if not isinstance(number, int | float):
            expected = "the key of a number, as in control.trigger.cost_gap"
            raise ConfigError(f"{where}: threshold: got {contender.threshold}, expected {expected}")
    return scenario


def _with_weights(contender: Contender, case: Case, weights: str) -> Scenario:
    built_in = {
        entry(each, other)
        for other in CASES
        for each in CONTENDERS
        if not other.contenders or each.name in other.contenders
    }
    tables = [each.removeprefix(f"{weights}/") for each in reading.names(weights)]
    for table in tables:
        if table not in built_in:
            expected = "a built-in contender and its case, as --tune writes them (a contender of "
            expected += f"your own is flown by --contender FILE); {hint(table, sorted(built_in))}"
            raise ConfigError(f"{weights}: got the table {table!r}, expected {expected}")
    name = entry(contender, case)
    if name not in tables:
        there_is = "expected every contender in every case, as --tune writes them"
        raise ConfigError(f"{weights}: got no table {name!r}, {there_is}")
    return reading.load(f"{weights}/{name}")


def search_start(contender: Contender, case: Case, scale: ComparisonSize) -> Scenario:
    table = reading.to_table(reading.load(case.plant))
    set_keys({f"control.{key}": value for key, value in contender.control.items()}, table)
    if contender.threshold in case.start:
        set_keys({f"control.{contender.threshold}": case.start[contender.threshold]}, table)
    set_keys(case.keys, table)
    set_keys({"duration": scale.search_duration, "seed": SEARCH_SEED}, table)
    return reading.check(table, f"{contender.title}, {case.title}")


def entry(contender: Contender, case: Case) -> str:
    """Name of the table for a contender and a case in the file of weights."""
    return f"{contender.name}-{case.weights or case.name}"


@dataclass(frozen=True, slots=True)
class TunedWeights:
    contender: Contender
    case: Case
    scenario: Scenario
    says: str
    """Summary of the result on the search's seeds, in one line."""


def to_file(found: Sequence[TunedWeights], scale: ComparisonSize) -> str:
    """Text of the file of weights: for each contender and case a table of keys that differ from the
    plant.

    A comment in the file states the size of the searches, `scale`.
    """
    says = (
        "Scenarios of each contender of `skytether compare` in each case, with the weights and "
        f"thresholds that `skytether compare --tune` has found for it in {scale.generations} "
        f"generations of {scale.population} points, each flown with {scale.search_runs} seeds from "
        f"{SEARCH_SEED} on for {scale.search_duration:g} s. At most {PACKETS:.0%} of the steps may "
        "send, if the trigger uses the state. The largest effort, the RMS change of the "
        "command from step to step, is"
    )
    efforts = {each.case.name: each.case.effort_mps for each in found}
    lines = [f"# {line}" for line in textwrap.wrap(says, 98)]
    lines += [f"# - {effort:g} m/s in the case {name}" for name, effort in efforts.items()]
    for each in found:
        sections: dict[str, Any] = {}
        set_keys(_keys_of(each), sections)
        lines += [
            "",
            f"# {each.says}",
            f"[{_inline(entry(each.contender, each.case))}]",
            f"title = {_inline(f'{each.contender.title}, at its best: {each.case.title}')}",
            f"extends = {_inline(each.case.plant)}",
            *(f"{section} = {_inline(keys)}" for section, keys in sections.items()),
        ]
    return "\n".join([*lines, ""])


def _keys_of(found: TunedWeights) -> dict[str, Any]:
    """Keys of a result for the file: the contender's own keys, and differences from the plant."""
    values = dict(flat(reading.to_table(found.scenario)))
    own = {f"control.{key}": values[f"control.{key}"] for key in found.contender.control}
    return own | differences(found.scenario, found.case.plant)


def _inline(value: Any) -> str:
    """Value as TOML on one line; JSON's numbers, texts and lists are valid TOML."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {_inline(each)}' for key, each in value.items())} }}"
    return json.dumps(value, ensure_ascii=False)


def differences(scenario: Scenario, plant: str) -> dict[str, Any]:
    """Dotted keys of a scenario's sections that differ from the plant, and their values."""
    own, plant_values = (
        dict(flat(reading.to_table(each))) for each in (scenario, reading.load(plant))
    )
    return {key: value for key, value in own.items() if "." in key and value != plant_values[key]}
