"""Failsafe: the vehicle's mode, decided aboard by a transition table and a few timers.

    INIT → SYNC → READY → TRACK ⇄ COAST → BRAKE → HOVER → LAND            and FAULT, which is final

`TRANSITIONS` maps mode and cause to the next mode; a pair that is missing changes nothing. `HOLD`
is the table without a failsafe, for a vehicle that repeats its last input for ever, like the
paper's. `Failsafe` detects the causes that need a timer: a good link, silence, late plans, repeated
errors. `client.pilot` chooses the input in each mode.
"""

import math
from collections import deque
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.law.terms import Terms
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.protocol import Mode

GOOD_NS = SECOND_NS
"""Time for which the link has to be good before plans are accepted [ns]."""
STALL_NS = 100 * MILLISECOND_NS
"""Lateness of a step above which the plan counts as too old, whatever delayed the step [ns]."""
LATE_NS = 500 * MILLISECOND_NS
"""Time for which all plans have to arrive late before the vehicle brakes [ns]."""
LATE_SHARE = 0.75
"""A plan counts as late if more than this share of its planned inputs has passed when it
arrives."""
WINDOW_NS = SECOND_NS
"""Window in which errors of the server are counted."""
MALFORMED_MAX = 5
"""Number of malformed messages within `WINDOW_NS` that make the vehicle brake."""
FUTURE_MAX = 10
"""Number of impossible plans (`Failsafe.future`) in `WINDOW_NS` that make the client reconnect."""
BRAKE_SPARE_NS = 500 * MILLISECOND_NS
"""Margin added to the computed time of braking [ns]."""

YIELDING = frozenset({Reason.TAKEN, Reason.DISARMED})
"""Causes after which the client no longer flies: a pilot took over, or the motors are disarmed."""
GROUNDING = frozenset({Reason.BATTERY, Reason.ASTRAY, Reason.RIVAL, Reason.STRAYED})
BROKEN = frozenset(
    {
        Reason.LOST,
        Reason.CLOSED,
        Reason.RESTARTED,
        Reason.MALFORMED,
        Reason.RESYNC,
        Reason.MUTE,
        Reason.UNUSABLE,
    }
)
"""Causes after which the link has to be good for `GOOD_NS` again, in every mode."""
LOCKING = BROKEN | GROUNDING | YIELDING | {Reason.LATE, Reason.RETURNED}
"""Causes of braking after which plans are refused until the vehicle hovers and the link is good."""
CLOSING = frozenset({Reason.CLOSED, Reason.RESYNC})
"""Causes that end the session, so that another WELCOME is needed."""
DROPPING = LOCKING | {Reason.STALLED, Reason.NOT_FINITE, Reason.UNARMED, Reason.LEAPT}
"""Causes that drop the plan in force."""

AT_ONCE = YIELDING | {
    Reason.NOT_FINITE,
    Reason.UNARMED,
    Reason.LEAPT,
    Reason.MUTE,
    Reason.UNUSABLE,
    Reason.ASTRAY,
    Reason.RIVAL,
    Reason.STRAYED,
}
"""Causes that end a mission's motion before its last knot: the vehicle cannot follow the motion, or
a person intervenes. Every other cause waits for the last knot, see `Failsafe.meet`."""

HANGING = frozenset({Mode.SYNC, Mode.READY, Mode.HOVER})
FOLLOWING = frozenset({Mode.TRACK, Mode.COAST})
"""Modes in which a plan is flown."""
KEPT = frozenset({Reason.BRAKED, Reason.WAITED})
"""Causes that do not replace the reason for braking or hovering."""

CALM = frozenset({Mode.TRACK, Mode.COAST, Mode.HOVER})
"""Modes that may last for many steps while the vehicle is in the air."""

Table = Mapping[tuple[Mode, Reason], Mode]

_FAULTS = {(mode, Reason.NOT_FINITE): Mode.FAULT for mode in Mode if mode is not Mode.FAULT}
_TO_BRAKE = (
    BROKEN | GROUNDING | {Reason.ENDED, Reason.LATE, Reason.STALLED, Reason.UNARMED, Reason.LEAPT}
)
# INIT is left out, because the client flies nothing yet; so are LAND, RETURN and FAULT, which end
# only with a restart.
_YIELDS = {
    (mode, cause): Mode.MANUAL
    for mode in Mode
    if mode not in (Mode.INIT, Mode.LAND, Mode.RETURN, Mode.FAULT)
    for cause in YIELDING
}

