"""Pilot of a vehicle in virtual time, whose regular steps are compiled (`sim.aboard`).

All other steps run in `client.pilot`: a first step, a landing, a fault, a scripted pilot takeover,
a state that has jumped or is not finite, braking that has to be bounded; and every step of a
vehicle with a dead time, a fence, or a sensor that does not measure its whole state at each step.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

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
from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array, Axis
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Recorder
from skytether.shared.wire.protocol import Mode
from skytether.sim.aboard import (
    AXIS_ABOARD,
    AXIS_PLAN,
    AXIS_STATE,
    believe_step,
    fly_ahead,
    fly_step,
)

AHEAD, WORTHWHILE = 32, 5
"""Most steps that are flown ahead at a time, and fewest for which that takes less time than flying
them one by one."""


class SimpleBody(NamedTuple):
    """Simulated vehicle whose regular step is entirely in `fly_step`."""

    vehicle: SimulatedVehicle
    plant: FirstOrderPlant

    @classmethod
    def of(cls, vehicle: Vehicle) -> Self | None:
        """Simple body of a vehicle, with its plant; None for a vehicle that is not as simple."""
        if type(vehicle) is not SimulatedVehicle or type(vehicle.plant) is not FirstOrderPlant:
            return None
        simple = vehicle.is_simple and vehicle.plant.is_simple
        return cls(vehicle, vehicle.plant) if simple else None


class Ahead(NamedTuple):
    """Steps that were flown ahead, one after the other; all arrays have them first."""

    states: NDArray[np.void]
    """State of the vehicle, that before the first step included; shape (n + 1, axes)."""
    told: Array
    """Output of `fly_step`; shape (n, 8 axes)."""
    believed: Array
    """State that the server must assume, that after the last step included; shape (n + 1, axes,
    2)."""


class _Flying:
    """Arrays of a vehicle whose regular steps are compiled, and the objects that they stand in for.

    Args:
        scenario: scenario that is flown.
        navigation, compensator: those of the pilot.
        body: simulated vehicle.
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
        self._measured = slice(2 * axes, 4 * axes)
        self._known = slice(4 * axes, 6 * axes)
        self._inputs = slice(6 * axes, 7 * axes)
        self._parts = slice(7 * axes, 8 * axes)
        """Five slices of `_told`: true state, measured, flown by, input, input without feedback."""
        self.row: list[float] = []
        """Last output of `fly_step`."""
        self.step: int | None = None
        """Step that the arrays are at; None where they must not be used."""
        self._stage = self._lead_stage = 0
        """Stage of the plan that the vehicle is at, and stage up to which its prediction was
        advanced."""
        self._is_ahead = False
        """Whether the arrays are newer than the objects."""
        self._is_loaded = False
        """Whether the arrays are at least as new as the objects."""
        self._held: object = None
        self._guides: object = None
        self._calm: object = None
        """Horizon, spline and air that the arrays were filled from."""
        self._set_constants(scenario, change_max)

    def _set_constants(self, scenario: Scenario, change_max: float) -> None:
        """Fill in the constants of the flight."""
        terms, to, leaps = scenario.terms(), self._constants, self._navigation.leaps
        for name, numbers in zip(Axis._fields, zip(*self._plant.model, strict=True), strict=True):
            to[f"true_{name}"] = numbers
        for name, field in terms.model._asdict().items():
            to[name] = field
        to["true_gain"], to["bound"] = self._plant.gain, terms.u_max
        to["change_max"], to["dt_s"] = change_max, terms.dt_ns / SECOND_NS
        to["noise_m"], to["noise_mps"] = leaps.noise_m, leaps.noise_mps
        sensor = self._vehicle.sensor
        to["is_exact"] = sensor.is_exact
        to["sigma_p"], to["sigma_v"] = sensor.noise
        to["bias_p"], to["bias_v"] = sensor.bias
        if self._kalman is not None:
            to["filters"] = True
            to["variance_p"], to["variance_v"] = self._kalman.variances
            noises = [self._kalman.noise[kind] for kind in self._kalman.kinds]
            for name in ("pp", "pv", "vv", "ww"):
                to[f"noise_{name}"] = [getattr(noise, name) for noise in noises]

    def fly(self, step: int, before: Array, speed_max: float) -> list[float] | None:
        """Fly to the beginning of a step, and choose the input from there on.

        Args:
            step: the step after the one that the vehicle is at.
            before: input in force until then [m/s]; shape (axes,).
            speed_max: bound of the magnitude of the input's part without feedback [m/s].

        Returns:
            input of each axis [m/s]; None if the step is not regular: then nothing was changed.
        """
        compensator, weather, sensor = self._compensator, self._plant.weather, self._vehicle.sensor
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
            drawn[0],
            sensor.draw()[0],
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
        weather.pass_by()
        sensor.pass_by()
        self._now, self._after = self._after, self._now
        self._lead_stage = max(stage, self._lead_stage)
        self.step, self._is_ahead = step, True
        self.row = row
        self._navigation.note(pairs(row[self._known]))
        compensator.note(step, row[self._parts])
        return row[self._inputs]

    def look_ahead(self, steps: int, believed: Array) -> tuple[Ahead, Array]:
        """Steps after the one that the arrays are at, flown as if nothing happened.

        Nothing is changed; `go_on` goes there.

        Args:
            steps: most steps, at least 1.
            believed: state that the server must assume at the first of them [m, m/s]; shape (axes,
                2).

        Returns:
            those steps that are regular; and how far the vehicle is from the state that the server
            must assume [m, m/s], shape (n, axes, 2).
        """
        drawn = self._plant.weather.draw(steps)
        sensed = self._vehicle.sensor.draw(len(drawn))
        count, axes = len(sensed), len(self._now)
        states, told = np.empty((count + 1, axes), AXIS_STATE), np.empty((count, 8 * axes))
        assumed, apart = np.empty((count + 1, axes, 2)), np.empty((count, axes, 2))
        states[0], assumed[0] = self._now, believed
        flown = fly_ahead(
            self._constants,
            states,
            drawn[:count],
            sensed,
            self._plans,
            self._numbers,
            self._stage + 1,
            self._lead_stage,
            told,
            assumed,
            apart,
        )
        return Ahead(states, told[:flown], assumed), apart[:flown]

    def go_on(self, ahead: Ahead, count: int) -> list[float]:
        """Go on by so many steps that were flown ahead.

        Returns:
            input of each axis from there on [m/s].
        """
        assert self.step is not None
        weather, sensor = self._plant.weather, self._vehicle.sensor
        weather.pass_by(count)
        sensor.pass_by(count)
        self._now[:] = ahead.states[count]
        self._stage += count
        self._lead_stage = max(self._stage, self._lead_stage)
        self.step, self._is_ahead = self.step + count, True
        row = self.row = ahead.told[count - 1].tolist()
        self._navigation.note(pairs(row[self._known]))
        self._compensator.note(self.step, row[self._parts])
        return row[self._inputs]

    @property
    def can_look_ahead(self) -> bool:
        """Whether the arrays can fly ahead: the air that comes does not depend on chance twice."""
        return not self._plant.weather.has_gusts

    def foresee(self, believed: Array, silent: Array, told: Array, apart: Array) -> None:
        """Predict the state at the next step from the one that the arrays are at.

        The arguments are those of `believe_step`.
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
        """Copy the objects' state into the arrays."""
        now, self._is_loaded = self._now, True
        now["p"], now["v"] = zip(*self._plant.x, strict=True)
        now["z_p"], now["z_v"] = zip(*self._navigation.measured, strict=True)
        now["x_p"], now["x_v"] = zip(*self._navigation.estimate, strict=True)
        now["u"] = before
        self._held = None
        if self._kalman is not None:
            now["x_w"] = self._kalman.disturbance()
            spreads = [self._kalman.spreads[kind] for kind in self._kalman.kinds]
            for name, numbers in zip(Spread._fields, zip(*spreads, strict=True), strict=True):
                now[name] = numbers

    def _load_plan(self) -> None:
        """Copy the horizon or spline in force into the arrays."""
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
                    g.lag,
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
                    0,
                    h.disturbance,
                )
                for h in held
            ]

    def _load_air(self) -> None:
        """Copy the present wind into the arrays."""
        weather, to = self._plant.weather, self._constants
        self._calm, to["push"], to["windy"] = weather.calm, weather.calm.push, bool(weather.white)
        if weather.white:
            white = np.array(weather.white)
            to["shove_p"], to["shove_vp"] = white[:, 0, 0], white[:, 1, 0]
            to["shove_v"] = white[:, 1, 1]

    def leave(self) -> None:
        """Copy the arrays' state to the objects, and mark the arrays to be filled again."""
        self.tell()
        self._is_loaded, self.step = False, None

    def tell(self) -> None:
        """Copy the arrays' state to the objects."""
        if not self._is_ahead:
            return
        assert self.step is not None
        self._is_ahead = False
        compensator, now = self._compensator, self._now
        self._vehicle.flown_to(self.step)
        self._plant.x = pairs(self.row[self._states])
        self._navigation.measured = pairs(self.row[self._measured])
        position, velocity = map(list, zip(*self._navigation.measured, strict=True))
        measured = Measurement(self._vehicle.starts_ns(self.step), position, velocity)
        self._navigation.leaps.took(measured)
        if compensator.held is self._held and compensator.guides is self._guides:
            compensator.lead = list(
                zip(now["lead_p"].tolist(), now["lead_v"].tolist(), strict=True)
            )
            compensator.lead_stage = self._lead_stage
        if self._kalman is None:
            self._navigation.filter.take(measured)
            return
        known = (now[name].tolist() for name in ("x_p", "x_v", "x_w"))
        self._kalman.x = list(zip(*known, strict=True))
        spreads, kinds = now[list(Spread._fields)].tolist(), self._kalman.kinds
        self._kalman.spreads = [
            Spread(*spreads[kinds.index(kind)]) for kind in range(len(self._kalman.spreads))
        ]


