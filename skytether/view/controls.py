"""What may be changed while it flies, as the sliders of a page.

Each is a name, a range, and how it reads and makes the values of keys that the processes let
change (docs/control.md). Nothing here is checked: the processes do that, as they do a scenario.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from skytether.shared.scenario import policies, registry
from skytether.shared.scenario.policies import PolicyError
from skytether.shared.scenario.schema import DirectionConfig

Values = Mapping[str, Any]
"""Values by key."""
Read = Callable[[Values], float]
Write = Callable[[Values, float], dict[str, Any]]
WAYS = ("network.uplink", "network.downlink")
"""Both directions of the network."""
ALL_LOST = " & loss(1)"
"""What cuts a direction that is written as a text."""
MODES_OF_DELAY = {"none": "constant"}
"""Law of the delay that packets get once they are to be delayed, by the law that they had."""


@dataclass(frozen=True, slots=True)
class Knob:
    """A number that can be changed."""

    label: str
    hint: str
    process: str
    """Process that has its keys: server, netem or client."""
    key: str
    """Key that the process lets change where the number can be changed."""
    low: float
    high: float
    """Largest value that is offered; more only where it is more already."""
    step: float
    read: Read
    """Number that values of the process have."""
    write: Write
    """Values by key that make it another, of the values before."""


def texts(values: Values) -> dict[str, str]:
    """Directions of the network as texts, by key of the direction; none where none may change."""
    return {way: _direction(values, way).text for way in WAYS if f"{way}.impairments" in values}


def is_written(values: Values) -> bool:
    """Whether a direction is written as a text, which has no numbers to slide."""
    return any(values.get(f"{way}.impairments") for way in WAYS)


def cut(values: Values) -> dict[str, Any]:
    """Values that lose every packet from now on."""
    changed: dict[str, Any] = {}
    for way in WAYS:
        text = values.get(f"{way}.impairments")
        changed |= {f"{way}.impairments": text + ALL_LOST} if text else {f"{way}.loss": 1.0}
    return changed


def is_cut(values: Values) -> bool:
    """Whether every packet is lost, as `cut` makes it."""
    return bool(values) and all(
        values[f"{way}.loss"] == 1.0 or values[f"{way}.impairments"].endswith(ALL_LOST)
        for way in WAYS
    )


def healed(values: Values) -> dict[str, Any]:
    """Values with which a link that is cut loses no packets for that."""
    changed: dict[str, Any] = {}
    for way in WAYS:
        text = values[f"{way}.impairments"].removesuffix(ALL_LOST)
        changed |= {f"{way}.impairments": text} if text else {f"{way}.loss": 0.0}
    return changed


def _direction(values: Values, way: str) -> DirectionConfig:
    keys = {key.removeprefix(f"{way}."): value for key, value in values.items()}
    return msgspec.convert(
        {name: keys[name] for name in DirectionConfig.__struct_fields__}, DirectionConfig
    )


def _own(key: str) -> tuple[Read, Write]:
    return lambda values: float(values[key]), lambda _, number: {key: number}


def _ways(name: str, scale: float) -> tuple[Read, Write]:
    """A key of both directions, which may differ until it is changed; shown in another unit."""
    return (
        lambda values: scale * max(float(values[f"{way}.{name}"]) for way in WAYS),
        lambda _, number: {f"{way}.{name}": number / scale for way in WAYS},
    )


def _delay(values: Values, number: float) -> dict[str, Any]:
    """Values that delay packets by so much [ms] at least, where they were not delayed either."""
    laws = {f"{way}.delay": MODES_OF_DELAY.get(values[f"{way}.delay"]) for way in WAYS}
    least: dict[str, Any] = {f"{way}.minimum_s": number / 1e3 for way in WAYS}
    return least | {key: law for key, law in laws.items() if law and number}


def _component(key: str, axis: int, axes: int) -> tuple[Read, Write]:
    """A number of a list that has one for each axis, or none at all."""

    def write(values: Values, number: float) -> dict[str, Any]:
        numbers = list(values[key]) or [0.0] * axes
        numbers[axis] = number
        return {key: numbers}

    return lambda values: float(values[key][axis]) if values[key] else 0.0, write


def _compared(label: str, hint: str, name: str, high: float, step: float) -> Knob:
    key = f"control.{name}"
    return Knob(label, hint, "server", key, 0.0, high, step, *_own(key))


def knobs(axes: int) -> tuple[Knob, ...]:
    """Numbers that can always be changed, of vehicles with so many axes."""
    up, air = "network.uplink", "vehicle"
    wind, steady = f"{air}.wind", f"{air}.steady_wind_mps"
    lossy = "Share of packets that are lost, both ways"
    least = "Smallest delay of a packet, each way"
    white = "Strength of white acceleration"
    along = "Velocity that steady wind adds in the long run"
    return (
        Knob("Loss [%]", lossy, "netem", f"{up}.loss", 0.0, 100.0, 1.0, *_ways("loss", 100.0)),
        Knob(
            "Delay [ms]",
            least,
            "netem",
            f"{up}.minimum_s",
            0.0,
            1500.0,
            10.0,
            _ways("minimum_s", 1e3)[0],
            _delay,
        ),
        Knob("Wind [m/s per √s]", white, "client", wind, 0.0, 1.0, 0.01, *_own(wind)),
        *(
            Knob(
                f"Steady wind {name} [m/s]",
                along,
                "client",
                steady,
                -1.0,
                1.0,
                0.02,
                *_component(steady, axis, axes),
            )
            for axis, name in enumerate("xyz"[:axes])
        ),
    )


THRESHOLDS = (
    _compared("Threshold: cost gap", "Extra cost above which a plan is sent", "cost_gap", 20, 0.05),
    _compared("Threshold: ε", "Tolerance of eq. (16)", "epsilon", 20, 0.1),
    _compared("Threshold: decay λ [1/s]", "Decay rate of eq. (16)", "decay_rate", 10, 0.1),
    _compared(
        "Threshold: deviation [m]",
        "Distance from the plan above which one is sent",
        "deviation_m",
        1,
        0.01,
    ),
    Knob(
        "Rate: steps from packet to packet",
        "One packet every so many steps",
        "server",
        "control.period",
        1.0,
        100.0,
        1.0,
        _own("control.period")[0],
        lambda _, number: {"control.period": round(number)},
    ),
)
"""Numbers that policies compare with: each is shown where the trigger has it."""

TRIGGERS = (
    "always",
    "periodic",
    "cost_gap | silence(1)",
    "expected_gap | silence(1)",
    "deviation | silence(1)",
    "state_gap",
)
"""Triggers that are offered, where the scheme has what they compare."""


def triggers(scheme: str, present: str) -> tuple[str, ...]:
    """Triggers to choose from with a scheme, the present one among them."""

    def has(trigger: str) -> bool:
        names = (each.name for each in policies.policies(policies.parse(trigger)))
        return all(scheme in (registry.TRIGGERS[name].schemes or (scheme,)) for name in names)

    offered = tuple(each for each in TRIGGERS if has(each))
    return offered if present in offered else (present, *offered)


def compared(trigger: str) -> frozenset[str]:
    """Keys of the numbers that a trigger compares with, as far as they do not stand in it."""
    try:
        found = tuple(policies.policies(policies.parse(trigger)))
    except PolicyError:
        return frozenset()
    return frozenset(
        f"control.{parameter.key}"
        for each in found
        if not each.values
        for parameter in registry.TRIGGERS[each.name].parameters
        if parameter.key
    )
