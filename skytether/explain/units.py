"""Units that can be removed from a flight to find a cause; flights with or without some of them.

The fate of a packet is known for every millisecond of each lane, whether or not a packet was sent,
so outages without packets are found, too. In stretches shorter than OUTAGE_MS, each lost or late
packet is a unit.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations

import msgspec
import numpy as np

from skytether.explain.cases import (
    Bad,
    FlightCase,
    Keys,
    Lane,
    Setting,
    Stretch,
    Unit,
    Unmet,
    UsualDelay,
)
from skytether.explain.flying import CaseOutcome
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import dotted, reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK

OUTAGE_MS = 50
"""Shortest stretch without a good slot that counts as an outage [ms]. Independent losses with
probability 0.6 last that long once in 10¹¹ slots."""
STRIDE_MS = OUTAGE_MS // 2
"""Interval between slots that are tested for outages [ms]."""
SPREAD = 3.0
"""A packet is late if its delay exceeds the median delay by more than this multiple of the distance
from the median to the upper quartile."""

KEYS_MAX = 5
"""Largest number of overridden keys that are separate units, as every combination is checked."""

WIND, COMPUTING = "wind", "the server's computing time"
SETTINGS: Sequence[tuple[str, Keys]] = (
    ("gusts", (("vehicle.gust_mps2", 0.0),)),
    (
        "errors of the sensors",
        (
            ("sensor.position_noise_m", 0.0),
            ("sensor.velocity_noise_mps", 0.0),
            ("sensor.position_bias_m", ()),
            ("sensor.velocity_bias_mps", ()),
            ("sensor.delay_s", 0.0),
            ("reference.noise_m", 0.0),
        ),
    ),
    (
        "a vehicle that differs from its model",
        (("vehicle.tau_s", ()), ("vehicle.gain", ()), ("vehicle.dead_time_s", ())),
    ),
    (COMPUTING, (("simulation.compute_s", 0.001),)),
    (
        WIND,
        (
            ("vehicle.wind", 0.0),
            ("vehicle.steady_wind_mps", ()),
            ("vehicle.turbulence_mps", 0.0),
        ),
    ),
)
"""Properties of vehicle, wind and server, each with the values of keys that remove it. Wind is
last, because most flights have it."""
DOUBLED = "doubled(1)"
"""Kind of the vehicle that replaces a real vehicle, see `doubled`."""
PUSH = Setting("wind and errors of the model", (("vehicle.kind", "doubled(0)"),))


def perfect(case: FlightCase) -> FlightCase:
    """Case in which every packet arrives without delay and nothing else is wrong; the wind is that
    of the flight, without gusts.
    """
    network, none = case.scenario.network, {"uplink": "none", "downlink": "none"}
    paths = tuple(msgspec.structs.replace(each, **none) for each in network.paths)
    network = msgspec.structs.replace(network, **none, paths=paths)
    settings = [each.keys for each in _settings(case) if each.name != WIND]
    return replace(
        case,
        scenario=msgspec.structs.replace(case.scenario, network=network),
        keys=tuple(key for keys in settings for key in keys),
        stalls=(),
        commands=(),
    )


@dataclass(frozen=True, slots=True)
class Circumstances:
    """Explained flight, and the units that may be removed from it."""

    case: FlightCase
    units: tuple[Unit, ...]
    """Units in an order in which related units are neighbours."""
    window: tuple[Stretch, ...]
    """Stretch of each lane in which units may be removed; outside it the network stays the same."""
    usual_s: dict[tuple[int, int], float]
    """Longest usual delay of a path and direction [s]."""

    def without(self, *taken: Unit) -> FlightCase:
        """Case of the flight without these units, or without parts of them."""
        directions = {each.direction for each in taken if isinstance(each, UsualDelay)}
        if Unmet() in taken:
            directions = {UPLINK, DOWNLINK}
        bad = [each for each in taken if isinstance(each, Bad) and each.lane[1] not in directions]
        left = [each for each in self.units if isinstance(each, Bad) and each not in taken]
        between = (_between(each, left) for each in self.window if each.lane[1] in directions)
        delivered = tuple(
            (each, 0.0 if UsualDelay(each.lane[1]) in taken else self.usual_s[each.lane[:2]])
            for each in (*bad, *chain.from_iterable(between))
        )
        keys = tuple(key for each in taken if isinstance(each, Setting) for key in each.keys)
        own = self.case
        return replace(
            own,
            delivered=delivered,
            keys=keys,
            stalls=tuple(each for each in own.stalls if each not in taken),
            commands=tuple(each for each in own.commands if each not in taken),
        )

    def only(self, kept: Collection[Unit]) -> FlightCase:
        """Case of the flight with these units only; other packets in the window are delivered."""
        return self.without(*(each for each in self.units if each not in kept))


def _between(stretch: Stretch, bad: Collection[Bad]) -> Iterator[Stretch]:
    """Parts of a stretch that lie outside the bad stretches."""
    first = stretch.first
    for each in sorted(bad, key=lambda each: each.first):
        if each.lane == stretch.lane and each.end > first and each.first < stretch.end:
            if each.first > first:
                yield Stretch(stretch.lane, first, each.first)
            first = each.end
    if first < stretch.end:
        yield Stretch(stretch.lane, first, stretch.end)


def circumstances(
    case: FlightCase, flown: CaseOutcome, start_s: float, end_s: float, *, with_delay: bool = False
) -> Circumstances:
    """Circumstances of a flight, with its units between two times of flight [s].

    Args:
        with_delay: whether the usual delay of each direction is a unit as well.
    """
    usual_s: dict[tuple[int, int], float] = {}
    window, bad = [], list[Unit]()
    for lane, began_s in sorted(flown.began_s.items(), key=lambda item: _order(item[0])):
        first, end = (max(0, round((at_s - began_s) * 1e3)) for at_s in (start_s, end_s))
        stretch = Stretch(lane, first, end)
        usual_s.setdefault(lane[:2], _usual_s(flown, lane))
        window.append(stretch)
        bad += _bad(case, flown, stretch, usual_s[lane[:2]])
    settings = [*_settings(case)]
    if case.scenario.vehicle.kind == DOUBLED:
        settings.append(PUSH)
    delays = [UsualDelay(direction) for direction in (1, 0)] if with_delay else []
    found = *settings, *delays, Unmet(), *case.stalls, *case.commands, *bad
    return Circumstances(case, found, tuple(window), usual_s)


def _order(lane: Lane) -> tuple[int, int, int]:
    """Sort key of lanes: downlinks first, because they matter less, then uplinks."""
    path, direction, flow = lane
    return -direction, flow, path


def _usual_s(flown: CaseOutcome, lane: Lane) -> float:
    """Longest delay of a packet that is not late [s]."""
    packets = flown.packets
    same = np.array([each[:2] == lane[:2] for each in packets.lane], dtype=bool)
    delays_s = packets.delay_s[same & ~packets.lost]
    if not len(delays_s):
        return 0.0
    half, upper = np.quantile(delays_s, (0.5, 0.75))
    return float(half + SPREAD * (upper - half))


def _settings(case: FlightCase) -> Iterator[Setting]:
    """Units for a scenario's overridden keys, and for the SETTINGS that the scenario has."""
    listed = {key for _, keys in SETTINGS for key, _ in keys}
    keys = tuple(each for each in case.overridden if each[0] not in listed)
    some = [each for count in range(1, len(keys)) for each in combinations(keys, count)]
    is_each = len(keys) <= KEYS_MAX and all(map(partial(is_possible, case), some))
    for each in [(key,) for key in keys] if is_each else [keys]:  # else all keys form one unit
        if keys and is_possible(case, keys):
            table = reading.to_table(case.scenario)
            names = (f"{key} = {dotted.value(table, key)}" for key, _ in each)
            yield Setting(", ".join(names), each)
    yield from (Setting(*each) for each in SETTINGS if _is_there(case.scenario, each[1]))


