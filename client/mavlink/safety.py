"""Parameters that decide how an autopilot reacts to silence: their meaning and safe values.

**Safe means that the flight ends without commands.** Without set-points the vehicle may fly on for
one second at most, and once the client's process has ended it has to come down; hovering or flying
on for ever is unsafe.

The autopilot is unsafe if it lacks a required parameter; other missing parameters are only
reported.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from skytether.shared.events.aboard import AutopilotParameter
from skytether.shared.fence.keys import FenceConfig
from skytether.shared.law.model import ALTITUDE
from skytether.shared.scenario.schema import Scenario

SILENCE_MAX_S = 1.0
"""Longest time for which a vehicle may fly on without set-points [s]."""
SILENCE_MIN_S = 0.2
"""Shortest usable time-out for set-points that arrive at 10 Hz [s]."""
TOLERANCE = 1e-6
"""Rounding error of a decimal number stored as float32."""


def returns_below_m(scenario: Scenario) -> float | None:
    """Altitude of the fence, below which a vehicle without a link has to return home [m]; infinite
    without a fence. None if the vehicle lands in place.
    """
    if scenario.vehicle.on_loss != "return":
        return None
    high = scenario.section(FenceConfig).high_m[ALTITUDE:]
    return high[0] if high else math.inf


class Rule(NamedTuple):
    names: tuple[str, ...]
    """Names of the parameter in different versions of the autopilot, newest last."""
    meaning: Callable[[float], str]
    is_safe: Callable[[float], bool] = lambda _: True
    wanted: str = ""
    value: float = 0.0
    required: bool = False
    """Whether a missing parameter makes the autopilot unsafe."""


def _table(meanings: Mapping[int, str], other: str) -> Callable[[float], str]:
    return lambda value: meanings.get(round(value), other)


def _among(*values: int) -> Callable[[float], bool]:
    return lambda value: round(value) in values


def _timeout(value: float) -> bool:
    return SILENCE_MIN_S - TOLERANCE <= value <= SILENCE_MAX_S + TOLERANCE


_STATION_ACTIONS = {
    0: "without our heartbeats it hovers for ever",
    1: "without our heartbeats it returns home and lands",
    2: "without our heartbeats it continues a mission, or returns home and lands",
    3: "without our heartbeats it returns home the way it came, and lands",
    4: "without our heartbeats it returns home the way it came, or lands",
    5: "without our heartbeats it lands where it is",
    6: "without our heartbeats it returns home, or flies to a landing sequence of its mission",
    7: "without our heartbeats it brakes and hovers for ever",
}
_SILENCE_ACTIONS = {
    0: "without setpoints it hovers for ever where there is a remote control (position mode)",
    1: "without setpoints it drifts with the wind where there is a remote control (altitude mode)",
    2: "without setpoints it needs a pilot at once (manual mode)",
    3: "without setpoints it returns home and lands",
    4: "without setpoints it lands where it is",
    5: "without setpoints it hovers for ever",
    6: "without setpoints it is terminated: it falls",
    7: "without setpoints it is disarmed: it falls",
}
_OLD_SILENCE_ACTIONS = {
    0: "without setpoints and remote control it lands",
    1: "without setpoints and remote control it hovers for ever",
    2: "without setpoints and remote control it returns home and lands",
}
_LINK_ACTIONS = {
    0: "a lost ground station changes nothing",
    1: "without a ground station it hovers",
    2: "without a ground station it returns home",
    3: "without a ground station it lands",
    5: "without a ground station it is terminated: it falls",
    6: "without a ground station it is disarmed: it falls",
}
_FENCES = {0: "its own fence is off", 1: "its own fence is on"}


def _fence_types(value: float) -> str:
    kinds = {1: "altitude", 2: "a circle around home", 4: "a polygon", 8: "least altitude"}
    held = [words for bit, words in kinds.items() if round(value) & bit]
    return f"its fence holds {', '.join(held) or 'nothing'}"


def _options(value: float) -> str:
    kinds = {
        2: "a mission continues without a ground station",
        4: "GUIDED continues without a remote control",
        8: "a landing continues, whatever fails",
        16: "a pilot's modes continue without a ground station",
    }
    held = [words for bit, words in kinds.items() if round(value) & bit]
    return "; ".join(held) or "every failsafe acts at once"


CLEAR_M = 1.0
"""Distance by which the return altitude that the client sets is below the fence [m]."""


def _below(value: float, below_m: float) -> bool:
    return value <= below_m + TOLERANCE


def _returning(name: str, what: str, below_m: float, scale: float) -> Rule:
    """Rule for a parameter that is an altitude of the return home, which must be below the fence.

    Args:
        what: what the vehicle does at that altitude, such as "returns home".
        below_m: altitude of the fence [m]; infinite without one.
        scale: number of the parameter's units in a metre.
    """
    return Rule(
        (name,),
        lambda v: f"it {what} at {v / scale:g} m",
        lambda v: _below(v / scale, below_m),
        f"up to {below_m:g} m, fence.high_m: set {scale * max(below_m - CLEAR_M, CLEAR_M):g}",
        scale * max(below_m - CLEAR_M, CLEAR_M),
        required=True,
    )


def _ardupilot_returns(below_m: float | None) -> tuple[Rule, ...]:
    if below_m is None:
        return ()
    return (
        _returning("RTL_ALT", "returns home", below_m, 100.0),
        Rule(
            ("RTL_ALT_FINAL",),
            lambda v: (
                f"home, it hovers at {v / 100.0:g} m for ever" if v > 0.0 else "home, it lands"
            ),
            lambda v: v <= 0.0,
            "0, with which it lands: set 0",
        ),
    )


def _px4_returns(below_m: float | None) -> tuple[Rule, ...]:
    if below_m is None:
        return ()
    return (
        _returning("RTL_RETURN_ALT", "returns home", below_m, 1.0),
        _returning("RTL_DESCEND_ALT", "waits to land", below_m, 1.0),
        Rule(
            ("RTL_LAND_DELAY",),
            lambda v: f"home, it lands after {v:g} s" if v >= 0.0 else "home, it hovers for ever",
            lambda v: v >= 0.0,
            "0 or more, with which it lands: set 0",
        ),
    )


def ardupilot(system: int, returns_below_m: float | None = None) -> tuple[Rule, ...]:
    """Rules for the parameters of ArduCopter; `system`: MAVLink system number of the client.

    `returns_below_m`: altitude below which the vehicle has to return home; None: it lands in place.
    """
    return (
        *_ardupilot_returns(returns_below_m),
        Rule(
            ("GUID_TIMEOUT",),
            lambda v: f"without setpoints for {v:g} s it brakes and hovers",
            _timeout,
            f"{SILENCE_MIN_S:g} to {SILENCE_MAX_S:g} s: set 1",
            SILENCE_MAX_S,
            required=True,
        ),
        Rule(
            ("FS_GCS_ENABLE",),
            _table(_STATION_ACTIONS, "it is not known what it does without our heartbeats"),
            _among(1, 2, 3, 4, 5, 6),
            "one that lands: set 5",
            5.0,
            required=True,
        ),
        Rule(
            ("SYSID_MYGCS", "MAV_GCS_SYSID"),
            lambda v: (
                f"it watches for system {v:g} alone, and accepts a joystick from no other; ours is "
                f"{system}"
            ),
            _among(system),
            f"that of mavlink.system: set {system}",
            float(system),
            required=True,
        ),
        Rule(
            ("FS_GCS_TIMEOUT",),
            lambda v: f"it does so {v:g} s after our last heartbeat",
            lambda v: v <= 10.0,
            "up to 10 s: set 5",
            5.0,
        ),
        Rule(("FS_OPTIONS",), _options),
        Rule(
            ("FS_EKF_ACTION",),
            _table(
                {1: "without an estimate it lands", 3: "without an estimate it lands"},
                "without an estimate it does not land by itself",
            ),
        ),
        Rule(
            ("BATT_FS_LOW_ACT",),
            _table({0: "a low battery is only reported"}, "with a low battery it acts by itself"),
        ),
        Rule(("FENCE_ENABLE",), _table(_FENCES, "its own fence is on")),
        Rule(("FENCE_TYPE",), _fence_types),
        Rule(
            ("FENCE_ACTION",),
            _table(
                {0: "beyond its fence it only reports it", 4: "beyond its fence it brakes"},
                "beyond its fence it returns home or lands",
            ),
        ),
        Rule(("FENCE_ALT_MAX",), lambda v: f"its fence is {v:g} m high"),
        Rule(("FENCE_RADIUS",), lambda v: f"its fence is {v:g} m around home"),
    )


def px4(returns_below_m: float | None = None) -> tuple[Rule, ...]:
    """Rules for the parameters of PX4; `returns_below_m`: altitude below which the vehicle has to
    return home [m]; None: the vehicle lands in place.
    """
    return (
        *_px4_returns(returns_below_m),
        Rule(
            ("COM_OF_LOSS_T",),
            lambda v: f"it leaves OFFBOARD after {v:g} s without setpoints",
            _timeout,
            f"{SILENCE_MIN_S:g} to {SILENCE_MAX_S:g} s: set 1",
            SILENCE_MAX_S,
            required=True,
        ),
        Rule(
            ("COM_OBL_RC_ACT",),
            _table(_SILENCE_ACTIONS, "it is not known what it does without setpoints"),
            _among(3, 4),
            "3 (return) or 4 (land): set 4",
            4.0,
            required=True,
        ),
        Rule(
            ("COM_OBL_ACT",),
            _table(_OLD_SILENCE_ACTIONS, "without setpoints and remote control it flies on"),
            _among(0, 2),
            "0 (land) or 2 (return): set 0",
            0.0,
        ),
        Rule(
            ("NAV_DLL_ACT",),
            _table(_LINK_ACTIONS, "it is not known what it does without a ground station"),
            _among(0, 1, 2, 3),
            "one with which it does not fall: set 0",
            0.0,
        ),
        Rule(("COM_DL_LOSS_T",), lambda v: f"a ground station is lost after {v:g} s"),
        Rule(
            ("COM_LOW_BAT_ACT",),
            _table({0: "a low battery is only reported"}, "with a low battery it acts by itself"),
        ),
        Rule(
            ("GF_ACTION",),
            _table(
                {0: "beyond its fence it continues", 1: "beyond its fence it only reports it"},
                "beyond its fence it acts by itself",
            ),
        ),
        Rule(("GF_MAX_HOR_DIST",), lambda v: _limit(v, "around home")),
        Rule(("GF_MAX_VER_DIST",), lambda v: _limit(v, "above home")),
    )


def _limit(value: float, where: str) -> str:
    return f"its fence is {value:g} m {where}" if value > 0.0 else f"its fence has no limit {where}"


def judged(rule: Rule, values: Mapping[str, float]) -> AutopilotParameter:
    """Parameter of a rule, the meaning of its value, and whether the value is safe; `values`:
    values of the autopilot's parameters by name.
    """
    for name in rule.names:
        value = values.get(name)
        if value is not None:
            wanted = "" if rule.is_safe(value) else rule.wanted
            return AutopilotParameter(
                name=name, value=value, meaning=rule.meaning(value), wanted=wanted
            )
    meaning = "its autopilot does not have it, or has not answered"
    wanted = rule.wanted if rule.required else ""
    return AutopilotParameter(name=rule.names[0], value=None, meaning=meaning, wanted=wanted)
