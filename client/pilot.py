"""Pilot: flies the chosen input at every step, and records the step.

The client's clock is the flight's clock: the epoch is the time at which the flight began, step k
begins at epoch + k Δt, and all time stamps used for control are on this clock. `client.failsafe`
decides what the vehicle may do, `client.compensator` computes the input from the plan, and
`client.clamp` bounds that input.
"""

import math
from typing import Any

import numpy as np

from skytether.client.alone import MotionInForce
from skytether.client.clamp import Guard, clamped
from skytether.client.compensator import Compensator
from skytether.client.failsafe import DROPPING, LATE_SHARE, Failsafe, Transition
from skytether.client.followers import SplineFollower
from skytether.client.navigation import Navigation
from skytether.client.reporting import Reporter
from skytether.client.session import ServerSession
from skytether.client.vehicle import Vehicle
from skytether.shared.base.units import MICROSECOND_NS, MILLISECOND_NS, SECOND_NS
from skytether.shared.law.model import ALTITUDE, Array
from skytether.shared.law.rule import braked
from skytether.shared.scenario.gain import regulator
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason, Recorder
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import (
    NO_HORIZON,
    NO_INPUT,
    Horizon,
    Mode,
    Observation,
    Trajectory,
    stamp_us,
)

LAND_MPS = 0.5
"""Speed of descent when landing [m/s]."""
STOPPED = (Mode.FAULT, Mode.MANUAL)
"""Modes in which the input becomes zero at once, without braking."""
HOVERING = frozenset({Mode.INIT, Mode.SYNC, Mode.READY, Mode.HOVER, Mode.LAND})
"""Modes in which a vehicle holds its position, or lands there."""
UNPLACED = frozenset({Reason.MUTE, Reason.UNUSABLE, Reason.ASTRAY})
"""Reasons for hovering that mean that the vehicle's position is unknown."""
IMPOSSIBLE = frozenset({Drop.FROM_THE_FUTURE, Drop.OBSERVATION})
"""Reasons for dropping a plan that was made for a step, or from an observation, in the future."""


