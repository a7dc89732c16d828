"""Motions that one vehicle on a mission may fly, as far as the server knows.

A motion that is not acknowledged is sent again, the very same one, while it may still be taken.
When a motion or its acknowledgement is lost, nothing can be planned until an observation says so;
after such a loss the next motions are therefore sent twice, and then three times.
"""

import math
from collections import deque
from typing import NamedTuple

from skytether.server.missions.routes import Routes
from skytether.server.missions.yielding import Yielding
from skytether.shared.base.kernel import shared
from skytether.shared.law.model import Array
from skytether.shared.law.motion import Motion

COPIES_MAX = 3
"""Largest number of times that a motion is sent."""
COPY_STEPS = 4
"""Steps from one time to the next."""
PATIENCE_STEPS = 120
"""Steps without coming nearer to its goal after which a vehicle asks another to yield."""
CLOSED_MAX = 8
"""Largest number of places that are taken for closed."""
NEARER_M = 0.3
"""Distance that counts as having come nearer [m]."""
PROMPT_COUNT = 8
"""Number of motions in a row, each acknowledged at once, after which they are sent less often."""


class SentMotion(NamedTuple):
    """A motion that was sent."""

    step: int
    """Step of its packet."""
    motion: Motion


class VehicleMotions:
    """Motions of one vehicle, and what is decided on them."""

    def __init__(self) -> None:
        self.in_force: SentMotion | None = None
        """Motion that it flies, with its packet's step; None before the first observation."""
        self.is_foreign = False
        """Whether `in_force` stands for a motion of another server: the vehicle rests where it was
        observed last, or is still on its way."""
        self.sent: deque[SentMotion] = deque(maxlen=64)
        """Motions sent after that, oldest first, that may still be taken."""
        self.next: Motion | None = None
        """Motion to be sent at this step."""
        self.turned_rad = 0.0
        """Angle by which its waypoints are to the right of its goal [rad]."""
        self.outside_m = 0.0
        """Distance by which it was outside its tube when it was last observed [m]."""
        self.speed_mps = 0.0
        """Speed when it was last observed [m/s]."""
        self.detour: Routes | None = None
        """Ways around others that rest where it was stuck; None before it ever was."""
        self.detour_until = 0
        """Step up to which it takes them."""
        self.closed: deque[Array] = deque(maxlen=CLOSED_MAX)
        """Places on ways to its goal between zones that are too close for a motion [m]."""
        self.goal: Array | None = None
        """Goal to which it flew last [m]; shape (axes,); None before the first, and where what
        was learnt about ways to it no longer holds."""
        self.remaining_m = 0.0
        """Shortest way that was ever left to that [m]."""
        self.progress_step = 0
        """Step at which it came that near, or asked another to yield last."""
        self.zone_blocks = False
        """Whether a zone has held it back since it was found stuck last."""
        self.yielding: Yielding | None = None
        """Place to which it yields; None if it flies to its own goal."""
        self.in_zone = False
        """Whether it rests within a zone, or too near to one."""
        self.waits_for = ""
        """Reason why it waits, in words for the operator; empty if it does not."""

        self.copies = 1
        """Largest number of times that a motion is sent to it."""
        self.prompt_count = 0
        """Number of motions in a row that it acknowledged at once."""
        self.repeat: SentMotion | None = None
        """Motion that is sent once more at this step."""

    def motions(self) -> list[Motion]:
        """Motions that may be flown, the one to be sent at this step included."""
        motions = [self.in_force.motion] if self.in_force else []
        motions += [each.motion for each in self.sent]
        if self.next and not (self.in_force and self.next is self.in_force.motion):
            motions.append(self.next)
        return motions

    def adapt_copies(self, prompt: bool) -> None:
        """Send motions more often where one, or its acknowledgement, was lost; less often later.

        Args:
            prompt: whether a motion was acknowledged at once.
        """
        self.prompt_count = self.prompt_count + 1 if prompt else 0
        if not prompt:
            self.copies = min(self.copies + 1, COPIES_MAX)
        elif self.prompt_count % PROMPT_COUNT == 0:
            self.copies = max(self.copies - 1, 1)

    def is_stuck(self, step: int, goal: Array, remaining_m: float) -> bool:
        """Whether it has come no nearer to its goal for PATIENCE_STEPS; said once in
        that time.

        Args:
            step: k, of its own.
            goal: where it flies to [m]; shape (axes,).
            remaining_m: length of the way that is left [m].
        """
        if self.goal is None or (goal != self.goal).any():
            self.detour = None
            self.closed.clear()
            self.remaining_m = math.inf
        if remaining_m < self.remaining_m - NEARER_M:
            self.goal, self.remaining_m, self.progress_step = goal, remaining_m, step
        elif step - self.progress_step >= PATIENCE_STEPS:
            self.progress_step = step
            return True
        return False

    def repeat_at(self, step: int) -> SentMotion | None:
        """Motion that is to be sent once more at a step; None where there is none."""
        sent_step, repeats_for = self.repeats
        return self.sent[-1] if repeats_after(step - sent_step, repeats_for) else None

    @property
    def repeats(self) -> tuple[int, int]:
        """Step of the motion that was sent last, and number of steps after it up to which it is
        sent once more, every COPY_STEPS; 0 where there is none.
        """
        if not self.sent:
            return 0, 0
        return self.sent[-1].step, (self.copies - 1) * COPY_STEPS


@shared
def repeats_after(since: int, repeats_for: int) -> bool:
    """Whether a motion is sent once more.

    Args:
        since: steps since it was sent first.
        repeats_for: steps after that up to which it is, see `VehicleMotions.repeats`.
    """
    return 0 < since <= repeats_for and since % COPY_STEPS == 0
