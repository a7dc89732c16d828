"""Numbers that may be changed in flight, described as sliders of a page.

Each slider has a name, a range, and functions that read and write changeable keys of a process
(docs/operating.md). Values are not checked here: the processes check changes like a scenario.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from skytether.shared.scenario import arguments, dotted, registry, rooms
from skytether.shared.scenario.grammar import GrammarError, leaves
from skytether.shared.scenario.schemes import properties

Values = Mapping[str, Any]
Read = Callable[[Values], float | None]
Write = Callable[[Values, float], dict[str, Any]]
WAYS = ("network.uplink", "network.downlink")
"""Keys of the impairments of both directions."""
ALL_LOST = " & loss(1)"
"""Text appended to a direction's impairments to lose every packet."""
LOST = ("loss(1)", "loss(1.0)")
"""Suffixes of impairments that lose every packet."""


@dataclass(frozen=True, slots=True)
class Knob:
    """Slider for a number that can be changed in flight."""

    name: str
    unit: str
    """Unit of the number; empty if it has none."""
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
    """Function that returns the changed keys and values, given the present values. A key names only
    the changed argument, such as `network.uplink.loss`: the process keeps the rest of the text.
    """

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def with_unit(self, numbers: str) -> str:
        return f"{self.name}: {numbers} {self.unit}".rstrip()


def applied(values: Values, changed: Values) -> dict[str, Any]:
    """Values after a change of some keys, or of arguments in their texts."""
    after = dict(values)
    for key, value in changed.items():
        text = dotted.text_key(key)
        after[text] = value if key == text else _with(text, after[text], key, value)
    return after


def argument(values: Values, key: str) -> Any:
    """Value of a key, or of an argument in its text.

    Raises:
        KeyError, GrammarError: there is no such value.
    """
    text = dotted.text_key(key)
    at = key.removeprefix(f"{text}.")
    return values[key] if key == text else arguments.argument(rooms.TEXTS[text], values[text], at)


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
        way: _with(way, text, f"{way}.loss", 0.0) if text.endswith(LOST) else text
        for way, text in changed.items()
    }


def _with(text_key: str, text: str, key: str, value: Any) -> str:
    at = key.removeprefix(f"{text_key}.")
    return arguments.with_argument(rooms.TEXTS[text_key], text, at, value)


def _number(values: Values, key: str) -> float | None:
    try:
        return float(argument(values, key))
    except (KeyError, GrammarError):
        return None


def _own(key: str) -> tuple[Read, Write]:
    return lambda values: values.get(key), lambda _, number: {key: number}


def _ways(names: tuple[str, ...], scale: float) -> tuple[Read, Write]:
    """Functions of a slider for the first argument of an impairment in both directions.

    Args:
        names: names of impairments; the argument is that of the impairment in a direction's text.
        scale: factor from the argument to the slider's number.
    """

    def numbers_of(values: Values) -> dict[str, float]:
        keys = [f"{way}.{name}" for way in WAYS for name in names]
        numbers = ((key, _number(values, key)) for key in keys)
        return {key: number for key, number in numbers if number is not None}

    def read(values: Values) -> float | None:
        found = numbers_of(values)
        return scale * max(found.values()) if found else None

    def write(values: Values, number: float) -> dict[str, Any]:
        return dict.fromkeys(numbers_of(values), number / scale)

    return read, write


def _component(key: str, axis: int, axes: int) -> tuple[Read, Write]:
    """Functions of a slider for one number of a list with one per axis; an empty list means 0."""

    def write(values: Values, number: float) -> dict[str, Any]:
        numbers = list(values[key]) or [0.0] * axes
        numbers[axis] = number
        return {key: numbers}

    def read(values: Values) -> float | None:
        numbers = values.get(key)
        if numbers is None or 0 < len(numbers) <= axis:
            return None
        return float(numbers[axis]) if numbers else 0.0

    return read, write


def _argument(
    name: str, unit: str, hint: str, at: str, low: float, high: float, step: float
) -> Knob:
    """Slider for an argument of the trigger, which is an integer if `step` is 1 or more."""
    key = f"control.trigger.{at}"

    def write(_: Values, number: float) -> dict[str, Any]:
        return {key: round(number) if step >= 1.0 else number}

    return Knob(
        name, unit, hint, "server", low, high, step, lambda values: _number(values, key), write
    )


def knobs(axes: int) -> tuple[Knob, ...]:
    lossy = "Share of packets that are lost, both ways"
    least = "Smallest delay of a packet, each way"
    white, along = "Strength of white acceleration", "Velocity of the steady wind"
    delays = "paper", "constant"
    return (
        Knob("Loss", "%", lossy, "netem", 0.0, 100.0, 1.0, *_ways(("loss",), 100.0)),
        Knob("Delay", "ms", least, "netem", 0.0, 1500.0, 10.0, *_ways(delays, 1e3)),
        Knob("Wind", "m/s per √s", white, "client", 0.0, 1.0, 0.01, *_own("vehicle.wind")),
        *(
            Knob(
                f"Steady wind {name}",
                "m/s",
                along,
                "client",
                -1.0,
                1.0,
                0.02,
                *_component("vehicle.steady_wind_mps", axis, axes),
            )
            for axis, name in enumerate("xyz"[:axes])
        ),
    )


THRESHOLDS = (
    _argument(
        "Threshold: cost gap", "", "Extra cost above which a plan is sent", "cost_gap", 0, 20, 0.05
    ),
    _argument(
        "Threshold: expected gap",
        "",
        "Expected extra cost above which a plan is sent",
        "expected_gap",
        0,
        20,
        0.05,
    ),
    _argument("Threshold: ε", "", "Tolerance of eq. (16)", "state_gap.epsilon", 0, 20, 0.1),
    _argument(
        "Threshold: decay λ", "1/s", "Decay rate of (16)", "state_gap.decay_rate", 0, 10, 0.1
    ),
    _argument(
        "Threshold: deviation",
        "m",
        "Distance from the old plan above which a new one is sent",
        "deviation",
        0,
        1,
        0.01,
    ),
    _argument(
        "Rate: steps a packet",
        "",
        "Number of steps from one packet to the next",
        "periodic",
        1,
        100,
        1.0,
    ),
)
"""Sliders for thresholds; each is shown if the present trigger has this threshold."""

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