def is_possible(case: FlightCase, keys: Keys) -> bool:
    """Whether a case can be flown with these keys."""
    try:
        replace(case, keys=keys).flown()
    except ConfigError:
        return False
    return True


def _is_there(scenario: Scenario, keys: Keys) -> bool:
    """Whether the scenario's value of one of the keys is another list, or a larger number."""
    for key, value in keys:
        section, _, name = key.partition(".")
        own = getattr(getattr(scenario, section), name)
        if own != value and (isinstance(value, tuple) or own > value):
            return True
    return False


def _bad(case: FlightCase, flown: CaseOutcome, within: Stretch, usual_s: float) -> Iterator[Bad]:
    """Outages within a stretch, and single lost or late packets outside them, sorted by time."""
    fates, usual_ns = case.fates(within.lane), round(usual_s * 1e9)

    def is_bad(slot: int) -> bool:
        fate = fates.at(slot)
        return fate.lost or fate.flipped is not None or fate.delay_ns > usual_ns

    found: list[Bad] = []
    at = within.first
    while at < within.end:
        if is_bad(at):
            first = end = at
            while first > 0 and is_bad(first - 1):
                first -= 1
            while is_bad(end) and end < within.end:
                end += 1
            if end - first >= OUTAGE_MS:
                is_late = not any(fates.at(slot).lost for slot in range(first, end, STRIDE_MS))
                found.append(Bad(within.lane, first, end, is_late))
            at = end
        at += STRIDE_MS
    packets = flown.packets
    for number in np.flatnonzero(packets.lost | (packets.delay_s > usual_s)).tolist():
        slot = int(packets.slot[number])
        is_here = packets.lane[number] == within.lane and within.first <= slot < within.end
        if is_here and not any(each.first <= slot < each.end for each in found):
            is_late = not bool(packets.lost[number])
            found.append(Bad(within.lane, slot, slot + 1, is_late, is_packet=True))
    yield from sorted(found, key=lambda each: each.first)
