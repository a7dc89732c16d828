"""The contenders and cases of `skytether compare`, and the file of the weights that each flies at.

The best weights of a contender in a case are a table of that file, found by a search
(`search_start`, and `lab.calibration.Rmse`) on seeds that the comparison does not fly. Around them
the contender's threshold is moved, which gives a curve of what a packet buys.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from lab.keys import flat, lay
from lab.sweep import Axis, Sweep
from shared import config
from shared.config import ConfigError, Scenario

PLANT = "paper"
"""Name of the scenario whose vehicle, trajectory and network all contenders fly."""
SEARCH_SEED = 1001
"""First seed of a search; the seeds that are compared begin at the plant's own."""
PACKETS = 0.1
"""Largest share of steps that may send, for a contender whose trigger looks at the flight."""


@dataclass(frozen=True, slots=True)
class Contender:
    """A scheme with a trigger."""

    name: str
    """Short name, in tables, files and scenarios."""
    title: str
    """Name as a reader of the report sees it."""
    control: Mapping[str, Any]
    """Keys of `control` that make up the contender, with the weights its search starts from."""
    threshold: str = ""
    """Key of `control` that decides how many packets are sent; empty where there is none."""
    factors: Sequence[float] = ()
    """Multiples of the threshold found, each a point of the curve."""


NEAR = (1 / 8, 0.6, 0.8, 1, 5 / 4, 2, 8)
"""Factors of a quadratic threshold."""
PERIODS = (0.1, 0.2, 0.5, 1, 1.5, 2, 4)
"""Factors of a period of ten steps."""
PERIODIC = {"trigger": "periodic", "period": 10}
LOOSE = {
    "state_weight": [7.1, 3.0],
    "terminal_weight": [2000.0, 300.0],
    "input_weight": 0.1,
    "change_weight": 20.0,
}
"""Start of a search with the paper's scheme: near the best of 240 points drawn at random."""
EVENT = {"trigger": "state_gap", "epsilon": 30.0}
TIGHT = {
    "state_weight": [7.1, 1.0],
    "terminal_weight": [50.0, 20.0],
    "input_weight": 0.01,
    "change_weight": 0.01,
}
"""Start of a search with committed inputs, which need no S-term."""
COMMITTED = {"scheme": "committed", "observer_s": 2.0} | TIGHT
"""Committed inputs; the observer's time constant is searched for and may come out very long."""
GAP = COMMITTED | {"trigger": "cost_gap", "cost_gap": 2.0}
BUDGET = GAP | {"trigger": "cost_gap & budget(5, 2)"}
FEEDBACK = GAP | {"feedback": True}

CONTENDERS = (
    Contender("paper-every-step", "paper, every step", LOOSE | {"trigger": "always"}),
    Contender("paper-event", "paper, eq. (16)", LOOSE | EVENT, "epsilon", NEAR),
    Contender("paper-periodic", "paper, periodic", LOOSE | PERIODIC, "period", PERIODS),
    Contender("committed-every-step", "committed, every step", COMMITTED | {"trigger": "always"}),
    Contender("committed-periodic", "committed, periodic", COMMITTED | PERIODIC, "period", PERIODS),
    Contender("committed-gap", "committed, cost gap", GAP, "cost_gap", NEAR),
    Contender("committed-budget", "committed, cost gap, ≤ 5 packets/s", BUDGET, "cost_gap", NEAR),
    Contender(
        "feedback-gap", "committed with feedback aboard, cost gap", FEEDBACK, "cost_gap", NEAR
    ),
)


@dataclass(frozen=True, slots=True)
class Case:
    """What the vehicle meets and the server is not told."""

    name: str
    """Short name, in tables, files and scenarios."""
    title: str
    """Name as a reader of the report sees it."""
    keys: Mapping[str, Any]
    """Keys of the scenario, with dots, that differ from the plant's."""


GUSTS = {"vehicle.gust_mps2": 1.0, "vehicle.gust_every_s": 10.0, "vehicle.gust_s": 1.0}
CASES = (
    Case("quiet", "no wind", {}),
    Case("wind-0.1", "wind of 0.1 m/s per √s", {"vehicle.wind": 0.1}),
    Case("wind-0.3", "wind of 0.3 m/s per √s", {"vehicle.wind": 0.3}),
    Case("gusts", "gusts of 1 m/s², 1 s long, every 10 s", GUSTS),
    Case("tau-0.75", "true time constant × 0.75", {"vehicle.tau_s": [0.63]}),
    Case("tau-1.25", "true time constant × 1.25", {"vehicle.tau_s": [1.05]}),
)


@dataclass(frozen=True, slots=True)
class Scale:
    """How much a comparison flies; what is not given is as in those that are reported."""

    runs: int
    """Number of flights of each contender in each case at each threshold."""
    generations: int
    """Number of generations of a search."""
    population: int = 10
    """Number of points in a generation."""
    search_runs: int = 8
    """Number of flights of each point of a search."""
    search_duration: float = 32.5
    """Length of a flight of a search [s]."""
    cases: Sequence[Case] = CASES
    """Cases that are flown."""
    every: int = 1
    """Stride over a contender's factors; it meets the middle one, a factor of 1."""
    duration: float = 60.0
    """Length of a flight [s]."""


