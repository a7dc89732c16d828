"""Memory of a client: what its next life needs in order to go on in the middle of a flight.

A life of a client is one run of its process. A process may die at any time, and be started again
while its vehicle is in the air. What it must not forget then has a home outside the process:

    the motion in force, on a mission     others keep away from it, and from nothing else
    step 0, on the clock of the host      the steps of the next life go on counting
    the boot id of the conversation       for the server it stays the same client
    the origin of the vehicle's frame     else the flight would be flown elsewhere
    whether a life has armed the vehicle  a process that starts is no person who arms

A core opens no file: `Client.keep` hands out bytes where they have changed, the shell writes them
(`shell.memory`), and says so by `Client.kept`. **Nothing is told to the server before it is kept**:
else it would forget a motion which the next life still flies.
"""

from typing import Annotated, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from skytether.client.vehicle import Frame
from skytether.shared.law.terms import Terms
from skytether.shared.wire.protocol import KNOTS_MAX

KEPT_BYTES_MAX = 8192
"""Largest size of what is kept [B]."""
TIME_MAX_NS = 2**62
"""Largest time that is believed [ns]."""
STEP_MAX = 2**40
"""Largest number of a step that is believed."""
REFRESHES = 3
"""Number of times that what is kept is written again before it is too old."""

Time = Annotated[int, msgspec.Meta(ge=-TIME_MAX_NS, le=TIME_MAX_NS)]
"""Time [ns; the clock of the host]; as bytes, relative to that of writing."""
Step = Annotated[int, msgspec.Meta(ge=0, lt=STEP_MAX)]


class FlownMotion(msgspec.Struct, frozen=True, kw_only=True):
    """Motion in force."""

    step: Step
    """Step of its first knot."""
    observed: Step
    """Step of the observation that it was planned from."""
    spacing: Annotated[int, msgspec.Meta(ge=1, le=2**16)]
    """Steps from one knot to the next."""
    numbers: Annotated[bytes, msgspec.Meta(max_length=4 * 3 * 2 * KNOTS_MAX)]
    """Position [m] and velocity [m/s] of each knot, float32 of shape (axes, knots, 2)."""

    def knots(self, axes: int) -> NDArray[np.float32]:
        """Knots; shape (axes, knots, 2).

        Raises:
            ValueError: they are not of so many axes, or not finite.
        """
        count, left = divmod(len(self.numbers), 4 * 2 * axes)
        if left or not 0 < count <= KNOTS_MAX:
            raise ValueError(f"got a motion of {len(self.numbers)} B for {axes} axes")
        found = np.frombuffer(self.numbers, dtype=np.float32).reshape(axes, count, 2)
        if not np.isfinite(found).all():
            raise ValueError("got a motion with a coordinate that is not finite")
        return found


class Kept(msgspec.Struct, frozen=True, kw_only=True):
    """What a client keeps."""

    boot_id: int | None = None
    """Boot id of the conversation with the server; None of one that cannot go on."""
    began_ns: Time | None = None
    """Begin of step 0; None before the flight."""
    heard_ns: Time = 0
    """Time at which the server was heard last."""
    motion: FlownMotion | None = None
    """Motion in force; None where there is none."""
    frame: Frame = Frame()
    """What the vehicle itself keeps."""

    def after(self, time_ns: int) -> "Kept":
        """Copy in which all times are later by this."""
        began_ns = None if self.began_ns is None else self.began_ns + time_ns
        heard_ns = self.heard_ns + time_ns
        frame = msgspec.structs.replace(self.frame, at_ns=self.frame.at_ns + time_ns)
        return msgspec.structs.replace(self, began_ns=began_ns, heard_ns=heard_ns, frame=frame)

    def encode(self, written_ns: int) -> bytes:
        """Bytes of it, written at a time."""
        return msgspec.msgpack.encode(self.after(-written_ns))

    @classmethod
    def decode(cls, content: bytes, written_ns: int, axes: int) -> Self:
        """What was written at a time as these bytes.

        Raises:
            ValueError: with what is wrong with them.
        """
        try:
            found = msgspec.msgpack.decode(content, type=cls)
        except (msgspec.DecodeError, RecursionError) as error:
            raise ValueError(str(error)) from None
        if found.boot_id is not None and not 0 <= found.boot_id < 2**64:
            raise ValueError(f"got the boot id {found.boot_id}")
        if found.motion is not None:
            found.motion.knots(axes)
            if found.boot_id is None or found.began_ns is None:
                raise ValueError("got a motion without the flight that it belongs to")
        return found.after(written_ns)  # type: ignore[return-value]


def recall(content: bytes, written_ns: int | None, now_ns: int, terms: Terms) -> Kept:
    """What a life before has kept, as far as it holds now.

    A flight that was kept longer ago than any motion lasts is lost.

    Args:
        content: what it has handed out.
        written_ns: when that was [ns; the clock of the host]; None on a host that has had another
            clock since.
        now_ns: time now.
        terms: the rule of flight, which is still the same.

    Raises:
        ValueError: with what is wrong with the content.
    """
    found = Kept.decode(content, written_ns or 0, terms.axes)
    if written_ns is None:
        return Kept(frame=Frame(armed=found.frame.armed))
    if not 0 <= now_ns - written_ns <= age_max_ns(terms):
        return Kept(frame=found.frame)
    return found


def age_max_ns(terms: Terms) -> int:
    """Age from which on what was kept counts as lost [ns]: no motion is flown any longer."""
    return terms.age_max * terms.dt_ns


class Memory:
    """What one client keeps.

    Args:
        terms: the rule of flight.
        boot_id: number that no other life of the vehicle has had.
        before: what the life before has kept; None of none.
    """

    def __init__(self, terms: Terms, boot_id: int, before: Kept | None) -> None:
        self._age_max_ns = age_max_ns(terms)
        self.before = before or Kept()
        """What the life before has kept."""
        self.boot_id = boot_id if self.before.boot_id is None else self.before.boot_id
        """Boot id of the conversation."""
        self._handed: tuple[Kept, int] | None = None
        """What was handed out last, and when."""
        self._written: tuple[Kept, int] | None = None
        """What was written last, and when it was handed out."""

    def keep(self, now: Kept, *, now_ns: int) -> bytes | None:
        """Bytes to be written, where these are others than before, or old.

        Args:
            now: what is to be kept.
            now_ns: time now.
        """
        if self._handed is not None:
            handed, handed_ns = self._handed
            is_old = now_ns - handed_ns > self._age_max_ns // REFRESHES
            if not is_old and _is_same(now, handed):
                return None
        self._handed = now, now_ns
        return now.encode(now_ns)

    def kept(self) -> None:
        """Take note that what was handed out last was written."""
        self._written = self._handed

    def may_tell(self, now: Kept, *, now_ns: int) -> bool:
        """Whether the server may be told: the next life follows what it is told, or nothing.

        Where the file cannot be written any more, the next life follows the one that is there until
        that is too old.
        """
        if self._written is None:
            if self.before.boot_id is None:  # there is nothing that it would follow
                return True
            # At the latest it was written now.
            self._written = self.before, now_ns
        written, written_ns = self._written
        return _is_same(now, written) or now_ns - written_ns > self._age_max_ns


def _is_same(one: Kept, other: Kept) -> bool:
    """Whether a next life would do the same by either: they differ in times alone that go on."""
    return _lasting(one) == _lasting(other)


def _lasting(kept: Kept) -> tuple[object, ...]:
    frame = msgspec.structs.replace(kept.frame, boot_ms=0, at_ns=0)
    return kept.boot_id, kept.began_ns, kept.motion, frame
