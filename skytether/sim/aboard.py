"""What a vehicle does in a step of virtual time, in one compiled call.

A vehicle that flies along a plan does the same at every step: eq. (1) moves it, it measures that,
holds it against what it measured before, filters it, chooses the input by the rule of flight and
clamps it. The functions are those of `client` and `shared`, the order is that of `client.pilot`,
and the numbers are the same to the last bit (`tests/test_aboard_compiled.py`). All else is left to
`Pilot`: a first step, a step without a plan, a landing, a state that has leapt or is not finite, a
vehicle with a dead time, a fence, a mission, or a sensor that is not exact.
"""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from skytether.client import clamp
from skytether.client import filter as kalman
from skytether.client.clamp import ROUNDING
from skytether.client.compensator import Compensator
from skytether.client.failsafe import Failsafe
from skytether.client.filter import Kalman, Spread
from skytether.client.navigation import Navigation
from skytether.client.pilot import STOPPED, Pilot
from skytether.client.reporting import BelievedState, States
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.vehicle import SimulatedVehicle
from skytether.client.vehicle import Measurement, Vehicle
from skytether.server.control.law import advance, lead_to, step
from skytether.server.control.trajectory import follow, guided_to
from skytether.shared.base.kernel import F1, F2, R1, kernel, part, record, records, shared
from skytether.shared.base.units import SECOND_NS
from skytether.shared.law import leap
from skytether.shared.law.model import Array, Axis
from skytether.shared.law.rule import Held
from skytether.shared.law.spline import Guide
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Recorder
from skytether.shared.wire.protocol import FLOAT_MAX, Mode

limited = shared(clamp.limited)
velocity_leaps, position_leaps = shared(leap.velocity_leaps), shared(leap.position_leaps)
widened = shared(kalman.widened)
by_position, by_velocity = shared(kalman.by_position), shared(kalman.by_velocity)


class AxisAboard:
    """Record: what does not change from step to step on one axis of a vehicle."""

    true_a01: float
    """Eq. (4) of the vehicle as it is: how far the velocity carries the position [s]."""
    true_a11: float
    """Share of the velocity that is left after a step."""
    true_b0: float
    """How far the input carries the position [s]."""
    true_b1: float
    """Share of the input that the velocity has taken on."""
    true_gain: float
    """Gain g of the vehicle as it is."""
    push: float
    """What the air adds to the input, but for white acceleration [m/s]."""
    windy: bool
    """Whether there is white acceleration."""
    shove_p: float
    """What a unit of white acceleration's first number adds to the position [m]."""
    shove_vp: float
    """What that adds to the velocity [m/s]."""
    shove_v: float
    """What a unit of its second number adds to the velocity [m/s]."""
    a01: float
    """Eq. (4) as the terms have it: how far the velocity carries the position [s]."""
    a11: float
    """Share of the velocity that is left after a step."""
    b0: float
    """How far the input carries the position [s]."""
    b1: float
    """Share of the input that the velocity has taken on."""
    bound: float
    """Bound u_max of the input [m/s]."""
    change_max: float
    """Largest change of the input in a step [m/s]."""
    dt_s: float
    """Length of a step [s]."""
    noise_m: float
    """What noise may add to a change of position [m]."""
    noise_mps: float
    """What noise may add to a change of velocity [m/s]."""
    filters: bool
    """Whether there is a Kalman filter."""
    variance_p: float
    """Variance of a measured position [m²]."""
    variance_v: float
    """Variance of a measured velocity [m²/s²]."""
    noise_pp: float
    """Q of the filter: variance of the position [m²]; the other fields likewise."""
    noise_pv: float
    """Q: covariance of position and velocity."""
    noise_vv: float
    """Q: variance of the velocity."""
    noise_ww: float
    """Q: variance of the disturbance."""