def pairs(numbers: list[float]) -> list[tuple[float, float]]:
    """Numbers grouped in pairs."""
    return list(zip(numbers[::2], numbers[1::2], strict=True))


class _Belief(BelievedState):
    """State that the server must assume of a vehicle, predicted by the arrays while they are in
    use.
    """

    def __init__(self, terms: Terms, compensator: Compensator, flying: _Flying) -> None:
        super().__init__(terms, compensator)
        self._flying = flying
        self._believed, self._silent, self._told, self._apart = np.zeros((4, terms.axes, 2))
        self._is_array = False
        """Whether the state is in `_believed`."""
        self._foreseen: int | None = None
        """Step from which the arrays have predicted the next state."""

    @property
    def next(self) -> Array | None:
        """State at the next step [m, m/s], shape (axes, 2); None while it is in no array."""
        return self._believed if self._is_array else None

    def go_on(self, believed: Array) -> None:
        """Go on to a state at another step, that was predicted from `next`."""
        self._believed[:] = believed
        self._foreseen = None

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

    def lengths(self, apart: Array) -> Iterator[float]:
        """Distance of each step, see `off_m`, of what `fly_ahead` tells."""
        for each in apart.tolist():
            axes = zip(self._tau_s, each, strict=True)
            yield math.hypot(*(dp + tau * dv for tau, (dp, dv) in axes))

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
        """Whether the next state is predicted; if not, the objects can compute it."""
        if self._flying.step is not None and self._foreseen == self._flying.step:
            return True
        self._flying.tell()
        self._to_list()
        return False

    def _to_list(self) -> None:
        """Convert the state to the form that `BelievedState` uses."""
        if self._is_array:
            self._states, self._is_array = pairs(self._believed.ravel().tolist()), False