class Pilot:
    """Flies one vehicle, with or without a plan."""

    def __init__(
        self,
        scenario: Scenario,
        number: int,
        vehicle: Vehicle,
        failsafe: Failsafe,
        recorder: Recorder | None,
    ) -> None:
        self._terms = scenario.terms()
        self._dt_ns, self._keeps_apart = self._terms.dt_ns, scenario.keeps_apart
        self._splines = self._terms.splines
        self._late = LATE_SHARE * self._terms.reach
        """A plan counts as late if more than this number of its steps has passed."""
        self.steps = scenario.steps
        self._number, self._vehicle = number, vehicle
        self._navigation = Navigation(scenario)
        self._failsafe = failsafe
        self._recorder = recorder
        self._holds = scenario.keeps_apart or (vehicle.drifts and failsafe.brakes)
        """Whether a hovering vehicle holds its position by feedback. With a velocity command of
        zero it would drift, but other vehicles of a mission avoid only its position."""
        along = regulator(scenario) if self._splines or self._holds else None
        self.compensator = Compensator(self._terms, along)
        self._reporter = Reporter(self._terms, scenario.vehicle.report, self.compensator)
        self._fence: Guard | None = None
        for section in scenario.sections():
            if module := section.guard():
                self._fence = load(module, "fence").Fence(scenario)
        # The paper's vehicle does not bound the change of the input: with `exhausted = "hold"` the
        # clamp only keeps the input finite and bounded.
        self._change_max = (
            math.inf
            if self._terms.exhausted == "hold"
            else scenario.vehicle.slew_mps2 * self._terms.dt_s
        )
        """Largest change of the input from step to step [m/s]."""
        self._epoch_ns: int | None = None
        self.next_ns: int | None = None
        """Time at which the next step begins [ns]; None before the flight."""
        self.step = 0
        self.flown = 0
        """Step flown last; the estimate includes all measurements up to its start."""
        self._flown_ns = 0
        self._takes_from: int | None = None
        """Step of the first observation that announced that plans are accepted; None while plans
        are refused."""
        self._input = np.zeros(self._terms.axes)
        """Desired velocity flown now [m/s]; shape (axes,)."""
        self._speed = 0.0
        """Magnitude of the part of the input that is not feedback [m/s]."""
        self.covered = 0
        self._covered_last = 0
        """Step after the last step with a planned input."""
        self.missed = 0
        self.late_ns = self.latest_ns = 0
        """Lateness of the present step, and the largest lateness so far [ns]."""
        self.transitions: list[Transition] = []
        """Transitions of the failsafe on which the pilot has acted; the log reports them."""
        self.leap_m: tuple[float, ...] | None = None
        """Leap about which no operator has decided yet: displacement on each axis [m], empty if
        only the velocity has leapt. None without a leap."""

    @property
    def without_ns(self) -> int:
        return (self.step - self._covered_last) * self._dt_ns

    @property
    def disturbance(self) -> Array:
        return self._navigation.disturbance

    @property
    def began_ns(self) -> int:
        return self._epoch_ns or 0

    def starts_ns(self, step: int) -> int:
        assert self._epoch_ns is not None
        return self._epoch_ns + step * self._dt_ns

    def begin(self, *, now_ns: int, began_ns: int | None = None) -> None:
        """Begin the flight, or continue an earlier run's; `began_ns`: start of step 0 [ns]."""
        if began_ns is None:
            self._epoch_ns = self.next_ns = now_ns
            self._navigate(0)
            return
        self._epoch_ns = began_ns
        self.step = self._covered_last = -(-(now_ns - began_ns) // self._dt_ns)
        self.flown, self.next_ns = self.step - 1, self.starts_ns(self.step)
        if self._goes_on(self.step):
            self.steps = max(self.steps, self.compensator.last_step + 1)

    # -- plans -------------------------------------------------------------------------------

    def offer(self, horizon: Horizon | Trajectory, *, now_ns: int) -> None:
        """Put a plan in force if it is the newest plan and may be flown.

        A plan made before the server knew that plans are accepted is dropped, because it does not
        start at the vehicle's position.

        Raises:
            ProtocolError: the plan is dropped.
        """
        if self._failsafe.transitions:
            self.obey()
        terms = self._terms
        # An overtaken plan is always late, so it says nothing about the newest plan's delay.
        if horizon.step > self.compensator.newest:
            passed = self.step - horizon.step
            if isinstance(horizon, Horizon):
                # The committed inputs come first, and usually their steps are over on arrival.
                passed -= horizon.inputs.shape[1] - terms.planned
            self._failsafe.horizon_arrived(late=passed > self._late, now_ns=now_ns)
        observed = horizon.step - horizon.age
        takes_from = self._takes_from if self._failsafe.takes else None
        if takes_from is None or 0 <= observed < takes_from:
            raise ProtocolError(Drop.NOT_TAKEN)
        try:
            is_held = self.compensator.offer(horizon, self.step, observed)
        except ProtocolError as error:
            if error.reason in IMPOSSIBLE:
                self._failsafe.future(now_ns=now_ns)
            raise
        if is_held:
            self._failsafe.horizon_taken(now_ns=now_ns)
            if self._keeps_apart:
                self._failsafe.motion_goes_on(self._goes_on(self.step), now_ns=now_ns)

    def _goes_on(self, step: int) -> bool:
        """Whether the vehicle follows a mission's motion whose last knot lies after `step`."""
        return self._keeps_apart and step < self.compensator.last_step

    def motion_in_force(self) -> MotionInForce | None:
        """The mission's motion that is in force; None without one."""
        compensator = self.compensator
        flown = compensator.follower
        if not self._keeps_apart or compensator.in_force == NO_HORIZON:
            return None
        assert isinstance(flown, SplineFollower)
        return MotionInForce(
            compensator.in_force,
            compensator.observed,
            compensator.flown_since(self.step),
            flown.spacing,
            flown.sent.tobytes(),
        )

    @property
    def is_moving(self) -> bool:
        """Whether a mission's motion is in force and its last knot is still ahead."""
        return self._goes_on(self.step)

    def rest(self, *, now_ns: int) -> int:
        """Accept no further motion; return the time by which the vehicle is at rest [ns]."""
        self._failsafe.meet(Reason.OVER, now_ns=now_ns)
        last = self.compensator.last_step
        return self.starts_ns(last) if self._goes_on(self.step) else now_ns

    def obey(self) -> None:
        """Act on the transitions of the failsafe since the last call, if there are any."""
        transitions = self._failsafe.transitions
        for each in transitions:
            if not each.takes:
                self._takes_from = None
            if each.cause in DROPPING:
                self._drop()
            if each.after is Mode.LAND:
                self._vehicle.land()
            elif each.after is Mode.RETURN:
                self._vehicle.return_home()
        self.transitions += transitions
        transitions.clear()

    def _drop(self) -> None:
        """Drop the plan, or stop holding a position, and brake from the present input."""
        self.compensator.drop(self.step - 1, self._input)
        self._speed = math.hypot(*self._input.tolist())

    # -- steps -------------------------------------------------------------------------------

    def fly(self, *, now_ns: int) -> None:
        """Fly the present step; during missed steps the vehicle went on with the previous input."""
        assert self._epoch_ns is not None
        assert self.next_ns is not None
        # A client that wakes after the end of its flight still flies the last step.
        present = min((now_ns - self._epoch_ns) // self._dt_ns, self.steps - 1)
        self.missed += present - self.step
        # The filter predicts one step at a time, so it passes through missed steps one by one.
        for step in range(self.flown, present):
            self._navigate(step + 1)
        self.late_ns = now_ns - self.next_ns
        self.latest_ns = max(self.latest_ns, self.late_ns)
        self.flown = self.step = present
        self._flown_ns = self._epoch_ns + present * self._dt_ns
        self._meet_causes(now_ns)
        if self._holds and self._failsafe.mode in HOVERING:
            self._rest()
        flown, speed, is_finite = self._compose_input()
        if not is_finite:
            self._failsafe.meet(Reason.NOT_FINITE, now_ns=now_ns)
        elif self.compensator.in_force != NO_HORIZON and not self.compensator.covered:
            self._failsafe.meet(Reason.ENDED, now_ns=now_ns)
        if not speed:
            self._failsafe.meet(Reason.BRAKED, now_ns=now_ns)
        if self._failsafe.transitions:
            self.obey()
        self._input, self._speed = np.array(flown), speed
        self._vehicle.fly(self._input)
        if not self._failsafe.takes:
            self._takes_from = None
        elif self._takes_from is None:
            self._takes_from = present
        self.step, self.next_ns = present + 1, self._flown_ns + self._dt_ns
        if self.compensator.covered:
            self.covered += 1
            self._covered_last = self.step
        self._record()

    def _navigate(self, step: int) -> None:
        assert self._epoch_ns is not None
        now_ns = self._epoch_ns + step * self._dt_ns
        measurements = self._vehicle.measurements(now_ns=now_ns)
        self._navigation.advance(measurements, self._input, now_ns=now_ns)

    def _meet_causes(self, now_ns: int) -> None:
        """Report to the failsafe what may change the mode at this step (lateness, a hindrance, an
        unknown state, a leap), and obey its transitions.
        """
        failsafe, navigation = self._failsafe, self._navigation
        hindrance = self._vehicle.hindrance(now_ns=now_ns)
        if self._keeps_apart:
            failsafe.motion_goes_on(self._goes_on(self.step), now_ns=now_ns)
        failsafe.step(late_ns=self.late_ns, hindrance=hindrance, now_ns=now_ns)
        if failsafe.transitions:
            self.obey()
        if self.step == self.steps - 1 and self._goes_on(self.step):
            # A flight whose last step is before the motion's last knot is prolonged to that knot.
            failsafe.meet(Reason.OVER, now_ns=now_ns)
            self.steps = self.compensator.last_step + 1
        if not navigation.is_known:
            failsafe.meet(Reason.NOT_FINITE, now_ns=now_ns)
        if self._vehicle.leap_m is not None:
            self.leap_m = self._vehicle.leap_m
            failsafe.leapt(now_ns=now_ns)
        elif navigation.leapt:
            self.leap_m = tuple(navigation.leaps.off_m)
            failsafe.leapt(now_ns=now_ns)
            if self.compensator.rests:
                self._drop()
        if failsafe.transitions:
            self.obey()

    def _compose_input(self) -> tuple[list[float], float, bool]:
        """Input of the present step: the compensator's input, bounded by mode, clamp and fence.

        Returns:
            input of each axis [m/s]; speed at which braking continues at the next step [m/s]; and
            whether the compensator's input is finite: if not, the returned input is zero.
        """
        mode, terms, compensator = self._failsafe.mode, self._terms, self.compensator
        navigation, had_plan = self._navigation, compensator.covered
        # `choose` has advanced the compensator to this step.
        wanted, without_feedback = compensator.choose(
            self.step, navigation.predicted, navigation.disturbance, self._input
        )
        if mode is Mode.LAND:
            wanted = wanted if compensator.rests else [0.0] * terms.axes
            if terms.axes > ALTITUDE and navigation.estimate[ALTITUDE, 0] > 0.0:
                wanted[ALTITUDE] = -LAND_MPS
        feeds_back = compensator.follower.feeds_back
        if not feeds_back:
            without_feedback = wanted
        speed_max = math.inf
        if not compensator.covered and self._failsafe.brakes and mode is not Mode.LAND:
            speed_max = braked(self._speed, 0 if had_plan else 1, terms.brake)
        flown = clamped(
            wanted,
            self._input.tolist(),
            terms.u_max,
            self._change_max,
            without_feedback=without_feedback,
            speed_max=speed_max,
        )
        if flown is None or mode in STOPPED:
            return [0.0] * terms.axes, 0.0, flown is not None
        # `speed` is the speed from which braking continues. It excludes the feedback, which only
        # u_max bounds (docs/failsafe.md), and the fence's correction, which may never end.
        speed = min(math.hypot(*without_feedback), speed_max) if feeds_back else math.hypot(*flown)
        if self._fence is not None:
            within = self._fence.limited(flown, navigation.predicted.tolist(), terms.u_max)
            if mode is Mode.LAND and terms.axes > ALTITUDE:
                within[ALTITUDE] = flown[ALTITUDE]  # the fence does not stop a landing
            flown = within
        return flown, speed, True

    def _rest(self) -> None:
        """Let a vehicle that hovers without a plan hold the position at which it comes to rest."""
        if self._is_to_rest() and self._navigation.is_known:
            place = self._navigation.predicted.copy()
            if not self._keeps_apart:
                place[:, 0] += np.array(self._terms.tau_s) * place[:, 1]
            self.compensator.rest(self.step, place)

    def _is_to_rest(self) -> bool:
        failsafe, compensator = self._failsafe, self.compensator
        is_free = compensator.in_force == NO_HORIZON and not compensator.rests
        if not is_free:
            return False
        # After a change of frame the estimate is in the old frame until a new position arrives.
        is_measured = bool(np.isfinite(self._navigation.measured[:, 0]).all())
        return is_measured and (self._keeps_apart or failsafe.reason not in UNPLACED)

    def decide(self, *, keeps_frame: bool) -> None:
        self._vehicle.decide(keeps_frame=keeps_frame)
        if not keeps_frame:
            self._navigation.begin_anew()
            if self.compensator.rests:
                self._drop()
        self._failsafe.decide()
        self.leap_m = None

    @property
    def is_held(self) -> bool:
        """Whether the fence limits the vehicle; False while it lands or somebody else flies it."""
        holds = self._fence is not None and self._fence.holds
        return holds and self._failsafe.mode not in (*STOPPED, Mode.LAND, Mode.RETURN)

    # -- observation and record --------------------------------------------------------------

    def observation(self, session: ServerSession) -> Observation | None:
        """Observation of the present step; None if none is due or the state is unknown."""
        if session.number is None or not self._navigation.is_known:
            return None
        due = self._reporter.is_due(
            session.number,
            self.flown,
            self._failsafe.mode,
            self._navigation.predicted,
            self._input,
            session.silence_asked,
        )
        return self.observe(session) if due else None

    def observe(self, session: ServerSession) -> Observation | None:
        """Observation of the present step; None without a session or if the state is unknown."""
        failsafe, compensator = self._failsafe, self.compensator
        if session.number is None or not self._navigation.is_known:
            return None
        echo = session.clock.echo
        backward_ns = echo.received_ns - self.starts_ns(0) - echo.server_ns
        return Observation(
            self._number,
            session.number,
            self.flown,
            compensator.in_force,
            compensator.since,
            stamp_us(
                backward_ns + MICROSECOND_NS - 1
            ),  # rounded up, so that no delay is reported too short
            echo.heard,
            failsafe.mode,
            int(failsafe.takes),
            self._navigation.predicted,
            NO_INPUT if self._splines else self._input,
            session.sent,
            session.silence,
        )

    def _record(self) -> None:
        if self._recorder is None:
            return
        compensator, failsafe, navigation = self.compensator, self._failsafe, self._navigation
        observed, truth = compensator.observed, self._vehicle.truth()
        self._recorder.append_row(
            self._number,
            self.flown,
            *(navigation.estimate if truth is None else truth).ravel().tolist(),
            *navigation.measured.ravel().tolist(),
            *navigation.predicted.ravel().tolist(),
            *self._input.tolist(),
            compensator.covered,
            compensator.in_force,
            -1 if observed < 0 else (self.flown - observed) * self._dt_ns,
            compensator.stale,
            self.missed,
            failsafe.mode,
            failsafe.reason,
        )

    def figures(self) -> dict[str, Any]:
        """Figures of the flight so far; they include ages only while a plan is in force."""
        figures: dict[str, Any] = {
            "mode": str(self._failsafe.mode),
            "step": self.step,
            "steps": self.steps,
            "missed": self.missed,
            "late_ms": self.latest_ns / MILLISECOND_NS,
            "began_s": self.began_ns / SECOND_NS,
        }
        compensator = self.compensator
        if compensator.observed >= 0:
            age_ns = (self.flown - compensator.observed) * self._dt_ns
            plan_age_ns = (self.flown - compensator.in_force) * self._dt_ns
            figures["age_ms"] = age_ns / MILLISECOND_NS
            figures["plan_age_ms"] = plan_age_ns / MILLISECOND_NS
        return figures