class AxisState:
    """Record: what changes from step to step on one axis of a vehicle."""

    p: float
    """True position [m]."""
    v: float
    """True velocity [m/s]."""
    x_p: float
    """Position that is flown by [m]."""
    x_v: float
    """Velocity that is flown by [m/s]."""
    x_w: float
    """Disturbance ŵ that the filter has found [m/s]; 0 without a filter."""
    u: float
    """Input that is flown [m/s]."""
    lead_p: float
    """Position to which the horizon leads [m]."""
    lead_v: float
    """Velocity to which the horizon leads [m/s]."""
    pp: float
    """P of the filter: variance of the position [m²]; the other fields likewise."""
    pv: float
    """P: covariance of position and velocity."""
    pw: float
    """P: covariance of position and disturbance."""
    vv: float
    """P: variance of the velocity."""
    vw: float
    """P: covariance of velocity and disturbance."""
    ww: float
    """P: variance of the disturbance."""


class AxisPlan:
    """Record: the horizon or spline that is held, on one axis."""

    is_spline: bool
    """Whether it is a spline."""
    length: int
    """Number of stages that are flown."""
    spacing: int
    """Steps from one knot of a spline to the next."""
    indexed: bool
    """Whether each stage of a horizon has an input of its own."""
    last: float
    """Input at the last stage of a spline [m/s]."""
    speed: float
    """Magnitude of the last input over all axes [m/s]."""
    brake: float
    """Speed that braking takes away in a step [m/s]."""
    feeds_back: bool
    """Whether there is feedback."""
    gain_p: float
    """K on position [1/s]."""
    gain_v: float
    """K on velocity."""
    disturbance: float
    """Disturbance ŵ that the inputs of a horizon reckon with [m/s]."""


AXIS_ABOARD, AXIS_STATE, AXIS_PLAN = record(AxisAboard), record(AxisState), record(AxisPlan)
Constants = Annotated[NDArray[np.void], records(AXIS_ABOARD, 1)]
"""Constants of a vehicle; shape (axes,)."""
StatesNow = Annotated[NDArray[np.void], records(AXIS_STATE, 1)]
"""State of a vehicle; shape (axes,)."""
Plans = Annotated[NDArray[np.void], records(AXIS_PLAN, 1)]
"""Plan of a vehicle; shape (axes,)."""


@part
def measured_on(constants: Constants, now: StatesNow, after: StatesNow, drawn: F2) -> bool:
    """Fly the vehicle to the next step, measure it and filter that; see `fly_step`."""
    usual = True
    for i in range(len(constants)):
        axis, was, now_is = constants[i], now[i], after[i]
        true = Axis(axis.true_a01, axis.true_a11, axis.true_b0, axis.true_b1)
        p, v = advance(true, was.p, was.v, axis.true_gain * was.u + axis.push)
        if axis.windy:
            n, m = drawn[i, 0], drawn[i, 1]
            p, v = p + axis.shove_p * n, v + (axis.shove_vp * n + axis.shove_v * m)
        usual &= not velocity_leaps(was.v, v, axis.dt_s, axis.noise_mps)
        usual &= not position_leaps(was.p, was.v, p, v, axis.dt_s, axis.noise_m)
        x_p, x_v, w = p, v, 0.0
        if axis.filters:
            known = Axis(axis.a01, axis.a11, axis.b0, axis.b1)
            x_p, x_v = advance(known, was.x_p, was.x_v, was.u + was.x_w)
            noise = Spread(axis.noise_pp, axis.noise_pv, 0.0, axis.noise_vv, 0.0, axis.noise_ww)
            spread = Spread(was.pp, was.pv, was.pw, was.vv, was.vw, was.ww)
            (kp, kv, kw), spread = by_position(widened(known, spread, noise), axis.variance_p)
            off = p - x_p
            x_p, x_v, w = x_p + kp * off, x_v + kv * off, was.x_w + kw * off
            (kp, kv, kw), spread = by_velocity(spread, axis.variance_v)
            off = v - x_v
            x_p, x_v, w = x_p + kp * off, x_v + kv * off, w + kw * off
            now_is.pp, now_is.pv, now_is.pw = spread.pp, spread.pv, spread.pw
            now_is.vv, now_is.vw, now_is.ww = spread.vv, spread.vw, spread.ww
        usual &= -FLOAT_MAX <= x_p <= FLOAT_MAX and -FLOAT_MAX <= x_v <= FLOAT_MAX
        now_is.p, now_is.v = p, v
        now_is.x_p, now_is.x_v, now_is.x_w = x_p, x_v, w
    return usual


