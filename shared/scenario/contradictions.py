"""Contradictions: values of a scenario that are each valid, but not together."""

from collections.abc import Iterator

from skytether.shared.scenario import reference as shapes
from skytether.shared.scenario import rooms, schemes
from skytether.shared.scenario.grammar import GrammarError, leaves
from skytether.shared.scenario.registry import (
    MPC,
    PLANNERS,
    REFERENCES,
    REPORTS,
    SCHEMES,
    TRIGGERS,
    PluginTable,
    load,
)
from skytether.shared.scenario.schema import (
    Contradiction,
    ControlConfig,
    Scenario,
)
from skytether.shared.wire.protocol import INPUTS_MAX

TINY = 1e-9
"""Rounding tolerance of a product such as 40 · 0.011."""


def contradictions(
    scenario: Scenario, checked: Scenario | None = None, *, any_network: bool = False
) -> Iterator[Contradiction]:
    """Contradictions of a scenario whose values are each valid.

    Args:
        checked: a scenario that was checked before; a desired trajectory equal to this scenario's
            is not checked again.
        any_network: whether a network too slow or too lossy for a flight is allowed.
    """
    model, control, vehicle = scenario.model, scenario.control, scenario.vehicle
    axes = model.axes
    for key, values in (
        ("model.tau_s", model.tau_s),
        ("model.gain", model.gain),
        ("model.dead_time_s", model.dead_time_s),
        ("model.u_max", model.u_max),
        ("vehicle.tau_s", vehicle.tau_s or (1.0,)),
        ("vehicle.gain", (1.0,) if vehicle.gain == () else vehicle.gain),
        ("vehicle.dead_time_s", (1.0,) if vehicle.dead_time_s == () else vehicle.dead_time_s),
    ):
        if isinstance(values, tuple) and len(values) not in (1, axes):
            yield key, list(values), f"1 or {axes} numbers with model.axes = {axes}"
    for key, values in (
        ("vehicle.start_m", vehicle.start_m),
        ("reference.velocity_mps", scenario.reference.velocity_mps),
        ("vehicle.steady_wind_mps", vehicle.steady_wind_mps),
        ("sensor.position_bias_m", scenario.sensor.position_bias_m),
        ("sensor.velocity_bias_mps", scenario.sensor.velocity_bias_mps),
    ):
        if len(values) not in (0, axes):
            yield key, list(values), f"{axes} numbers with model.axes = {axes}"
    if control.horizon * axes > INPUTS_MAX:
        fit = f"at most {INPUTS_MAX // axes} with {axes} axes, to fit one datagram"
        yield "control.horizon", control.horizon, fit
    link = scenario.link
    if link.heartbeat_s != "auto" and link.timeout_s <= link.heartbeat_s:
        yield "link.timeout_s", link.timeout_s, f"more than link.heartbeat_s = {link.heartbeat_s:g}"
    if vehicle.exhausted == "brake" and vehicle.slew_mps2 < vehicle.brake_mps2:
        least = f"at least vehicle.brake_mps2 = {vehicle.brake_mps2:g}, to allow braking"
        yield "vehicle.slew_mps2", vehicle.slew_mps2, least
    sensor = scenario.sensor
    if sensor.velocity_every_s == "never" and sensor.filter == "none":
        yield (
            "sensor.filter",
            repr(sensor.filter),
            "'kalman' with sensor.velocity_every_s = 'never'",
        )
    wrong = [*_no_scheme(scenario), *_no_origin(scenario)]
    yield from wrong
    if wrong:
        return
    yield from _no_planner(scenario)
    for section in scenario.sections():
        yield from section.contradictions(scenario)
    no_network = list(_no_impairments(scenario))
    yield from no_network
    if not (no_network or any_network):
        # One good path is enough for a flight.
        yield from min((list(_too_late(each)) for each in scenario.networks), key=len)
    yield from _no_trigger(control)
    yield from _no_policies("vehicle.report", vehicle.report, REPORTS, control)
    yield from _no_way(scenario, checked)


def _no_origin(scenario: Scenario) -> Iterator[Contradiction]:
    origin = scenario.reference.origin
    if origin and not (
        len(origin) in (2, 3) and abs(origin[0]) <= shapes.NORTH_MAX and abs(origin[1]) <= 180.0
    ):
        north = f"up to {shapes.NORTH_MAX:g} degrees north or south"
        expected = f"latitude and longitude, {north}, and the altitude if it is known"
        yield "reference.origin", list(origin), expected


def _no_way(scenario: Scenario, checked: Scenario | None) -> Iterator[Contradiction]:
    same = checked and (scenario.reference, scenario.model.axes) == (
        checked.reference,
        checked.model.axes,
    )
    wrong = [] if same else _no_shape(scenario) or list(_no_reference(scenario))
    yield from wrong
    for section in () if wrong else scenario.sections():
        yield from section.contradictions_of_way(scenario, is_new=not same)


