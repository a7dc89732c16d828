"""What `skytether compare` flies: contenders in all cases, each at its own best weights.

The best weights of a contender in a case are those of its scenario in `scenarios/compare`, which a
search has found (`search_start`, and `lab.calibration.Rmse`), on seeds that are not flown here.
Around them its threshold is moved, so that there is a curve of what a packet buys.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from lab.sweep import Axis, Sweep, lay
from shared import config
from shared.config import ConfigError, Scenario

PLANT = "paper"
"""The scenario whose vehicle, trajectory and network all fly."""
SEARCH_SEED = 1001
"""The first of a search; those that are compared begin at the plant's."""
PACKETS = 0.1
"""Most steps that may send, as a share, where a trigger has a say in it."""


@dataclass(frozen=True, slots=True)
class Contender:
    """A scheme with a trigger."""

    name: str
    """Of its files."""
    title: str
    control: Mapping[str, Any]
    """Keys that make it what it is."""
    threshold: str = ""
    """The key of `control` that its packets depend on, if any,"""
    factors: Sequence[float] = ()
    """and what it is multiplied with for a curve."""


NEAR = (1 / 8, 0.6, 0.8, 1, 5 / 4, 2, 8)
"""Factors of a quadratic threshold."""
PERIODS = (0.1, 0.2, 0.5, 1, 1.5, 2, 4)
"""Factors of ten steps."""
PERIODIC = {"trigger": "periodic", "period": 10}
LOOSE = {
    "state_weight": [7.1, 3.0],
    "terminal_weight": [2000.0, 300.0],
    "input_weight": 0.1,
    "change_weight": 20.0,
}
"""Where searches begin with the paper's scheme: near the best of 240 points drawn at random."""
EVENT = {"trigger": "state_gap", "epsilon": 30.0}
TIGHT = {
    "state_weight": [7.1, 1.0],
    "terminal_weight": [50.0, 20.0],
    "input_weight": 0.01,
    "change_weight": 0.01,
}
"""And with committed inputs, which need no S-term."""
COMMITTED = {"scheme": "committed", "observer_s": 2.0} | TIGHT
"""How soon the observer learns is searched for, too, and may come out as hardly ever."""
GAP = COMMITTED | {"trigger": "cost_gap", "cost_gap": 2.0}

CONTENDERS = (
    Contender("paper-every-step", "paper, every step", LOOSE | {"trigger": "always"}),
    Contender("paper-event", "paper, eq. (16)", LOOSE | EVENT, "epsilon", NEAR),
    Contender("paper-periodic", "paper, periodic", LOOSE | PERIODIC, "period", PERIODS),
    Contender("committed-every-step", "committed, every step", COMMITTED | {"trigger": "always"}),
    Contender("committed-periodic", "committed, periodic", COMMITTED | PERIODIC, "period", PERIODS),
    Contender("committed-gap", "committed, cost gap", GAP, "cost_gap", NEAR),
    Contender(
        "committed-budget",
        "committed, cost gap, ≤ 5 packets/s",
        GAP | {"trigger": "cost_gap & budget(5, 2)"},
        *("cost_gap", NEAR),
    ),
    Contender(
        "feedback-gap",
        "committed with feedback aboard, cost gap",
        GAP | {"scheme": "feedback"},
        *("cost_gap", NEAR),
    ),
)


@dataclass(frozen=True, slots=True)
class Case:
    """What they fly in."""

    name: str
    title: str
    keys: Mapping[str, Any]


CASES = (
    Case("quiet", "no wind", {}),
    Case("wind-0.1", "wind of 0.1 m/s² per √s", {"vehicle.wind": 0.1}),
    Case("wind-0.3", "wind of 0.3 m/s² per √s", {"vehicle.wind": 0.3}),
    Case(
        "gusts",
        "gusts of 1 m/s², 1 s long, every 10 s",
        {"vehicle.gust_mps2": 1.0, "vehicle.gust_every_s": 10.0, "vehicle.gust_s": 1.0},
    ),
    Case("tau-0.75", "true time constant × 0.75", {"vehicle.tau_s": [0.63]}),
    Case("tau-1.25", "true time constant × 1.25", {"vehicle.tau_s": [1.05]}),
)