def quick(runs: int, generations: int) -> Scale:
    """Scale of a first look, with no more than is asked for."""
    return Scale(
        runs=min(runs, 3),
        generations=min(generations, 2),
        population=4,
        search_runs=2,
        search_duration=15.0,
        cases=CASES[:3:2],
        every=3,
        duration=15.0,
    )


# -- weights -------------------------------------------------------------------------------------


def search_start(contender: Contender, case: Case, scale: Scale) -> Scenario:
    """Scenario from which the search for a contender's weights in a case begins."""
    table = config.to_table(config.load(PLANT))
    lay({"duration": scale.search_duration, "seed": SEARCH_SEED}, table)
    lay({f"control.{key}": value for key, value in contender.control.items()}, table)
    lay(case.keys, table)
    return config.check(table, f"{contender.title}, {case.title}")


def entry(contender: Contender, case: Case) -> str:
    """Name of a contender in a case: of its table in the file of weights."""
    return f"{contender.name}-{case.name}"


@dataclass(frozen=True, slots=True)
class Found:
    """What the search for a contender's weights in a case has found."""

    contender: Contender
    case: Case
    scenario: Scenario
    """Scenario with the weights."""
    says: str
    """Error and share of packets on the seeds of the search, in a line."""


def to_file(found: Sequence[Found], scale: Scale) -> str:
    """The file of weights: a table for each contender in each case, with what differs from PLANT.

    Args:
        scale: what the searches took, which the file says.
    """
    lines = [
        "# Scenarios of each contender of `skytether compare` in each case, with the weights and",
        "# thresholds that `skytether compare --tune` has found for it in",
        f"# {scale.generations} generations of {scale.population} points,",
        f"# each flown with {scale.search_runs} seeds from {SEARCH_SEED} on.",
    ]
    for each in found:
        sections: dict[str, Any] = {}
        lay(differences(each.scenario), sections)
        lines += [
            "",
            f"# {each.says}",
            f"[{_inline(entry(each.contender, each.case))}]",
            f"title = {_inline(f'{each.contender.title}, at its best: {each.case.title}')}",
            f"extends = {_inline(PLANT)}",
            *(f"{section} = {_inline(keys)}" for section, keys in sections.items()),
        ]
    return "\n".join([*lines, ""])


def _inline(value: Any) -> str:
    """A value as TOML has it in a line; numbers, texts and lists are the same in JSON."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {_inline(each)}' for key, each in value.items())} }}"
    return json.dumps(value, ensure_ascii=False)


def differences(scenario: Scenario) -> dict[str, Any]:
    """Keys in the sections of a scenario that differ from PLANT's, with dots, and their values."""
    here, there = (dict(flat(config.to_table(each))) for each in (scenario, config.load(PLANT)))
    return {key: value for key, value in here.items() if "." in key and value != there[key]}


# -- what is flown -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Flying:
    """A contender in a case, at one threshold."""

    contender: Contender
    threshold: float | None
    """Value of the contender's threshold; None where it has none."""
    tuned: bool
    """Whether the threshold is the one that the search has found."""
    control: Mapping[str, Any]
    """Keys that differ from the plant's, with dots, and their values."""


def flying(contender: Contender, tuned: Scenario, scale: Scale) -> list[Flying]:
    """A contender at all thresholds of its curve, in rising order; one of them is tuned."""
    keys, key = differences(tuned), contender.threshold
    if not key:
        return [Flying(contender, None, True, keys)]
    here = getattr(tuned.control, key)
    values = {here * factor for factor in contender.factors[:: scale.every]}
    if isinstance(here, int):  # steps
        values = {max(1, round(value)) for value in values}
    return [
        Flying(contender, value, value == here, {**keys, f"control.{key}": value})
        for value in sorted(values)
    ]


class Plan:
    """What all contenders fly in one case.

    Args:
        weights: COMPARED, or the path of a file that `to_file` has made.

    Raises:
        ConfigError: the file cannot be read, or a contender is missing there, or wrong.
    """

    def __init__(self, case: Case, weights: str, scale: Scale) -> None:
        self.case = case
        self.flying: list[Flying] = []
        known = config.names(weights)
        for contender in CONTENDERS:
            name = entry(contender, case)
            if f"{weights}/{name}" not in known:
                there_is = "expected every contender in every case, as --tune writes them"
                raise ConfigError(f"{weights}: got no table {name!r}, {there_is}")
            self.flying += flying(contender, config.load(f"{weights}/{name}"), scale)
        values = tuple((each.contender.name, each.threshold) for each in self.flying)
        changes = tuple(each.control for each in self.flying)
        plant = msgspec.structs.replace(config.load(PLANT), duration=scale.duration)
        self.sweep = Sweep(case.name, plant, [Axis("contender", values, changes)], scale.runs)