def _no_scheme(scenario: Scenario) -> Iterator[Contradiction]:
    control = scenario.control
    try:
        properties = control.properties
    except GrammarError as error:
        yield "control.scheme", repr(error.given), error.expected
        return
    if properties.feedback not in (None, control.feedback):
        feedback, needed = (str(each).lower() for each in (control.feedback, properties.feedback))
        yield "control.feedback", feedback, f"{needed} with control.scheme = {control.scheme!r}"


def _no_planner(scenario: Scenario) -> Iterator[Contradiction]:
    control = scenario.control
    if control.planner == MPC:
        return
    try:
        PLANNERS.one(control.planner)
    except GrammarError as error:
        yield "control.planner", repr(error.given), error.expected
        return
    if not SCHEMES[schemes.call(control.scheme).name].is_ours:
        expected = f"{MPC!r} with control.scheme = {control.scheme!r}, which has its own planner"
        yield "control.planner", repr(control.planner), expected


def _too_late(scenario: Scenario) -> Iterator[Contradiction]:
    """Contradictions of limits that are shorter than the network's delays."""
    control, ahead_s = scenario.control, scenario.uplink.mean_s
    if not control.properties.splines:
        horizons = load(rooms.HORIZONS, f"control.scheme {control.scheme}")
        yield from horizons.too_late(scenario)
        ahead_s = horizons.ahead_s(scenario)
    trip_s, age_max_s = ahead_s + scenario.downlink.mean_s + 2 * control.dt, scenario.link.age_max_s
    if age_max_s < trip_s - TINY:
        yield "link.age_max_s", age_max_s, f"at least {trip_s:g} s, a round trip and two steps"


def _no_impairments(scenario: Scenario) -> Iterator[Contradiction]:
    networks = scenario.networks
    for i, each in enumerate(networks):
        at = f"network.paths[{i}]" if len(networks) > 1 else "network"
        for way in ("uplink", "downlink"):
            try:
                getattr(each, way)
            except GrammarError as error:
                yield f"{at}.{way}", repr(error.given), error.expected
            except Exception as error:
                expected = f"impairments that can be made ({type(error).__name__}: {error})"
                yield f"{at}.{way}", repr(getattr(each.network, way)), expected


def _no_trigger(control: ControlConfig) -> Iterator[Contradiction]:
    try:
        rooms.trigger(control, 1)
    except GrammarError:
        pass
    except Exception as error:
        expected = f"a trigger that can be made ({type(error).__name__}: {error})"
        yield "control.trigger", repr(control.trigger), expected
    yield from _no_policies("control.trigger", control.trigger, TRIGGERS, control)


def _no_policies(
    key: str, text: str, table: PluginTable, control: ControlConfig
) -> Iterator[Contradiction]:
    """Contradictions of a text of policies: wrong grammar, or use of a figure not in the scheme."""
    try:
        expression = table.parse(text)
    except GrammarError as error:
        yield key, repr(error.given), error.expected
        return
    for name in (part.name for part in leaves(expression)):
        needs = table[name].needs
        if needs and needs not in control.properties.computes:
            able = " or ".join(map(repr, schemes.that_compute(needs)))
            expected = f"{able or 'one that computes ' + needs} with the {key.split('.')[1]} {name}"
            yield "control.scheme", repr(control.scheme), expected


def _no_reference(scenario: Scenario) -> Iterator[Contradiction]:
    ref, curves = scenario.reference, ("circle", "figure-eight", "square")
    if ref.points_m or ref.shape not in curves:
        placed = load("skytether.shared.scenario.placed", f"reference.shape {ref.shape}")
        yield from placed.contradictions(scenario)
    most_m = shapes.FAST_MPS * ref.period_s / 8.0  # the perimeter of a square is eight radii
    if ref.shape in curves and ref.radius_m > most_m:
        most = f"at most {most_m:g} with reference.period_s = {ref.period_s:g}"
        yield "reference.radius_m", ref.radius_m, most


def _no_shape(scenario: Scenario) -> list[Contradiction]:
    """Contradictions of `reference.shape`: unknown, or a plug-in's shape that cannot be flown."""
    ref = scenario.reference
    try:
        shape = REFERENCES.one(ref.shape)
        if not REFERENCES[shape.name].is_ours:
            shapes.sampled(scenario.unallocated_reference(), scenario.model.axes)
    except GrammarError as error:
        return [("reference.shape", repr(error.given), error.expected)]
    except Exception as error:
        expected = f"a trajectory that can be flown ({type(error).__name__}: {error})"
        return [("reference.shape", repr(ref.shape), expected)]
    return []
