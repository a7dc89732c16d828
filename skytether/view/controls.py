"""Numbers that may be changed in flight, described as the sliders of a page.

Each has a name, a range, and functions to read it from, and write it to, the keys that a process
lets change (docs/operating.md). Nothing is checked here: the processes check changes as they check
a scenario.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from skytether.shared.scenario import policies, registry
from skytether.shared.scenario.policies import PolicyError
from skytether.shared.scenario.schema import DirectionConfig
from skytether.shared.scenario.schemes import properties

Values = Mapping[str, Any]
"""Values by key."""
Read = Callable[[Values], float]
Write = Callable[[Values, float], dict[str, Any]]
WAYS = ("network.uplink", "network.downlink")
"""Both directions of the network."""
ALL_LOST = " & loss(1)"
"""Text appended to a direction's impairments to lose every packet."""
MODES_OF_DELAY = {"none": "constant"}
"""Delay law that replaces the present one where packets are to be delayed."""


@dataclass(frozen=True, slots=True)
class Knob:
    """Number that can be changed."""

    label: str
    hint: str
    process: str
    """Process that owns the keys: server, netem or client."""
    key: str
    """Key that must be changeable for the number to be offered."""
    low: float
    high: float
    """Upper end of the slider; raised if the present value is higher."""
    step: float
    read: Read
    """Function that reads the number from the process's values."""
    write: Write
    """Function that returns the changed keys and values, given the present values."""


def texts(values: Values) -> dict[str, str]:
    """Network directions as texts, by key; empty where they may not change."""
    return {way: _direction(values, way).text for way in WAYS if f"{way}.impairments" in values}


def is_written(values: Values) -> bool:
    """Whether a direction is written as a text, which sliders cannot change."""
    return any(values.get(f"{way}.impairments") for way in WAYS)


def cut(values: Values) -> dict[str, Any]:
    """Changes that lose every packet from now on."""
    changed: dict[str, Any] = {}
    for way in WAYS:
        text = values.get(f"{way}.impairments")
        changed |= {f"{way}.impairments": text + ALL_LOST} if text else {f"{way}.loss": 1.0}
    return changed


def is_cut(values: Values) -> bool:
    """Whether every packet is lost, as after `cut`."""
    return bool(values) and all(
        values[f"{way}.loss"] == 1.0 or values[f"{way}.impairments"].endswith(ALL_LOST)
        for way in WAYS
    )


def healed(values: Values) -> dict[str, Any]:
    """Changes that undo `cut`."""
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
    """Slider for a key of both directions, which may differ until changed; shown in another
    unit.
    """
    return (
        lambda values: scale * max(float(values[f"{way}.{name}"]) for way in WAYS),
        lambda _, number: {f"{way}.{name}": number / scale for way in WAYS},
    )


def _delay(values: Values, number: float) -> dict[str, Any]:
    """Changes that delay packets by at least so much [ms], also where there was no delay."""
    laws = {f"{way}.delay": MODES_OF_DELAY.get(values[f"{way}.delay"]) for way in WAYS}
    least: dict[str, Any] = {f"{way}.minimum_s": number / 1e3 for way in WAYS}
    return least | {key: law for key, law in laws.items() if law and number}


def _component(key: str, axis: int, axes: int) -> tuple[Read, Write]:
    """Component of a list with one number per axis, or of an empty list."""

    def write(values: Values, number: float) -> dict[str, Any]:
        numbers = list(values[key]) or [0.0] * axes
        numbers[axis] = number
        return {key: numbers}

    return lambda values: float(values[key][axis]) if values[key] else 0.0, write


def _compared(label: str, hint: str, name: str, high: float, step: float) -> Knob:
    key = f"control.{name}"
    return Knob(label, hint, "server", key, 0.0, high, step, *_own(key))


def knobs(axes: int) -> tuple[Knob, ...]:
    """Sliders for vehicles with so many axes that do not depend on the trigger."""
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
"""Sliders for the thresholds of triggers, each offered where the present trigger compares it."""

TRIGGERS = (
    "always",
    "periodic",
    "cost_gap | silence(1)",
    "expected_gap | silence(1)",
    "deviation | silence(1)",
    "state_gap",
)
"""Triggers offered to the user, where the scheme computes what they compare."""


def triggers(scheme: str, present: str) -> tuple[str, ...]:
    """Triggers offered with a scheme, including the present one."""

    def has(trigger: str) -> bool:
        names = (each.name for each in policies.policies(policies.parse(trigger)))
        needs = (registry.TRIGGERS[name].needs for name in names)
        return all(not each or each in properties(scheme).computes for each in needs)

    offered = tuple(each for each in TRIGGERS if has(each))
    return offered if present in offered else (present, *offered)


def compared(trigger: str) -> frozenset[str]:
    """Keys of the thresholds that a trigger uses and does not itself state."""
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
