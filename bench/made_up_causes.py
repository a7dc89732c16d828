"""Flights in which one known thing is broken, and whether an explanation names it first.

`python -m bench.made_up_causes` draws scenario, seed and fault. Without the fault nothing goes
wrong in such a flight, and with it something does; other draws are drawn anew.
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, get_args

import msgspec
import numpy as np

from bench.explain import said, why
from bench.harness import Study, TextTable
from skytether.explain.cases import Bad, FlightCase, Setting, Stall, overridden
from skytether.explain.causes import CausePart
from skytether.explain.explanation import Explanation, explain
from skytether.explain.flying import CaseOutcome, fly
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys, value
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK
from skytether.shell.commandline import command

SCENARIOS = ("demo", "target", "paper", "5g-urban")
LINK = "uniform(0.05, 0.15)"


@dataclass(frozen=True)
class Fault:
    """What is broken, and the units of an explanation that are it."""

    says: str
    is_it: Callable[[CausePart], bool]
    keys: Mapping[str, Any] = field(default_factory=dict)
    stalls: tuple[Stall, ...] = ()
    scenario: str = ""
    """Scenario, if not one that is drawn."""


Drawn = np.random.Generator


def _between(rng: Drawn, low: float, high: float) -> float:
    return round(float(rng.uniform(low, high)), 1)


def _lost(way: int, path: int, at_s: float, for_s: float) -> Callable[[CausePart], bool]:
    """Whether a part is an outage that lies within this one for the most part."""

    def is_it(part: CausePart) -> bool:
        unit = part.unit
        if not isinstance(unit, Bad) or unit.lane[:2] != (path, way):
            return False
        first, end = unit.first * 1e-3, unit.end * 1e-3
        return min(end, at_s + for_s) - max(first, at_s) >= 0.8 * (end - first)

    return is_it


def _outage(rng: Drawn, way: int) -> Fault:
    at_s, for_s = _between(rng, 12, 22), _between(rng, 1.5, 4)
    name = ("uplink", "downlink")[way]
    keys = {f"network.{name}": f"outage({at_s}, {for_s})"}
    return Fault(f"{name} out {at_s} + {for_s} s", _lost(way, 0, at_s, for_s), keys)


def _cut(rng: Drawn) -> Fault:
    at_s = _between(rng, 12, 22)
    up, down = (_lost(way, 0, at_s, 1e3) for way in (UPLINK, DOWNLINK))
    keys = dict.fromkeys(("network.uplink", "network.downlink"), f"outage({at_s}, 1000)")
    return Fault(f"path cut at {at_s} s", lambda part: up(part) or down(part), keys)


def _cut_of_two(rng: Drawn) -> Fault:
    """Each of the two links is there for the other, until both are out."""
    at_s, for_s = _between(rng, 12, 18), _between(rng, 2, 4)
    later_s = round(at_s + _between(rng, 1, 4), 1)
    texts = f"{LINK} & outage({at_s}, 1000)", f"{LINK} & outage({later_s}, {for_s})"
    paths = [{"uplink": text, "downlink": text} for text in texts]
    stretches = (at_s, 1e3), (later_s, for_s)
    wanted = [
        _lost(way, path, *each) for path, each in enumerate(stretches) for way in (UPLINK, DOWNLINK)
    ]
    says = f"path 1 cut at {at_s} s, path 2 out {later_s} + {for_s} s"
    return Fault(
        says,
        lambda part: any(each(part) for each in wanted),
        {"network.paths": paths},
        scenario="demo-two-links",
    )


def _stall(rng: Drawn, process: Any, for_s: float) -> Fault:
    stall = Stall(process, _between(rng, 12, 22), for_s)
    says = f"{process} {'killed' if np.isinf(for_s) else f'stands still for {for_s} s'}"
    return Fault(f"{says} at {stall.at_s} s", lambda part: part.unit == stall, stalls=(stall,))


def _named(name: str) -> Callable[[CausePart], bool]:
    return lambda part: isinstance(part.unit, Setting) and part.unit.name.startswith(name)


def _setting(name: str, keys: Mapping[str, Any]) -> Fault:
    return Fault(", ".join(f"{key} = {own}" for key, own in keys.items()), _named(name), keys)


def _gain(rng: Drawn) -> Fault:
    gain = float(rng.choice([0.4, 0.5, 2.0, 2.5]))
    return _setting("a vehicle that differs", {"vehicle.gain": [gain]})


def _gust(rng: Drawn) -> Fault:
    keys = {
        "vehicle.gust_mps2": _between(rng, 1.5, 3),
        "vehicle.gust_every_s": 12.0,
    }
    return _setting("gusts", keys)


def _bias(rng: Drawn) -> Fault:
    bias = [_between(rng, 0.5, 1.5) for _ in range(2)]
    return _setting("errors of the sensors", {"sensor.position_bias_m": bias})


def _slow(rng: Drawn) -> Fault:
    compute_s = _between(rng, 0.5, 1.2)
    return _setting("the server's computing time", {"simulation.compute_s": compute_s})


WRONG: Sequence[tuple[str, Any]] = (
    ("link.timeout_s", 0.5),
    ("link.heartbeat_s", 1.4),
    ("control.horizon", 6),
    ("control.trigger", "periodic(60)"),
    ("control.feedback", False),
    ("control.observer_s", 0.1),
    ("vehicle.report", "periodic(40)"),
    ("vehicle.exhausted", "hold"),
)


def _wrong(rng: Drawn) -> Fault:
    key, own = WRONG[int(rng.integers(len(WRONG)))]
    return _setting(f"{key} =", {key: own})


KINDS: Mapping[str, Callable[[Drawn], Fault]] = {
    "outage of the uplink": lambda rng: _outage(rng, UPLINK),
    "outage of the downlink": lambda rng: _outage(rng, DOWNLINK),
    "path cut for good": _cut,
    "one of two paths cut, the other out": _cut_of_two,
    "client stands still": lambda rng: _stall(rng, "client", _between(rng, 1, 3)),
    "server stands still": lambda rng: _stall(rng, "server", _between(rng, 2, 4)),
    "server killed": lambda rng: _stall(rng, "server", np.inf),
    "wrong gain": _gain,
    "gusts": _gust,
    "wrong position": _bias,
    "slow server": _slow,
    "wrong key": _wrong,
}


HowNamed = Literal["alone", "first", "with others", "not"]
"""Whether the first set is the fault alone, begins with it, or one of both sets has it."""


class Cell(NamedTuple):
    kind: str
    number: int


class Named(msgspec.Struct, frozen=True):
    """What was broken, and what was said."""

    cell: Cell
    flight: str
    broken: str
    moment: str
    why: str
    named: HowNamed
    flights: int
    cpu_s: float


def broken(scenario: Scenario, fault: Fault) -> Scenario:
    """Scenario with a fault; impairments of a fault are added to those of the network."""
    table = reading.to_table(scenario)
    added = {
        key: f"{value(table, key)} & {own}"
        for key, own in fault.keys.items()
        if key in ("network.uplink", "network.downlink")
    }
    set_keys({**fault.keys, **added}, table)
    return reading.check(table, "bench", any_network=True)


def fly_cell(cell: Cell) -> Named:
    """Explanation of the first flight, of those drawn, in which the fault alone matters."""
    rng, flights = stream(63, "made up", cell.kind, cell.number), 0

    def fly_all(cases: Sequence[FlightCase]) -> list[CaseOutcome]:
        nonlocal flights
        flights += len(cases)
        return [fly(case) for case in cases]

    while True:
        fault, seed = KINDS[cell.kind](rng), int(rng.integers(1, 10_000))
        name = fault.scenario or SCENARIOS[int(rng.integers(len(SCENARIOS)))]
        scenario = msgspec.structs.replace(reading.load(name), seed=seed)
        if fault.scenario:  # both its links are well
            whole = Fault(
                "", fault.is_it, {"network.paths": [{"uplink": LINK, "downlink": LINK}] * 2}
            )
            scenario = broken(scenario, whole)
        calm = next(iter(explain(FlightCase(scenario), name, fly_all)))[1]
        try:
            wrong = broken(scenario, fault)
        except ConfigError:  # a key that this scenario cannot have
            continue
        case = FlightCase(wrong, stalls=fault.stalls, overridden=overridden(wrong, name))
        flights, began_s = 0, time.process_time()
        steps = explain(case, name, fly_all)
        if calm.moment is not None or next(steps)[1].moment is None:
            continue
        *_, (_, known) = steps
        spent_s = time.process_time() - began_s
        assert known.moment is not None
        says = fault.says, said(known.moment), why(known)
        return Named(cell, f"{name}, seed {seed}", *says, named(known, fault), flights, spent_s)


def named(known: Explanation, fault: Fault) -> HowNamed:
    cause = known.cause
    assert cause is not None
    found = [*map(fault.is_it, cause.parts)]
    if any(found[:1]):
        return "alone" if all(found) else "first"
    return "with others" if any([*found, *map(fault.is_it, cause.averting)]) else "not"


def cells(number: int) -> list[Cell]:
    return [Cell(kind, each) for kind in KINDS for each in range(1, number + 1)]


def tables(found: Sequence[Named]) -> dict[str, TextTable]:
    kinds = {kind: [each for each in found if each.cell.kind == kind] for kind in KINDS}
    rows = [_counts(kind, own) for kind, own in {**kinds, "all": found}.items()]
    heading = ["what is broken", "flights", *get_args(HowNamed), "CPU at most [s]"]
    each = [[one.flight, one.broken, one.moment, one.why, one.named] for one in found]
    return {
        "made-up causes": TextTable(heading, rows),
        "made-up causes, each": TextTable(["flight", "broken", "moment", "cause", "named"], each),
    }


def _counts(kind: str, found: Sequence[Named]) -> list[str]:
    counts = [sum(each.named == how for each in found) for how in get_args(HowNamed)]
    most_s = max((each.cpu_s for each in found), default=0.0)
    return [kind, str(len(found)), *map(str, counts), f"{most_s:.0f}"]


STUDY = Study(__doc__, cells, fly_cell, Named, tables, seeds=4)
document_tables = STUDY.document_tables

if __name__ == "__main__":
    sys.exit(command.main(STUDY.main, sys.argv[1:], "made-up causes"))