@part
def guide_of(axis: AxisAboard, plan: AxisPlan, knots: R1) -> Guide:
    """Spline of one axis."""
    return Guide(
        Axis(axis.a01, axis.a11, axis.b0, axis.b1),
        knots,
        plan.spacing,
        axis.dt_s,
        plan.length,
        plan.last,
        plan.speed,
        plan.brake,
        axis.bound,
        plan.gain_p,
        plan.gain_v,
    )


@part
def held_of(axis: AxisAboard, plan: AxisPlan, inputs: R1) -> Held:
    """Horizon of one axis."""
    return Held(
        Axis(axis.a01, axis.a11, axis.b0, axis.b1),
        inputs,
        plan.length,
        plan.indexed,
        plan.speed,
        plan.brake,
        axis.bound,
        plan.feeds_back,
        plan.gain_p,
        plan.gain_v,
        plan.disturbance,
    )


@kernel
def fly_step(
    constants: Constants,
    now: StatesNow,
    after: StatesNow,
    drawn: F2,
    plans: Plans,
    numbers: F2,
    stage: int,
    lead_stage: int,
    told: F1,
) -> bool:
    """Fly a vehicle to its next step, and choose the input from there on.

    Args:
        constants: those of the vehicle.
        now: its state at the step before.
        after: what is filled in: its state at the step.
        drawn: normal numbers of white acceleration; shape (axes, 2).
        plans: the horizon or spline that is held.
        numbers: its inputs [m/s] or knots [m, m/s]; shape (axes, n).
        stage: where in the plan the step is.
        lead_stage: stage at which `now` has the state to which the plan leads.
        told: what is filled in, for all axes one after the other: true position [m] and velocity
            [m/s], those measured, those flown by, then input [m/s], and part of the input that is
            no feedback [m/s]; shape (8 axes,).

    Returns:
        whether all of that is as usual; if not, it counts for nothing.
    """
    usual, axes = measured_on(constants, now, after, drawn), len(constants)
    for i in range(axes):
        axis, was, now_is, plan = constants[i], now[i], after[i], plans[i]
        lead_p, lead_v, x_p, x_v = was.lead_p, was.lead_v, now_is.x_p, now_is.x_v
        if plan.is_spline:
            guide = guide_of(axis, plan, numbers[i])
            lead_p, lead_v = guided_to(guide, lead_stage, stage, lead_p, lead_v)
            u, part_told = follow(guide, stage, lead_p, lead_v, x_p, x_v, now_is.x_w)
        else:
            held = held_of(axis, plan, numbers[i])
            if plan.feeds_back:
                lead_p, lead_v = lead_to(held, lead_stage, stage, lead_p, lead_v)
            u, part_told, _, _ = step(held, stage, lead_p, lead_v, x_p, x_v)
        usual &= math.isfinite(u) and math.isfinite(part_told)
        part_flown = part_told if plan.feeds_back else u
        u = limited(u, part_flown, 0.0, was.u, axis.change_max, axis.bound)
        now_is.u, now_is.lead_p, now_is.lead_v = u, lead_p, lead_v
        told[2 * i], told[2 * i + 1] = now_is.p, now_is.v
        told[2 * (axes + i)], told[2 * (axes + i) + 1] = now_is.p, now_is.v
        told[2 * (2 * axes + i)], told[2 * (2 * axes + i) + 1] = x_p, x_v
        told[6 * axes + i], told[7 * axes + i] = u, part_told
    return usual


