"""Numbers that may be changed in flight, described as sliders of a page.

Each has a name, a range, and functions that read it from, and write it to, the keys that a process
lets change (docs/operating.md). Nothing is checked here: the processes check changes as they check
a scenario.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from skytether.shared.scenario import dotted, registry
from skytether.shared.scenario.grammar import GrammarError, leaves
from skytether.shared.scenario.schemes import properties

Values = Mapping[str, Any]
Read = Callable[[Values], float | None]
Write = Callable[[Values, float], dict[str, Any]]
WAYS = ("network.uplink", "network.downlink")
"""Keys of both network directions."""
ALL_LOST = " & loss(1)"
"""Text appended to a direction's impairments to lose every packet."""
LOST = ("loss(1)", "loss(1.0)")
"""Suffixes of impairments that lose every packet."""


@dataclass(frozen=True, slots=True)
class Knob:
    """Slider for a number that can be changed in flight."""

    label: str
    hint: str
    process: str
    """Process that owns the keys: server, netem or client."""
    low: float
    high: float
    """Upper end of the slider; raised if the present value is higher."""
    step: float
    read: Read
    """Function that reads the number from the process's values; None if there is no such number."""
    write: Write
    """Function that returns the changed keys and values, given the present values."""


def texts(values: Values) -> dict[str, str]:
    return {way: values[way] for way in WAYS if way in values}


def cut(values: Values) -> dict[str, Any]:
    return {way: f"{text}{ALL_LOST}" if text else LOST[0] for way, text in texts(values).items()}


def is_cut(values: Values) -> bool:
    """Whether every packet is lost, as after `cut`."""
    return bool(values) and all(values[way].endswith(LOST) for way in WAYS)


def healed(values: Values) -> dict[str, Any]:
    changed = {way: text.removesuffix(ALL_LOST) for way, text in texts(values).items()}
    return {
        way: _with(way, text, "loss", 0.0) if text.endswith(LOST) else text
        for way, text in changed.items()
    }


def _with(key: str, text: str, at: str, number: float) -> str:
    return dotted.TEXTS[key].with_argument(text, at, number)


def _number(values: Values, key: str, at: str) -> float | None:
    try:
        return float(dotted.TEXTS[key].argument(values[key], at))
    except (KeyError, GrammarError):
        return None


def _own(key: str) -> tuple[Read, Write]:
    return lambda values: values.get(key), lambda _, number: {key: number}


def _ways(names: tuple[str, ...], scale: float) -> tuple[Read, Write]:
    """Slider for the first argument of an impairment in both directions, in another unit.

    Args:
        names: impairments; the one that a direction has is changed.
        scale: factor from the argument to the slider's number.
    """

    def known(values: Values) -> dict[str, tuple[str, float]]:
        numbers = ((way, name, _number(values, way, name)) for way in WAYS for name in names)
        return {way: (name, number) for way, name, number in numbers if number is not None}

    def read(values: Values) -> float | None:
        found = known(values)
        return scale * max(number for _, number in found.values()) if found else None

    def write(values: Values, number: float) -> dict[str, Any]:
        found = known(values).items()
        return {way: _with(way, values[way], name, number / scale) for way, (name, _) in found}

    return read, write


def _component(key: str, axis: int, axes: int) -> tuple[Read, Write]:
    """Component of a list with one number per axis, or of an empty list."""

    def write(values: Values, number: float) -> dict[str, Any]:
        numbers = list(values[key]) or [0.0] * axes
        numbers[axis] = number
        return {key: numbers}

    def read(values: Values) -> float | None:
        return None if key not in values else float(values[key][axis]) if values[key] else 0.0

    return read, write


def _compared(label: str, hint: str, at: str, high: float, step: float) -> Knob:
    key = "control.trigger"

    def write(values: Values, number: float) -> dict[str, Any]:
        return {key: _with(key, values[key], at, number)}

    return Knob(label, hint, "server", 0.0, high, step, lambda each: _number(each, key, at), write)


def knobs(axes: int) -> tuple[Knob, ...]:
    wind, steady = "vehicle.wind", "vehicle.steady_wind_mps"
    lossy = "Share of packets that are lost, both ways"
    least = "Smallest delay of a packet, each way"
    white = "Strength of white acceleration"
    along = "Velocity of the steady wind"
    return (
        Knob("Loss [%]", lossy, "netem", 0.0, 100.0, 1.0, *_ways(("loss",), 100.0)),
        Knob("Delay [ms]", least, "netem", 0.0, 1500.0, 10.0, *_ways(("paper", "constant"), 1e3)),
        Knob("Wind [m/s per √s]", white, "client", 0.0, 1.0, 0.01, *_own(wind)),
        *(
            Knob(
                f"Steady wind {name} [m/s]",
                along,
                "client",
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
    _compared(
        "Threshold: expected gap",
        "Expected extra cost above which a plan is sent",
        "expected_gap",
        20,
        0.05,
    ),
    _compared("Threshold: ε", "Tolerance of eq. (16)", "state_gap.epsilon", 20, 0.1),
    _compared("Threshold: decay λ [1/s]", "Decay rate of (16)", "state_gap.decay_rate", 10, 0.1),
    _compared(
        "Threshold: deviation [m]",
        "Distance from the plan above which one is sent",
        "deviation",
        1,
        0.01,
    ),
    Knob(
        "Rate: steps from packet to packet",
        "Number of steps from one packet to the next",
        "server",
        1.0,
        100.0,
        1.0,
        lambda values: _number(values, "control.trigger", "periodic"),
        lambda values, number: {
            "control.trigger": _with(
                "control.trigger", values["control.trigger"], "periodic", round(number)
            )
        },
    ),
)
"""Sliders for the thresholds of triggers, each shown if the present trigger compares it."""

TRIGGERS = (
    "always",
    "periodic",
    "cost_gap | silence(1)",
    "expected_gap | silence(1)",
    "deviation | silence(1)",
    "state_gap",
)
"""Triggers offered to the user, if the scheme computes the figures that they compare."""


def triggers(scheme: str, present: str) -> tuple[str, ...]:
    """Triggers offered with a scheme, including the present one."""

    def has(trigger: str) -> bool:
        names = (each.name for each in leaves(registry.TRIGGERS.parse(trigger)))
        needs = (registry.TRIGGERS[name].needs for name in names)
        return all(not each or each in properties(scheme).computes for each in needs)

    offered = tuple(each for each in TRIGGERS if has(each))
    return offered if present in offered else (present, *offered)
