"""Failsafe: the vehicle's mode, decided aboard by a table and a few timers.

    INIT → SYNC → READY → TRACK ⇄ COAST → BRAKE → HOVER → LAND            and FAULT, for good

`TABLE` is the machine: mode and cause give the next mode, and what is not in it changes nothing.
`HOLD` is that of a vehicle which holds its last input for ever, as the paper's does: no failsafe.
`Failsafe` finds the causes that take time: a good link, silence, late horizons, repeated mistakes.
Time is an argument. What is flown in each mode is chosen in `client.pilot`.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.law.terms import Terms
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.protocol import Mode

GOOD_NS = SECOND_NS
"""Time for which the link has to be good before horizons are taken [ns]."""
STALL_NS = 100 * MILLISECOND_NS
"""Lateness of a step above which what is flown is too old, whatever kept the vehicle [ns]."""
LATE_NS = 500 * MILLISECOND_NS
"""Time for which all horizons have to come late before the vehicle brakes [ns]."""
LATE_SHARE = 0.75
"""Share of a horizon that has passed when it comes, after its committed steps, if it is late."""
WINDOW_NS = SECOND_NS
"""Time within which mistakes of the server are counted [ns]."""
MALFORMED_MAX = 5
"""Malformed messages within `WINDOW_NS` that make the vehicle brake."""
FUTURE_MAX = 10
"""Horizons for impossible times within `WINDOW_NS` that make it ask for its session anew."""
BRAKE_SPARE_NS = 500 * MILLISECOND_NS
"""Time beyond that of the braking curve itself for which a vehicle may brake [ns]."""

YIELDING = frozenset({Reason.TAKEN, Reason.DISARMED})
"""Causes for which somebody else flies the vehicle, or nobody."""
GROUNDING = frozenset({Reason.BATTERY, Reason.ASTRAY, Reason.RIVAL, Reason.STRAYED})
"""Causes for which the vehicle brakes, and lands."""
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
"""Causes after which the link has to be good for `GOOD_NS` anew, in every mode."""
LOCKING = BROKEN | GROUNDING | YIELDING | {Reason.LATE, Reason.RETURNED}
"""Causes of braking after which no horizon is taken before the vehicle hovers on a good link."""
CLOSING = frozenset({Reason.CLOSED, Reason.RESYNC})
"""Causes that end the session: another WELCOME is needed."""
DROPPING = LOCKING | {Reason.STALLED, Reason.NOT_FINITE, Reason.UNARMED, Reason.LEAPT}
"""Causes for which the horizon held is dropped."""

HANGING = frozenset({Mode.SYNC, Mode.READY, Mode.HOVER})
"""Modes in which it stands still until something comes."""
KEPT = frozenset({Reason.BRAKED, Reason.WAITED})
"""Causes that are no reason of their own: what it brakes or hovers for stays the reason."""

CALM = frozenset({Mode.TRACK, Mode.COAST, Mode.HOVER})
"""Modes in which a vehicle may fly for many steps without a cause for another one."""

Table = Mapping[tuple[Mode, Reason], Mode]

_FAULTS = {(mode, Reason.NOT_FINITE): Mode.FAULT for mode in Mode if mode is not Mode.FAULT}
_TO_BRAKE = (
    BROKEN | GROUNDING | {Reason.ENDED, Reason.LATE, Reason.STALLED, Reason.UNARMED, Reason.LEAPT}
)
# Not in INIT, where nothing is flown yet, nor in LAND, RETURN and FAULT, which last until somebody
# has seen to the vehicle.
_YIELDS = {
    (mode, cause): Mode.MANUAL
    for mode in Mode
    if mode not in (Mode.INIT, Mode.LAND, Mode.RETURN, Mode.FAULT)
    for cause in YIELDING
}

TABLE: Table = MappingProxyType(
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
    # LOST is left out: in SYNC the vehicle waits for a link in any case.
    | {(Mode.SYNC, cause): Mode.SYNC for cause in BROKEN - {Reason.LOST}}
    | {(Mode.READY, cause): Mode.SYNC for cause in BROKEN}
    | {(Mode.TRACK, cause): Mode.BRAKE for cause in _TO_BRAKE}
    | {(Mode.COAST, cause): Mode.BRAKE for cause in _TO_BRAKE}
    | {(Mode.BRAKE, cause): Mode.BRAKE for cause in BROKEN | GROUNDING}
    | {(Mode.HOVER, cause): Mode.HOVER for cause in BROKEN}
    | _YIELDS
    | _FAULTS
)
"""Transition table of the failsafe: next mode by present mode and cause. Where the mode stays, only
its reason changes."""

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
"""Next mode with `vehicle.exhausted = "hold"`: never does the vehicle brake or land by itself."""


def brake_ns(terms: Terms) -> int:
    """Longest time of braking [ns]: from u_max on all axes at once, and BRAKE_SPARE_NS."""
    steps = math.ceil(math.hypot(*terms.u_max) / terms.brake) if terms.brake else 0
    return steps * terms.dt_ns + BRAKE_SPARE_NS


class Failsafe:
    """Mode of one vehicle, and why it is in it.

    Args:
        table: `TABLE` or `HOLD`.
        armed: whether horizons may be flown at all, see `armed`.
        timeout_ns: time of silence after which the link is lost, and without a newer horizon after
            which the vehicle coasts [ns].
        brake_ns: longest time of braking [ns]: then it hovers, whatever still pushes it.
        land_after_ns: time of hovering after which it lands, if nothing that it needs to fly on has
            come: a good link, say [ns]; 0: never.
        returns: whether it returns home with a silent server, in place of landing.
        changed: called whenever mode or reason have changed, with those before, the cause, and the
            time.
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
        changed: Callable[[Mode, Reason, Reason, int], None],
    ) -> None:
        self._table = table
        self.armed = armed
        """Whether horizons may be flown at all; it may change in flight."""
        self._timeout_ns, self._brake_ns = timeout_ns, brake_ns
        self._land_after_ns = land_after_ns
        self._alone = Reason.HOMEWARD if returns else Reason.ALONE
        """Cause of a server that has been silent for long."""
        self._changed = changed
        self.mode = Mode.INIT
        """Present mode."""
        self.reason = Reason.BEGUN
        """Newest cause that it met; what it braked for, while it hovers."""
        self._heard_ns: int | None = None
        """Time of the newest packet of the session; None without a session."""
        self._good_ns = 0
        """Time since which the link has been good, as far as it is."""
        self._horizon_ns = 0
        """Time at which the newest horizon was taken."""
        self._late_ns: int | None = None
        """Time since which all horizons have come late; None where the newest has not."""
        self._began_ns = 0
        """Time at which the present mode began."""
        self._waits_ns = 0
        """Time since which it has hovered without what it needs to fly on, as far as it has."""
        self._malformed: deque[int] = deque(maxlen=MALFORMED_MAX)
        """Times of the newest malformed messages."""
        self.has_leapt = False
        """Whether its state has leapt, and nobody has said which frame counts."""
        self.stays = False
        """Whether it hovers on after a leap, and does not land: an operator's choice."""
        self._future: deque[int] = deque(maxlen=FUTURE_MAX)
        """Times of the newest horizons for impossible times."""

    @property
    def heard_ns(self) -> int | None:
        """Time of the newest packet of the session; None without a session."""
        return self._heard_ns

    @property
    def takes(self) -> bool:
        """Whether a horizon that comes now is flown."""
        may = (self.mode, Reason.HORIZON) in self._table
        return may and self.armed and not self.has_leapt and self.reason not in LOCKING

    @property
    def brakes(self) -> bool:
        """Whether the vehicle brakes where it has no plan, and does not hold its last input."""
        return self._table is TABLE

    def is_lost(self, now_ns: int) -> bool:
        """Whether nothing of the session has come for the time-out, or there is no session."""
        return self._heard_ns is None or now_ns - self._heard_ns > self._timeout_ns

    def _is_good(self, now_ns: int) -> bool:
        """Whether something of the session has come within two thirds of the time-out.

        A heartbeat comes at least in each third, see `heartbeat.FEWEST`: so one may be lost. And
        the first one comes a round trip after WELCOME, which may take a second.
        """
        return self._heard_ns is not None and now_ns - self._heard_ns <= self._timeout_ns * 2 // 3

    # -- what arrives ------------------------------------------------------------------------

    def heard(self, *, now_ns: int) -> None:
        """Note a packet of the session, authenticated where the link is."""
        # After a gap of more than two thirds of the time-out the link has to prove itself anew.
        if not self._is_good(now_ns):
            self._good_ns = now_ns
        self._heard_ns = now_ns

    def resume(self, cause: Reason, *, heard_ns: int, now_ns: int) -> None:
        """Go on with the flight of an earlier life.

        Args:
            cause: RESUMED along its motion, LOST without one.
            heard_ns: time at which that life has heard the server.
            now_ns: time now.
        """
        self._heard_ns = self._good_ns = self._horizon_ns = heard_ns
        self.meet(cause, now_ns=now_ns)

    def horizon_arrived(self, *, late: bool, now_ns: int) -> None:
        """Note a horizon newer than those before, whether or not it is taken.

        Args:
            late: whether more than LATE_SHARE of it has passed.
            now_ns: time at which it came.
        """
        if not late:
            self._late_ns = None
        elif self._late_ns is None:
            self._late_ns = now_ns
        elif now_ns - self._late_ns >= LATE_NS:
            self.meet(Reason.LATE, now_ns=now_ns)

    def horizon_taken(self, *, now_ns: int) -> None:
        """Note a horizon that is held from now on."""
        self._horizon_ns = now_ns
        self.meet(Reason.HORIZON, now_ns=now_ns)

    def malformed(self, *, now_ns: int) -> None:
        """Note a malformed message that the server itself has sent."""
        if _full(self._malformed, now_ns):
            self.meet(Reason.MALFORMED, now_ns=now_ns)

    def future(self, *, now_ns: int) -> None:
        """Note a horizon for a time, or from an observation, that there cannot be."""
        if _full(self._future, now_ns):
            self.meet(Reason.RESYNC, now_ns=now_ns)

    # -- what time brings --------------------------------------------------------------------

    def step(self, *, late_ns: int, hindrance: Reason | None, now_ns: int) -> None:
        """Handle the causes that hold at the start of a step.

        Args:
            late_ns: time by which the vehicle was woken late for it [ns].
            hindrance: cause on the vehicle's side for which it must not follow a plan.
            now_ns: time now.
        """
        # First of all: a pilot who takes over must not wait for anything that is found below.
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
        self._wait(lost=lost, good=good, now_ns=now_ns)

    def _wait(self, *, lost: bool, good: bool, now_ns: int) -> None:
        """Land where what the vehicle needs to fly on does not come."""
        # A link that is never good, or an autopilot that is silent, locks it as a lost link does.
        locked = self.reason in LOCKING or self.mode is Mode.SYNC
        waits = lost or (locked and not good) or (self.has_leapt and not self.stays)
        # A link that has just come back has its second to be good.
        patience_ns = self._land_after_ns + (0 if lost else GOOD_NS)
        if self.mode not in HANGING or not waits:
            self._waits_ns = now_ns
        elif self._land_after_ns and now_ns - self._waits_ns >= patience_ns:
            self.meet(self._alone if lost else Reason.WAITED, now_ns=now_ns)

    def leapt(self, *, now_ns: int) -> None:
        """Note that its state has leapt: no horizon is taken until an operator has chosen."""
        # With HOLD there is no failsafe, and a leap stops nothing.
        self.has_leapt = self.brakes
        if self.reason not in LOCKING:
            self.meet(Reason.LEAPT, now_ns=now_ns)

    def decide(self) -> None:
        """Note that an operator has said which frame counts."""
        self.has_leapt = self.stays = False

    def meet(self, cause: Reason, *, now_ns: int) -> None:
        """Change mode and reason for a cause, where the table says so."""
        after = self._table.get((self.mode, cause))
        if after is None:
            return
        if cause in LOCKING or cause is Reason.OPENED:
            # The second for which the link has to be good begins now, whatever it was before.
            self._good_ns = now_ns
        if cause in CLOSING:
            self._heard_ns = None
        if after is not self.mode:
            self._began_ns = now_ns
            self._waits_ns = self._waits_ns if self.mode in HANGING else now_ns
        before = self.mode, self.reason
        self.mode, self.reason = after, self.reason if cause in KEPT else cause
        if (self.mode, self.reason) != before:
            self._changed(*before, cause, now_ns)


def _full(times_ns: deque[int], now_ns: int) -> bool:
    """Whether so many lie within the window, with one more now; if so, all are forgotten."""
    times_ns.append(now_ns)
    full = len(times_ns) == times_ns.maxlen and now_ns - times_ns[0] <= WINDOW_NS
    if full:
        # Else each further mistake within the window would make the vehicle brake again.
        times_ns.clear()
    return full