@kernel
def believe_step(
    constants: Constants,
    now: StatesNow,
    plans: Plans,
    numbers: F2,
    stage: int,
    believed: F2,
    silent: F2,
    told: F2,
    apart: F2,
) -> None:
    """Foresee the state of the next step, as `Compensator.foresee` does.

    Args:
        constants: those of the vehicle.
        now: its state at the step.
        plans: the horizon or spline that is held.
        numbers: its inputs [m/s] or knots [m, m/s]; shape (axes, n).
        stage: where in the plan the step is.
        believed: state that the server must take it to be in [m, m/s]; shape (axes, 2).
        silent: what is filled in: where that leads [m, m/s]; shape (axes, 2).
        told: what is filled in: where the state leads that is flown by [m, m/s]; shape (axes, 2).
        apart: what is filled in: how far the vehicle is from `believed` [m, m/s]; shape (axes, 2).
    """
    for i in range(len(constants)):
        axis, at, plan = constants[i], now[i], plans[i]
        model = Axis(axis.a01, axis.a11, axis.b0, axis.b1)
        p, v, x_p, x_v = believed[i, 0], believed[i, 1], at.x_p, at.x_v
        apart[i, 0], apart[i, 1] = p - x_p, v - x_v
        if plan.is_spline:
            guide = guide_of(axis, plan, numbers[i])
            u, _ = follow(guide, stage, at.lead_p, at.lead_v, p, v, 0.0)
            silent[i, 0], silent[i, 1] = advance(model, p, v, u)
            u, _ = follow(guide, stage, at.lead_p, at.lead_v, x_p, x_v, 0.0)
            told[i, 0], told[i, 1] = advance(model, x_p, x_v, u)
        else:
            held = held_of(axis, plan, numbers[i])
            u, _, _, _ = step(held, stage, at.lead_p, at.lead_v, p, v)
            silent[i, 0], silent[i, 1] = advance(model, p, v, u + plan.disturbance)
            told[i, 0], told[i, 1] = advance(model, x_p, x_v, at.u + plan.disturbance)


class SimpleBody(NamedTuple):
    """A vehicle of which all that happens in a usual step is in `fly_step`."""

    vehicle: SimulatedVehicle
    plant: FirstOrderPlant

    @classmethod
    def of(cls, vehicle: Vehicle) -> Self | None:
        """The vehicle with its plant; None of one that is not as simple."""
        if type(vehicle) is not SimulatedVehicle or type(vehicle.plant) is not FirstOrderPlant:
            return None
        simple = vehicle.is_simple and vehicle.plant.is_simple
        return cls(vehicle, vehicle.plant) if simple else None