@dataclass(frozen=True, slots=True)
class Scale:
    """How much is flown."""

    runs: int
    """Of each contender, case and threshold."""
    cases: Sequence[Case]
    every: int
    """Which of the factors are flown: each so-manieth, the middle one among them."""
    duration: float
    """Of a flight [s]."""
    search_runs: int
    """Of each point of a search,"""
    search_duration: float
    """and how long they are [s]."""
    generations: int
    """Of a search."""
    population: int


def full(runs: int, generations: int) -> Scale:
    """For print."""
    return Scale(runs, CASES, 1, 60.0, 8, 32.5, generations, 10)


def quick(runs: int, generations: int) -> Scale:
    """For a first look."""
    return Scale(min(runs, 3), CASES[:3:2], 3, 15.0, 2, 15.0, min(generations, 2), 4)


# -- what is flown -------------------------------------------------------------------------------


def search_start(contender: Contender, case: Case, scale: Scale) -> Scenario:
    """Where the search for a contender's weights begins."""
    table = config.to_table(config.load(PLANT))
    lay({"duration": scale.search_duration, "seed": SEARCH_SEED}, table)
    lay({f"control.{key}": value for key, value in contender.control.items()}, table)
    lay(case.keys, table)
    return config.check(table, f"{contender.title}, {case.title}")


def file_name(contender: Contender, case: Case) -> str:
    """Of the scenario with its weights."""
    return f"{contender.name}-{case.name}.toml"


def to_file(contender: Contender, case: Case, found: Scenario, how: str) -> bytes:
    """The scenario with what a search has found, as a file that says but what differs.

    Args:
        how: it was found, in a line.
    """
    title = f"{contender.title}, at its best: {case.title}"
    lines = [f"# {how}", f'title = "{title}"', f'extends = "{PLANT}"']
    table: dict[str, Any] = {}
    lay(differences(found), table)
    for section, keys in table.items():
        # A number, a text and a list of numbers look the same in JSON and TOML.
        values = [f"{key} = {json.dumps(value)}" for key, value in keys.items()]
        lines += ["", f"[{section}]", *values]
    return "\n".join([*lines, ""]).encode()


def differences(scenario: Scenario) -> dict[str, Any]:
    """The keys in sections that are not the plant's, with dots."""
    here, there = (config.to_table(each) for each in (scenario, config.load(PLANT)))
    return {
        f"{section}.{path}": value
        for section, keys in here.items()
        if isinstance(keys, dict)
        for path, value in _leaves(keys)
        if value != dict(_leaves(there[section]))[path]
    }


def _leaves(table: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{path}", leaf) for path, leaf in _leaves(value))
        else:
            yield key, value


@dataclass(frozen=True, slots=True)
class Flying:
    """A contender in a case, at one threshold."""

    contender: Contender
    threshold: float | None
    tuned: bool
    """Whether the threshold is that of its scenario."""
    control: Mapping[str, Any]
    """What differs from the plant, by keys with dots."""


def flying(contender: Contender, tuned: Scenario, scale: Scale) -> list[Flying]:
    """A contender at all its thresholds, of which one is tuned."""
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


def _load(file: Path) -> Scenario:
    if not file.exists():
        raise ConfigError(f"{file}: there is none; `skytether compare --tune` makes it")
    return config.load(str(file))


class Plan:
    """All contenders in one case.

    Args:
        folder: of the scenarios with their weights.

    Raises:
        ConfigError: one is missing, or wrong.
    """

    def __init__(self, case: Case, folder: Path, scale: Scale) -> None:
        self.case = case
        self.flying = [
            each
            for contender in CONTENDERS
            for each in flying(contender, _load(folder / file_name(contender, case)), scale)
        ]
        values = tuple((each.contender.name, each.threshold) for each in self.flying)
        changes = tuple(each.control for each in self.flying)
        plant = msgspec.structs.replace(config.load(PLANT), duration=scale.duration)
        self.sweep = Sweep(case.name, plant, [Axis("contender", values, changes)], scale.runs)
