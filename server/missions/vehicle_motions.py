"""Motions that one vehicle on a mission may fly, as far as the server knows.

A motion that is not acknowledged is repeated unchanged while it may still be accepted. If a motion
or its acknowledgement is lost, no motion can be planned until a later observation. So after such a
loss the next motions are sent twice, and after another loss three times.
"""

import math
from collections import deque
from typing import NamedTuple

from skytether.server.missions.routes import RoutesAroundZones
from skytether.server.missions.yielding import Yielding
from skytether.shared.base.kernel import shared
from skytether.shared.law.model import Array
from skytether.shared.law.motion import Motion

COPIES_MAX = 3
COPY_STEPS = 4
PATIENCE_STEPS = 120
"""Number of steps without progress to its goal after which a vehicle asks another to yield."""
CLOSED_MAX = 8
"""Largest number of closed positions, see `VehicleMotions.closed`."""
NEARER_M = 0.3
"""Reduction of the remaining path that counts as progress [m]."""
PROMPT_COUNT = 8
"""Number of successive motions acknowledged promptly after which motions are sent less often."""


class SentMotion(NamedTuple):
    step: int
    """Step of the motion's packet; -1 for the resting position of a vehicle without a motion."""
    motion: Motion


class VehicleMotions:
    def __init__(self) -> None:
        self.in_force: SentMotion | None = None
        """Motion that the vehicle flies; None before the first observation."""
        self.is_foreign = False
        """Whether the vehicle flies an unknown motion of another server. `in_force` is then a
        motion at rest where the vehicle was last observed."""
        self.sent: deque[SentMotion] = deque(maxlen=64)
        """Motions sent after the motion in force that may still be accepted, oldest first."""
        self.next: Motion | None = None
        self.turned_rad = 0.0
        """Angle to the right of the route at which waypoints are tried [rad]."""
        self.outside_m = 0.0
        """Distance of the vehicle outside its tube in the newest observation [m]."""
        self.speed_mps = 0.0
        self.detour: RoutesAroundZones | None = None
        """Routes that also avoid resting vehicles; None before the vehicle was stuck."""
        self.detour_until = 0
        """Step until which `detour` is used."""
        self.closed: deque[Array] = deque(maxlen=CLOSED_MAX)
        """Positions in gaps too narrow for a motion, which routes avoid [m]."""
        self.goal: Array | None = None
        """Goal towards which progress is measured [m]; shape (axes,). None before the first goal,
        and after a change of zones or of the numbering of the client's steps."""
        self.remaining_m = 0.0
        """Shortest remaining path to `goal` so far [m]."""
        self.progress_step = 0
        """Step of the latest progress, or of the latest request to yield."""
        self.zone_blocks = False
        """Whether a zone has limited the vehicle's plans since the vehicle was last stuck."""
        self.yielding: Yielding | None = None
        """Temporary goal of a yielding vehicle; None if the vehicle flies to its mission goal."""
        self.in_zone = False
        self.waits_for = ""
        """What the vehicle waits for, in words for the operator; empty if it does not wait."""

        self.copies = 1
        """Number of times that each motion is sent."""
        self.prompt_count = 0
        """Number of motions in a row that were acknowledged promptly."""
        self.repeat: SentMotion | None = None

    def motions(self) -> list[Motion]:
        """Motions that may be flown, including the motion to be sent at this step."""
        motions = [self.in_force.motion] if self.in_force else []
        motions += [sent.motion for sent in self.sent]
        if self.next and not (self.in_force and self.next is self.in_force.motion):
            motions.append(self.next)
        return motions

    def adapt_copies(self, prompt: bool) -> None:
        """Send later motions more times after a loss, fewer times after prompt acknowledgements."""
        self.prompt_count = self.prompt_count + 1 if prompt else 0
        if not prompt:
            self.copies = min(self.copies + 1, COPIES_MAX)
        elif self.prompt_count % PROMPT_COUNT == 0:
            self.copies = max(self.copies - 1, 1)

    def is_stuck(self, step: int, goal: Array, remaining_m: float) -> bool:
        """Whether there was no progress for PATIENCE_STEPS; True at most once in that time."""
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
        sent_step, repeats_for = self.repeats
        return self.sent[-1] if repeats_after(step - sent_step, repeats_for) else None

    @property
    def repeats(self) -> tuple[int, int]:
        """Step of the latest motion, and number of steps in which it is repeated; 0, 0 if none."""
        if not self.sent:
            return 0, 0
        return self.sent[-1].step, (self.copies - 1) * COPY_STEPS


@shared
def repeats_after(since: int, repeats_for: int) -> bool:
    """Whether a motion is repeated `since` steps after it was first sent, see `repeats`."""
    return 0 < since <= repeats_for and since % COPY_STEPS == 0