class _Flying:
    """Arrays of a vehicle whose usual steps are compiled, and the objects whose place they take.

    Args:
        scenario: what is flown.
        navigation, compensator: those of the pilot.
        body: what flies.
        change_max: largest change of the input from step to step [m/s].
    """

    def __init__(
        self,
        scenario: Scenario,
        navigation: Navigation,
        compensator: Compensator,
        body: SimpleBody,
        change_max: float,
    ) -> None:
        self._navigation, self._compensator = navigation, compensator
        self._vehicle, self._plant = body
        found = navigation.filter
        self._kalman = found if isinstance(found, Kalman) else None
        axes = scenario.model.axes
        self._now, self._after = np.zeros(axes, AXIS_STATE), np.zeros(axes, AXIS_STATE)
        self._constants, self._plans = np.zeros(axes, AXIS_ABOARD), np.zeros(axes, AXIS_PLAN)
        self._numbers, self._told = np.zeros((axes, 1)), np.zeros(8 * axes)
        self._states = slice(0, 2 * axes)
        self._known = slice(4 * axes, 6 * axes)
        self._inputs = slice(6 * axes, 7 * axes)
        self._parts = slice(7 * axes, 8 * axes)
        """Where in `_told` the true state is, the one flown by, the input, and its part."""
        self.row: list[float] = []
        """What `fly_step` has told last."""
        self.step: int | None = None
        """Step that the arrays are at; None where they are not to be used."""
        self._stage = self._lead_stage = 0
        """Stage that the plan is at, and that up to which its lead was rolled."""
        self._is_ahead = False
        """Whether the arrays are newer than the objects."""
        self._is_loaded = False
        """Whether the arrays are at least as new as the objects."""
        self._held: object = None
        self._guides: object = None
        self._calm: object = None
        """Horizon, spline and air that the arrays have."""
        self._set_constants(scenario, change_max)

    def _set_constants(self, scenario: Scenario, change_max: float) -> None:
        """Fill in what does not change in flight."""
        terms, to, leaps = scenario.terms(), self._constants, self._navigation.leaps
        for name, numbers in zip(Axis._fields, zip(*self._plant.model, strict=True), strict=True):
            to[f"true_{name}"] = numbers
        for name, field in terms.model._asdict().items():
            to[name] = field
        to["true_gain"], to["bound"] = self._plant.gain, terms.u_max
        to["change_max"], to["dt_s"] = change_max, terms.dt_ns / SECOND_NS
        to["noise_m"], to["noise_mps"] = leaps.noise_m, leaps.noise_mps
        if self._kalman is not None:
            to["filters"] = True
            to["variance_p"], to["variance_v"] = self._kalman.variances
            noises = [self._kalman.noise[kind] for kind in self._kalman.kinds]
            for name in ("pp", "pv", "vv", "ww"):
                to[f"noise_{name}"] = [getattr(noise, name) for noise in noises]

    def fly(self, step: int, before: Array, speed_max: float) -> list[float] | None:
        """Fly to the begin of a step, and choose the input from there on.

        Args:
            step: the step after the one that the vehicle is at.
            before: input that is flown until there [m/s]; shape (axes,).
            speed_max: bound of the magnitude of what is no feedback [m/s].

        Returns:
            the input of each axis [m/s]; None where something is not as usual: then nothing was
            done.
        """
        compensator, weather = self._compensator, self._plant.weather
        if not self._is_loaded:
            self._load(before)
        if compensator.held is not self._held or compensator.guides is not self._guides:
            self._load_plan()
        drawn = weather.draw()
        if weather.calm is not self._calm:
            self._load_air()
        self._stage = stage = step - compensator.begins
        if not fly_step(
            self._constants,
            self._now,
            self._after,
            drawn,
            self._plans,
            self._numbers,
            stage,
            self._lead_stage,
            self._told,
        ):
            return None
        row = self._told.tolist()
        if speed_max < math.inf and math.hypot(*row[self._parts]) > speed_max + ROUNDING:
            return None
        weather.drawn = None
        self._now, self._after = self._after, self._now
        self._lead_stage = max(stage, self._lead_stage)
        self.step, self._is_ahead = step, True
        self.row = row
        self._navigation.note(pairs(row[self._known]))
        compensator.note(step, row[self._parts])
        return row[self._inputs]

    def foresee(self, believed: Array, silent: Array, told: Array, apart: Array) -> None:
        """Foresee the state of the next step from the one that the arrays are at.

        See `believe_step`, whose arguments these are.
        """
        believe_step(
            self._constants,
            self._now,
            self._plans,
            self._numbers,
            self._stage,
            believed,
            silent,
            told,
            apart,
        )

    def _load(self, before: Array) -> None:
        """Have the arrays know what the objects know."""
        now, self._is_loaded = self._now, True
        now["p"], now["v"] = zip(*self._plant.x, strict=True)
        now["x_p"], now["x_v"] = zip(*self._navigation.estimate, strict=True)
        now["u"] = before
        self._held = None
        if self._kalman is not None:
            now["x_w"] = self._kalman.disturbance()
            spreads = [self._kalman.spreads[kind] for kind in self._kalman.kinds]
            for name, numbers in zip(Spread._fields, zip(*spreads, strict=True), strict=True):
                now[name] = numbers

    def _load_plan(self) -> None:
        """Take on the horizon or spline that is held."""
        compensator, now = self._compensator, self._now
        self._held, self._guides = held, guides = compensator.held, compensator.guides
        now["lead_p"], now["lead_v"] = zip(*compensator.lead, strict=True)
        self._lead_stage = compensator.lead_stage
        if guides:
            self._numbers = np.array([each.knots for each in guides])
            self._plans[:] = [
                (
                    True,
                    g.length,
                    g.spacing,
                    True,
                    g.last,
                    g.speed,
                    g.brake,
                    True,
                    g.gain_p,
                    g.gain_v,
                    0,
                )
                for g in guides
            ]
        else:
            self._numbers = np.array([each.inputs for each in held])
            self._plans[:] = [
                (
                    False,
                    h.length,
                    1,
                    h.indexed,
                    0,
                    h.speed,
                    h.brake,
                    h.feeds_back,
                    h.gain_p,
                    h.gain_v,
                    h.disturbance,
                )
                for h in held
            ]

    def _load_air(self) -> None:
        """Take on the air as it is now."""
        weather, to = self._plant.weather, self._constants
        self._calm, to["push"], to["windy"] = weather.calm, weather.calm.push, bool(weather.white)
        if weather.white:
            white = np.array(weather.white)
            to["shove_p"], to["shove_vp"] = white[:, 0, 0], white[:, 1, 0]
            to["shove_v"] = white[:, 1, 1]

    def leave(self) -> None:
        """Have the objects know what the arrays know, which are to be loaded anew."""
        self.tell()
        self._is_loaded, self.step = False, None

    def tell(self) -> None:
        """Have the objects know what the arrays know."""
        if not self._is_ahead:
            return
        assert self.step is not None
        self._is_ahead = False
        compensator, now = self._compensator, self._now
        self._vehicle.flown_to(self.step)
        states = self._plant.x = self._navigation.measured = pairs(self.row[self._states])
        position, velocity = [p for p, _ in states], [v for _, v in states]
        measured = Measurement(self._vehicle.starts_ns(self.step), position, velocity)
        self._navigation.leaps.took(measured)
        if compensator.held is self._held and compensator.guides is self._guides:
            compensator.lead = now[["lead_p", "lead_v"]].tolist()
            compensator.lead_stage = self._lead_stage
        if self._kalman is None:
            self._navigation.filter.take(measured)
            return
        self._kalman.x = now[["x_p", "x_v", "x_w"]].tolist()
        spreads, kinds = now[list(Spread._fields)].tolist(), self._kalman.kinds
        self._kalman.spreads = [
            Spread(*spreads[kinds.index(kind)]) for kind in range(len(self._kalman.spreads))
        ]


