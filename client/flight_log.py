"""Log events of a vehicle in flight: changes of mode, leaps, the fence, late steps, and the end.

`client.ground` has the events of a vehicle on the ground.
"""

from collections.abc import Sequence

from skytether.client.alone import OneServer
from skytether.client.failsafe import GOOD_NS, STALL_NS, Failsafe, Transition
from skytether.client.pilot import Pilot
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Events
from skytether.shared.events.flight import (
    FenceHolds,
    Finished,
    ModeChanged,
    NotFlown,
    StateLeapt,
    SteppedLate,
)
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason

HELD_AGAIN_NS = 5 * SECOND_NS
"""Interval at which the log repeats that the fence limits the vehicle [ns]."""
PLANLESS = frozenset({Reason.OPENED, Reason.GOOD, Reason.HORIZON, Reason.OLD, Reason.ENDED})
"""Reasons of a mode that do not say why no newer plan has arrived; the log adds why."""


class FlightLog:
    """Reporter of one vehicle in flight; it appends log events to `events`."""

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int,
        pilot: Pilot,
        failsafe: Failsafe,
        servers: OneServer,
        events: Events,
    ) -> None:
        self._vehicle, self._pilot, self._failsafe = vehicle, pilot, failsafe
        self._servers, self._events = servers, events
        self._keeps_apart = scenario.keeps_apart
        self._land_after_s = scenario.vehicle.land_after_s
        self._timeout_ns = seconds_to_ns(scenario.link.timeout_s)
        self._fence_report_ns = 0
        """Time before which the fence is not reported again."""
        self._latest_ns = 0
        """Largest lateness of a step so far [ns]."""
        self._reported_leap: tuple[float, ...] | None = None
        self.failure: NotFlown | None = None
        """Event of a failed flight; None if the flight succeeded or has not ended."""

    def report_transitions(self, transitions: Sequence[Transition], now_ns: int) -> None:
        """Report changes of mode or reason.

        Coasting that ends with a newer plan is not reported: with a trigger it is normal.
        """
        for each in transitions:
            coasts = each.reason_before is Reason.OLD and each.cause is Reason.HORIZON
            if each.cause is Reason.OLD or coasts:
                continue
            ended = each.reason is Reason.ENDED
            self._events.append(
                ModeChanged(
                    vehicle=self._vehicle,
                    before=str(each.before),
                    after=str(each.after),
                    reason=self._why_no_plan(each.reason, now_ns) if ended else str(each.reason),
                )
            )

    def _why_no_plan(self, reason: Reason, now_ns: int) -> str:
        if reason not in PLANLESS:
            return str(reason)
        is_lost = self._failsafe.is_lost(now_ns)
        return str(Reason.LOST) if is_lost else str(self._servers.followed.idle)

    def report_step(self, now_ns: int) -> None:
        """Report if the newest step was late, was limited by the fence, or had a leap."""
        pilot = self._pilot
        if self._keeps_apart and pilot.late_ns > max(STALL_NS, self._latest_ns):
            late_s = pilot.late_ns / SECOND_NS
            self._events.append(SteppedLate(vehicle=self._vehicle, late_s=late_s))
        self._latest_ns = pilot.latest_ns
        if pilot.is_held and now_ns >= self._fence_report_ns:
            self._fence_report_ns = now_ns + HELD_AGAIN_NS
            self._events.append(FenceHolds(vehicle=self._vehicle))
        if pilot.leap_m != self._reported_leap:
            self._report_leap(pilot.leap_m)

    def _report_leap(self, leap_m: tuple[float, ...] | None) -> None:
        self._reported_leap = leap_m
        if leap_m is not None and self._failsafe.has_leapt:
            # After a leap the failsafe waits GOOD_NS longer than after a lost link.
            after_s = self._land_after_s + GOOD_NS / SECOND_NS if self._land_after_s else 0.0
            event = StateLeapt(vehicle=self._vehicle, by_m=leap_m, land_after_s=after_s)
            self._events.append(event)

    def report_end(self, now_ns: int) -> None:
        """Report that the flight has finished, or has failed because it had no plan at its end."""
        pilot, vehicle = self._pilot, self._vehicle
        if pilot.covered and pilot.without_ns <= self._timeout_ns:
            finished = Finished(vehicle=vehicle, steps=pilot.steps, missed=pilot.missed)
            self._events.append(finished)
        else:
            covered, why = pilot.covered, self._why_no_plan(self._failsafe.reason, now_ns)
            self.failure = NotFlown(vehicle=vehicle, covered=covered, steps=pilot.steps, why=why)
            self._events.append(self.failure)