TRANSITIONS: Table = MappingProxyType(
    {
        (Mode.INIT, Reason.OPENED): Mode.SYNC,
        (Mode.INIT, Reason.RESUMED): Mode.TRACK,
        (Mode.INIT, Reason.LOST): Mode.HOVER,
        (Mode.SYNC, Reason.GOOD): Mode.READY,
        (Mode.READY, Reason.UNARMED): Mode.READY,
        (Mode.READY, Reason.GOOD): Mode.READY,
        (Mode.READY, Reason.HORIZON): Mode.TRACK,
        (Mode.TRACK, Reason.HORIZON): Mode.TRACK,
        (Mode.TRACK, Reason.OLD): Mode.COAST,
        (Mode.TRACK, Reason.OVER): Mode.HOVER,
        (Mode.COAST, Reason.OVER): Mode.HOVER,
        (Mode.COAST, Reason.HORIZON): Mode.TRACK,
        (Mode.BRAKE, Reason.HORIZON): Mode.TRACK,
        (Mode.BRAKE, Reason.BRAKED): Mode.HOVER,
        (Mode.HOVER, Reason.HORIZON): Mode.TRACK,
        (Mode.HOVER, Reason.GOOD): Mode.HOVER,
        (Mode.HOVER, Reason.LEAPT): Mode.HOVER,
        (Mode.MANUAL, Reason.RETURNED): Mode.HOVER,
    }
    | {
        (mode, cause): Mode.LAND
        for mode in (Mode.SYNC, Mode.READY, Mode.HOVER)
        for cause in GROUNDING
    }
    | {(mode, cause): Mode.LAND for mode in HANGING for cause in (Reason.ALONE, Reason.WAITED)}
    | {(mode, Reason.HOMEWARD): Mode.RETURN for mode in HANGING}
    # LOST is left out, because in SYNC the vehicle waits for a link in any case.
    | {(Mode.SYNC, cause): Mode.SYNC for cause in BROKEN - {Reason.LOST}}
    | {(Mode.READY, cause): Mode.SYNC for cause in BROKEN}
    | {(Mode.TRACK, cause): Mode.BRAKE for cause in _TO_BRAKE}
    | {(Mode.COAST, cause): Mode.BRAKE for cause in _TO_BRAKE}
    | {(Mode.BRAKE, cause): Mode.BRAKE for cause in BROKEN | GROUNDING}
    | {(Mode.HOVER, cause): Mode.HOVER for cause in BROKEN}
    | _YIELDS
    | _FAULTS
)
"""Transition table of the failsafe: next mode by current mode and cause. If the mode stays the
same, only the reason changes."""

HOLD: Table = MappingProxyType(
    {
        (Mode.INIT, Reason.OPENED): Mode.READY,
        (Mode.READY, Reason.UNARMED): Mode.READY,
        (Mode.READY, Reason.HORIZON): Mode.TRACK,
        (Mode.TRACK, Reason.HORIZON): Mode.TRACK,
        (Mode.TRACK, Reason.OLD): Mode.COAST,
        (Mode.TRACK, Reason.ENDED): Mode.COAST,
        (Mode.COAST, Reason.ENDED): Mode.COAST,
        (Mode.COAST, Reason.HORIZON): Mode.TRACK,
        (Mode.MANUAL, Reason.RETURNED): Mode.READY,
    }
    | _YIELDS
    | _FAULTS
)
"""Transition table for `vehicle.exhausted = "hold"`: the vehicle never brakes or lands by
itself."""


def brake_ns(terms: Terms) -> int:
    """Longest time of braking [ns]: from u_max on all axes to rest, plus BRAKE_SPARE_NS."""
    steps = math.ceil(math.hypot(*terms.u_max) / terms.brake) if terms.brake else 0
    return steps * terms.dt_ns + BRAKE_SPARE_NS


class Transition(NamedTuple):
    """Change of the mode, or of the reason for it."""

    before: Mode
    reason_before: Reason
    after: Mode
    reason: Reason
    cause: Reason
    """Cause of the change; a cause in `KEPT` does not become the reason."""
    takes: bool
    """Whether plans are accepted from now on."""