def pairs(numbers: list[float]) -> list[tuple[float, float]]:
    """Numbers two by two."""
    return list(zip(numbers[::2], numbers[1::2], strict=True))


class _Belief(BelievedState):
    """What the server must believe of a vehicle, foreseen by the arrays where they are in use."""

    def __init__(self, terms: Terms, compensator: Compensator, flying: _Flying) -> None:
        super().__init__(terms, compensator)
        self._flying = flying
        self._believed, self._silent, self._told, self._apart = np.zeros((4, terms.axes, 2))
        self._is_array = False
        """Whether the state is in `_believed`."""
        self._foreseen: int | None = None
        """Step from which the next state has been foreseen by the arrays."""

    def off_m(self, states: States) -> float:
        """See `BelievedState`."""
        if self._flying.step is None:
            self._to_list()
            return super().off_m(states)
        if not self._is_array:
            self._believed[:], self._is_array = self._states, True
        self._flying.foresee(self._believed, self._silent, self._told, self._apart)
        self._foreseen = self._flying.step
        axes = zip(self._tau_s, self._apart.tolist(), strict=True)
        return math.hypot(*(dp + tau * dv for tau, (dp, dv) in axes))

    def told(self, states: States, flown: Sequence[float]) -> None:
        """See `BelievedState`."""
        if self._is_foreseen():
            self._believed, self._told = self._told, self._believed
        else:
            super().told(states, flown)

    def silent(self) -> None:
        """See `BelievedState`."""
        if self._is_foreseen():
            self._believed, self._silent = self._silent, self._believed
        else:
            super().silent()

    def _is_foreseen(self) -> bool:
        """Whether the next state is known; if not, the objects know what it follows from."""
        if self._flying.step is not None and self._foreseen == self._flying.step:
            return True
        self._flying.tell()
        self._to_list()
        return False

    def _to_list(self) -> None:
        """Have the state as `BelievedState` has it."""
        if self._is_array:
            self._states, self._is_array = pairs(self._believed.ravel().tolist()), False