class CompiledPilot(Pilot):
    """Pilot of a simulated vehicle whose regular steps are compiled.

    After regular steps the arrays of `fly_step` are newer than the objects of a `Pilot`; the
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
        """Compiled flight of regular steps; None where they are not compiled."""
        if self._fence is None and self._navigation.is_simple:
            body = SimpleBody.of(vehicle)
            if body is not None:
                self._flying = _Flying(
                    scenario, self._navigation, self.compensator, body, self._change_max
                )
                self._belief = _Belief(self._terms, self.compensator, self._flying)
                self._reporter.belief = self._belief
        self._ahead: Ahead | None = None
        """Steps after `flown` that were flown ahead."""
        self._due: int | None = None
        """Step up to whose beginning the vehicle is still to be moved and measured."""

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
        """Measure up to the beginning of a step: now, or together with the choice of its input."""
        if self._due is not None:
            self._catch_up()
        if step and self._flying is not None:
            self._due = step
        else:
            super()._navigate(step)

    def _catch_up(self) -> None:
        """Bring the objects up to date, and let them fly on."""
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

    # -- steps that are flown ahead -----------------------------------------------------------

    @property
    def looks_ahead(self) -> bool:
        """Whether steps are flown ahead: on missions only, and not if every step is reported."""
        # Where horizons come several times a second most steps flown ahead are thrown away: in
        # batches of `demo` and `target` that took up to a tenth more time than it saved.
        return bool(self._terms.join) and not self._reporter.always

    def look_ahead(self, session: int, asked: int, *, now_ns: int) -> None:
        """Fly ahead over the steps after the one just flown at which nothing is sent or changed.

        Args:
            session, asked: see `observation`.
            now_ns: time of the step just flown.
        """
        flying = self._flying
        if flying is None or flying.step != self.flown:
            return
        if self._reporter.silent_until(asked) - self.flown < WORTHWHILE:
            return
        believed, failsafe, compensator = self._belief.next, self._failsafe, self.compensator
        # The bound of a braking vehicle's speed changes from step to step.
        brakes = failsafe.brakes and not compensator.covered and self._speed != 0.0
        if believed is None or brakes or not flying.can_look_ahead:
            return
        calm_ns = failsafe.calm_until_ns(now_ns)
        last = min(
            (calm_ns - self.starts_ns(0)) // self._dt_ns - 1,
            compensator.alike_until(self.flown),
            self._reporter.silent_until(asked),
            self.steps - 2,
        )
        steps = min(last - self.flown, AHEAD)
        if steps < WORTHWHILE:
            return
        ahead, apart = flying.look_ahead(steps, believed)
        off_m = self._belief.lengths(apart)
        silent = self._reporter.silent_for(session, failsafe.mode, asked, off_m)
        if silent:
            self._ahead = Ahead(ahead.states, ahead.told[:silent], ahead.believed)

    @property
    def steps_ahead(self) -> int:
        """Number of steps that were flown ahead."""
        return len(self._ahead.told) if self._ahead is not None else 0

    def forget(self) -> None:
        """Forget the steps that were flown ahead."""
        self._ahead = None

    def go_on(self, count: int, *, now_ns: int, keeps: bool) -> None:
        """Go on by some of the steps that were flown ahead.

        Args:
            count: number of these steps.
            now_ns: begin of the last of them.
            keeps: whether all others of them stay flown ahead; if not, they are forgotten.
        """
        ahead = self._ahead
        assert ahead is not None
        self._ahead = None
        if keeps and count < len(ahead.told):
            states, rows, believed = ahead
            self._ahead = Ahead(states[count:], rows[count:], believed[count:])
        if not count:
            return
        assert self._flying is not None
        first, self.flown = self.flown + 1, self.flown + count
        self.step = self.flown
        inputs = self._flying.go_on(ahead, count)
        self._belief.go_on(ahead.believed[count])
        self._reporter.was_silent(self.flown)
        self._flown_ns = self.starts_ns(self.flown)
        # Between the first and the last of them it changes nothing either.
        self._failsafe.step(late_ns=0, hindrance=None, now_ns=now_ns)
        compensator = self.compensator
        told = compensator.told if compensator.feeds_back else inputs
        self._input = self._settled(inputs, told, math.inf, now_ns)
        self._vehicle.fly(self._input)
        self.step, self.next_ns = self.flown + 1, self._flown_ns + self._dt_ns
        if compensator.covered:
            self.covered += count
            self._covered_last = self.step
        self._record_many(first, ahead.told[:count])

    def _record_many(self, first: int, told: Array) -> None:
        """Record steps that were flown ahead.

        Args:
            first: number of the first of them.
            told: output of `fly_step` at each; shape (n, 8 axes).
        """
        if self._recorder is None:
            return
        compensator, axes, count = self.compensator, self._terms.axes, len(told)
        steps = np.arange(first, first + count)
        states = told[:, : 6 * axes].reshape(count, 3, axes, 2)
        observed = compensator.observed
        self._recorder.append(
            count,
            vehicle=self._number,
            step=steps,
            state=states[:, 0],
            measured=states[:, 1],
            estimate=states[:, 2],
            input=told[:, 6 * axes : 7 * axes],
            covered=compensator.covered,
            in_force=compensator.in_force,
            age_ns=-1 if observed < 0 else (steps - observed) * self._dt_ns,
            stale=compensator.stale,
            missed=self.missed,
            mode=self._failsafe.mode,
            reason=self._failsafe.reason,
        )

    def _is_usual(self) -> bool:
        """Whether the vehicle flies the plan's input, and its state is known."""
        mode = self._failsafe.mode
        usual = mode is not Mode.LAND and mode not in STOPPED and self._navigation.is_known
        return usual and not self._is_to_rest()