class Failsafe:
    """Mode of one vehicle, and the reason for it.

    Args:
        table: `TRANSITIONS` or `HOLD`.
        armed: whether plans may be flown at all.
        timeout_ns: time of silence after which the link counts as lost, and time without a newer
            plan after which the vehicle coasts [ns].
        brake_ns: longest time of braking, after which the vehicle hovers even if wind still
            pushes it [ns].
        land_after_ns: time for which a hovering vehicle waits for a good link, a ready autopilot or
            an operator before it lands [ns]; 0: without end.
        returns: whether the vehicle returns home instead of landing if the server is silent.
    """

    def __init__(
        self,
        table: Table,
        *,
        armed: bool,
        timeout_ns: int,
        brake_ns: int,
        land_after_ns: int,
        returns: bool = False,
    ) -> None:
        self._table = table
        self.brakes = table is TRANSITIONS
        """Whether the vehicle brakes when it has no plan, instead of repeating its last input."""
        self.armed = armed
        self._timeout_ns, self._brake_ns = timeout_ns, brake_ns
        self._land_after_ns = land_after_ns
        self._alone = Reason.HOMEWARD if returns else Reason.ALONE
        """Cause that ends hovering after a long silence of the server."""
        self.transitions: list[Transition] = []
        """Transitions on which the pilot has not acted yet, oldest first. The pilot acts after each
        packet and in each step, so the list is short: at most 5 in tests with faults."""
        self.mode = Mode.INIT
        self.reason = Reason.BEGUN
        """Newest cause that changed mode or reason; while hovering, why the vehicle braked."""
        self._heard_ns: int | None = None
        self._good_ns = 0
        """Time at which the link became good; valid only while the link is good."""
        self._horizon_ns = 0
        self._late_ns: int | None = None
        """Time since which all plans have been late; None if the newest plan was in time."""
        self._began_ns = 0
        self._waits_ns = 0
        """Start of the wait for a good link, a ready autopilot or an operator."""
        self._malformed: deque[int] = deque(maxlen=MALFORMED_MAX)
        self.has_leapt = False
        """Whether the measured state has leapt, and no operator has decided about the leap yet."""
        self.stays = False
        """Whether an operator has chosen that the vehicle hovers on after a leap instead of
        landing."""
        self._future: deque[int] = deque(maxlen=FUTURE_MAX)
        """Times at which the newest impossible plans arrived, see `future`."""
        self.keeps_motion = False
        """Whether a mission's motion is in force and its last knot is still ahead."""
        self.postponed: Reason | None = None
        """First cause postponed to the last knot of the motion in force; None if there is none."""

    @property
    def heard_ns(self) -> int | None:
        return self._heard_ns

    @property
    def takes(self) -> bool:
        """Whether a plan that arrives now is flown."""
        may = (self.mode, Reason.HORIZON) in self._table
        # A postponed STALLED does not refuse plans: after a stall of the vehicle's computer a newer
        # motion is better than the one in force. With any other postponed cause, the motion in
        # force is flown to its end.
        may = may and self.postponed in (None, Reason.STALLED)
        return may and self.armed and not self.has_leapt and self.reason not in LOCKING

    def is_lost(self, now_ns: int) -> bool:
        return self._heard_ns is None or now_ns - self._heard_ns > self._timeout_ns

    def _is_good(self, now_ns: int) -> bool:
        """Whether a packet of the session has arrived within two thirds of the time-out.

        A heartbeat is sent at least every third of the time-out (`heartbeat.FEWEST`), so one
        heartbeat may be lost. The first one arrives up to a second (a round trip) after WELCOME.
        """
        return self._heard_ns is not None and now_ns - self._heard_ns <= self._timeout_ns * 2 // 3

    # -- messages and packets ----------------------------------------------------------------

    def heard(self, *, now_ns: int) -> None:
        """Note a packet of the session. On a secured link the packet has been authenticated."""
        # After a gap of more than two thirds of the time-out, the link counts as good from now on.
        if not self._is_good(now_ns):
            self._good_ns = now_ns
        self._heard_ns = now_ns

    def resume(self, cause: Reason, *, heard_ns: int, now_ns: int) -> None:
        """Continue the flight of an earlier run.

        Args:
            cause: RESUMED if that run's motion is continued, LOST if there is no motion.
            heard_ns: time at which that run last received a packet from the server.
        """
        self._heard_ns = self._good_ns = self._horizon_ns = heard_ns
        self.meet(cause, now_ns=now_ns)

    def horizon_arrived(self, *, late: bool, now_ns: int) -> None:
        """Note the arrival of a plan that is newer than all others before it, accepted or not;
        `late`: more than LATE_SHARE of the plan has passed.
        """
        if not late:
            self._late_ns = None
        elif self._late_ns is None:
            self._late_ns = now_ns
        elif now_ns - self._late_ns >= LATE_NS:
            self.meet(Reason.LATE, now_ns=now_ns)

    def horizon_taken(self, *, now_ns: int) -> None:
        self._horizon_ns = now_ns
        self.postponed = None  # a postponed STALLED no longer applies: the newer motion is in time
        self.meet(Reason.HORIZON, now_ns=now_ns)

    def malformed(self, *, now_ns: int) -> None:
        """Note a malformed message that proves to be from the server."""
        if _full(self._malformed, now_ns):
            self.meet(Reason.MALFORMED, now_ns=now_ns)

    def future(self, *, now_ns: int) -> None:
        """Note a plan made for a step in the future, or from an observation in the future."""
        if _full(self._future, now_ns):
            self.meet(Reason.RESYNC, now_ns=now_ns)

    # -- timers ------------------------------------------------------------------------------

    def step(self, *, late_ns: int, hindrance: Reason | None, now_ns: int) -> None:
        """React to lateness, a hindrance, silence and an old plan at the start of a step.

        Args:
            late_ns: delay with which the step was started [ns].
            hindrance: cause on the vehicle's side that forbids following a plan.
        """
        # The hindrance is checked first, so that no other cause acts before a pilot's take-over.
        if hindrance is not None:
            self.meet(hindrance, now_ns=now_ns)
        elif self.mode is Mode.MANUAL:
            self.meet(Reason.RETURNED, now_ns=now_ns)
        if late_ns > STALL_NS:
            self.meet(Reason.STALLED, now_ns=now_ns)
        locked, lost = self.reason in LOCKING, self.is_lost(now_ns)
        if lost and not locked:
            self.meet(Reason.LOST, now_ns=now_ns)
        good = self._is_good(now_ns) and now_ns - self._good_ns >= GOOD_NS
        armed_now = self.armed and self.reason is Reason.UNARMED
        if good and (locked or armed_now or self.mode is Mode.SYNC):
            self.meet(Reason.GOOD, now_ns=now_ns)
        if not self.armed:
            self.meet(Reason.UNARMED, now_ns=now_ns)
        elif self.has_leapt and self.reason not in LOCKING:
            self.meet(Reason.LEAPT, now_ns=now_ns)
        if now_ns - self._horizon_ns > self._timeout_ns:
            self.meet(Reason.OLD, now_ns=now_ns)
        if now_ns - self._began_ns >= self._brake_ns:
            self.meet(Reason.BRAKED, now_ns=now_ns)
        if self.mode in HANGING:
            self._wait(lost=lost, good=good, now_ns=now_ns)
        else:
            self._waits_ns = now_ns

    def _wait(self, *, lost: bool, good: bool, now_ns: int) -> None:
        """Land if the vehicle has waited too long for a good link, a ready autopilot or an
        operator.
        """
        # A link that is never good, or a silent autopilot, has the same effect as a lost link.
        locked = self.reason in LOCKING or self.mode is Mode.SYNC
        waits = lost or (locked and not good) or (self.has_leapt and not self.stays)
        # A link that has just returned gets one second to become good.
        patience_ns = self._land_after_ns + (0 if lost else GOOD_NS)
        if not waits:
            self._waits_ns = now_ns
        elif self._land_after_ns and now_ns - self._waits_ns >= patience_ns:
            self.meet(self._alone if lost else Reason.WAITED, now_ns=now_ns)

    def leapt(self, *, now_ns: int) -> None:
        """Note a leap of the state: no plan is accepted until an operator has decided which
        position is right.
        """
        # With HOLD there is no failsafe, and a leap has no effect.
        self.has_leapt = self.brakes
        if self.reason not in LOCKING:
            self.meet(Reason.LEAPT, now_ns=now_ns)

    def decide(self) -> None:
        self.has_leapt = self.stays = False

    def motion_goes_on(self, goes_on: bool, *, now_ns: int) -> None:
        """Note whether a mission's motion is in force and its last knot is still ahead (`goes_on`).
        At the last knot the postponed cause takes effect.
        """
        self.keeps_motion = goes_on
        if not goes_on and self.postponed is not None:
            cause, self.postponed = self.postponed, None
            self.meet(cause, now_ns=now_ns)

    def meet(self, cause: Reason, *, now_ns: int) -> None:
        """Act on a cause: change mode and reason by the transition table.

        The other vehicles of a mission avoid the motion in force and expect no other motion. So a
        faulty or missing packet does not end the motion: its cause takes effect at the last knot,
        where the vehicle rests. Until then no other motion is accepted.
        """
        after = self._table.get((self.mode, cause))
        if after is None:
            return
        if self.keeps_motion and after not in FOLLOWING and cause not in AT_ONCE:
            if self.postponed in (None, Reason.STALLED):
                self.postponed = cause
            return
        if cause in LOCKING or cause is Reason.OPENED:
            # The time for which the link has to be good (GOOD_NS) begins now.
            self._good_ns = now_ns
        if cause in CLOSING:
            self._heard_ns = None
        if after is not self.mode:
            self._began_ns = now_ns
            self._waits_ns = self._waits_ns if self.mode in HANGING else now_ns
        before = self.mode, self.reason
        self.mode, self.reason = after, self.reason if cause in KEPT else cause
        if (self.mode, self.reason) != before:
            transition = Transition(*before, self.mode, self.reason, cause, self.takes)
            self.transitions.append(transition)


def _full(times_ns: deque[int], now_ns: int) -> bool:
    """Add a time. If the queue is now full of times within WINDOW_NS, empty it and return True."""
    times_ns.append(now_ns)
    full = len(times_ns) == times_ns.maxlen and now_ns - times_ns[0] <= WINDOW_NS
    if full:
        # Otherwise each further error within the window would make the vehicle brake again.
        times_ns.clear()
    return full