class CompiledPilot(Pilot):
    """Pilot of a simulated vehicle whose usual steps are compiled.

    In usual steps the arrays of `fly_step` are newer than what the objects of a `Pilot` know; the
    objects are brought up to date before any other step.
    """

    def __init__(
        self,
        scenario: Scenario,
        number: int,
        vehicle: Vehicle,
        failsafe: Failsafe,
        recorder: Recorder | None,
    ) -> None:
        super().__init__(scenario, number, vehicle, failsafe, recorder)
        self._flying: _Flying | None = None
        """What flies usual steps; None where these are not compiled."""
        if self._fence is None and not self._terms.join and self._navigation.is_simple:
            body = SimpleBody.of(vehicle)
            if body is not None:
                self._flying = _Flying(
                    scenario, self._navigation, self.compensator, body, self._change_max
                )
                self._reporter.belief = _Belief(self._terms, self.compensator, self._flying)
        self._due: int | None = None
        """Step up to whose begin the vehicle is still to be flown and measured."""

    @property
    def disturbance(self) -> Sequence[float]:
        """See `Pilot`."""
        if self._flying is not None:
            self._flying.tell()
        return super().disturbance

    def _known(self) -> Sequence[float]:
        """See `Pilot`."""
        flying = self._flying
        if flying is None or flying.step is None:
            return super()._known()
        return flying.row[: 7 * self._terms.axes]

    def _navigate(self, step: int) -> None:
        """Take what was measured up to the begin of a step, at once or with its input."""
        if self._due is not None:
            self._catch_up()
        if step and self._flying is not None:
            self._due = step
        else:
            super()._navigate(step)

    def _catch_up(self) -> None:
        """Leave it to the objects to fly on, from where the arrays are."""
        if self._flying is not None:
            self._flying.leave()
        if self._due is not None:
            due, self._due = self._due, None
            super()._navigate(due)

    def _choose(self, now_ns: int) -> Array:
        """See `Pilot`."""
        if self._flying is not None and self._due == self.step and self._is_usual():
            covers = self.compensator.covers(self.step)
            speed_max = self._speed_max(self.compensator.covered, covers)
            flown = self._flying.fly(self.step, self._input, speed_max)
            if flown is not None:
                self._due = None
                told = self.compensator.told if self.compensator.feeds_back else flown
                return self._settled(flown, told, speed_max, now_ns)
        self._catch_up()
        return super()._choose(now_ns)

    def _is_usual(self) -> bool:
        """Whether the vehicle flies what is chosen, and its state is known."""
        mode = self._failsafe.mode
        return mode is not Mode.LAND and mode not in STOPPED and self._navigation.is_known
