"""Saved state of a client, with which its next run continues in the middle of a flight.

A process may die at any time and be started again while its vehicle is in the air. So the client
saves, outside the process:

    the motion in force, on a mission     other vehicles avoid exactly this motion
    step 0, on the clock of the host      steps continue to count from it
    the boot id of the conversation       the server recognizes the same client
    the origin of the vehicle's frame     otherwise the flight would be shifted
    the number of the leadership          plans of an earlier leadership are not flown
    whether the vehicle was armed         starting a process must not arm it

A client opens no file: `SavingClient.keep` returns the state's bytes when the state has changed,
and `shell.driving.memory` writes them and then calls `SavingClient.kept`. **Nothing is sent to a
server before the state is saved**: otherwise the next run might fly a motion that the server no
longer expects. If the state cannot be saved, because a disk is full, read-only or stuck, the client
continues after `WAIT_NS`, and each observation reports it: the servers then treat a restart of the
client as a restart without saved state.
"""

from typing import Annotated, Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from skytether.client.alone import OneServer, Parts
from skytether.client.endpoint import Client
from skytether.client.standby.leadership import NUMBER_MAX
from skytether.client.vehicle import Vehicle, VehicleMemory
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.protocol import KNOTS_MAX

TIME_MAX_NS = 2**62
STEP_MAX = 2**40
REFRESHES = 3
"""Number of times that an unchanged state is written within the largest age of a saved state."""
WAIT_NS = 500 * MILLISECOND_NS
"""Longest time for which a client waits for its state to be saved [ns]: less than the leader's
silence after which the client asks a standby server."""

Time = Annotated[int, msgspec.Meta(ge=-TIME_MAX_NS, le=TIME_MAX_NS)]
"""Time on the host's clock [ns]; in the encoded bytes, relative to the time of writing."""
Step = Annotated[int, msgspec.Meta(ge=0, lt=STEP_MAX)]


class FlownMotion(msgspec.Struct, frozen=True, kw_only=True):
    step: Step
    observed: Step
    since: Step = 0
    """First step whose input was computed from the motion."""
    spacing: Annotated[int, msgspec.Meta(ge=1, le=2**16)]
    numbers: Annotated[bytes, msgspec.Meta(max_length=4 * 3 * 2 * KNOTS_MAX)]
    """Position [m] and velocity [m/s] of each knot, float32 of shape (axes, knots, 2)."""

    def knots(self, axes: int) -> NDArray[np.float32]:
        """Knots of the motion; shape (axes, knots, 2).

        Raises:
            ValueError: the size does not fit the number of axes, or a number is not finite.
        """
        count, left = divmod(len(self.numbers), 4 * 2 * axes)
        if left or not 0 < count <= KNOTS_MAX:
            raise ValueError(f"got a motion of {len(self.numbers)} B for {axes} axes")
        knots = np.frombuffer(self.numbers, dtype=np.float32).reshape(axes, count, 2)
        if not np.isfinite(knots).all():
            raise ValueError("got a motion with a coordinate that is not finite")
        return knots


class SavedState(msgspec.Struct, frozen=True, kw_only=True):
    """State that a client saves for its next run."""

    boot_id: int | None = None
    """Boot id in the session with the server; None if the session cannot continue."""
    began_ns: Time | None = None
    heard_ns: Time = 0
    motion: FlownMotion | None = None
    frame: VehicleMemory = VehicleMemory()
    leadership: Annotated[int, msgspec.Meta(ge=0, le=NUMBER_MAX)] = 0
    """Number of the leadership, see `client.standby.leadership`."""

    def servers(self, parts: Parts) -> OneServer:
        """See `Fresh`; after a flight with a standby server, the server is told that it leads."""
        if not self.leadership:
            return OneServer(parts.failsafe)
        standby = load("skytether.client.standby.servers", "a standby server")
        servers: OneServer = standby.Servers(1, parts)
        return servers

    def after(self, time_ns: int) -> "SavedState":
        began_ns = None if self.began_ns is None else self.began_ns + time_ns
        heard_ns = self.heard_ns + time_ns
        frame = msgspec.structs.replace(self.frame, at_ns=self.frame.at_ns + time_ns)
        return msgspec.structs.replace(self, began_ns=began_ns, heard_ns=heard_ns, frame=frame)

    def encode(self, written_ns: int) -> bytes:
        """Bytes to save, with times relative to the time of writing."""
        return msgspec.msgpack.encode(self.after(-written_ns))

    @classmethod
    def decode(cls, content: bytes, written_ns: int, axes: int) -> Self:
        """State from bytes that were written at `written_ns`.

        Raises:
            ValueError: the bytes are invalid; the message gives the reason.
        """
        try:
            saved = msgspec.msgpack.decode(content, type=cls)
        except (msgspec.DecodeError, RecursionError) as error:
            raise ValueError(str(error)) from None
        if saved.boot_id is not None and not 0 <= saved.boot_id < 2**64:
            raise ValueError(f"got the boot id {saved.boot_id}")
        if saved.motion is not None:
            saved.motion.knots(axes)
            if saved.boot_id is None or saved.began_ns is None:
                raise ValueError("got a motion without the flight that it belongs to")
        return saved.after(written_ns)  # type: ignore[return-value]


def recall(content: bytes, written_ns: int | None, now_ns: int, terms: Terms) -> SavedState:
    """State saved by an earlier run, without the parts that are no longer valid.

    A flight is not continued if its state is older than the longest possible motion.

    Args:
        content: bytes written by that run.
        written_ns: time of writing [ns; the clock of the host]; None if the clock has been
            reset since, for example by a reboot.
        terms: terms of the flight; they are the same as in the earlier run.

    Raises:
        ValueError: the content is invalid; the message gives the reason.
    """
    saved = SavedState.decode(content, written_ns or 0, terms.axes)
    if written_ns is None:
        frame = VehicleMemory(armed=saved.frame.armed)
        return SavedState(frame=frame, leadership=saved.leadership)
    if not 0 <= now_ns - written_ns <= age_max_ns(terms):
        return SavedState(frame=saved.frame, leadership=saved.leadership)
    return saved


def age_max_ns(terms: Terms) -> int:
    """Largest age of a saved state that is used [ns]: the longest time of a motion."""
    return terms.age_max * terms.dt_ns


class ClientMemory:
    """Decides when the state of a client has to be written.

    Args:
        boot_id: number unique to this run.
        before: state saved by the previous run; None if there was none.
    """

    def __init__(self, terms: Terms, boot_id: int, before: SavedState | None) -> None:
        self.before = before or SavedState()
        self.boot_id = boot_id if self.before.boot_id is None else self.before.boot_id
        self._age_max_ns = age_max_ns(terms)
        self._handed: tuple[SavedState, int] | None = None
        """State that `keep` last returned for writing, and the time of that call [ns]."""
        self._saved = None if self.before.boot_id is None else self.before
        """State on the disk, which the next run would use; None without one."""
        self._is_removed = False
        """Whether the state on the disk was removed because it could not be replaced."""
        self._differs_ns: int | None = None
        """Time since which the state on the disk is out of date [ns]; None if up to date."""
        self.unsaved = False
        """Whether saving the newest state passed to `may_tell` has failed, so that the next run
        would lack it."""

    @property
    def is_stale(self) -> bool:
        """Whether the saved state is older than the present state."""
        return self._saved is not None and self._differs_ns is not None

    def keep(self, state: SavedState, *, now_ns: int) -> bytes | None:
        """Bytes to be written; None if the bytes returned last are recent and still up to date."""
        if self._handed is not None:
            handed, handed_ns = self._handed
            is_old = now_ns - handed_ns > self._age_max_ns // REFRESHES
            if not is_old and _is_same(state, handed):
                return None
        self._handed = state, now_ns
        return state.encode(now_ns)

    def kept(self, *, nothing: bool) -> None:
        """Note that the bytes of `keep` were written; `nothing`: the file was removed instead."""
        self._is_removed = nothing
        self._saved = self._handed[0] if self._handed and not nothing else None

    def may_tell(self, state: SavedState, *, now_ns: int) -> bool:
        """Whether messages may be sent. They may if this state is on the disk, if no older state is
        there, or if saving has failed; the messages then report this failure (`unsaved`).
        """
        if self._saved is not None and _is_same(state, self._saved):
            self._differs_ns, self.unsaved = None, False
            return True
        if self._differs_ns is None:
            self._differs_ns = now_ns
        self.unsaved = self._is_removed or now_ns - self._differs_ns > WAIT_NS
        return self.unsaved or self._saved is None


class SavingClient(Client):
    """Client that saves its state, and continues the flight of an earlier run.

    Args:
        before: state saved by the previous run; None if there was none.
        others: further arguments of `Client`.
    """

    keeps = True

    def __init__(
        self,
        scenario: Scenario,
        flies: Vehicle,
        *,
        boot_id: int,
        before: SavedState | None = None,
        **others: Any,
    ) -> None:
        if before is not None:
            flies.recall(before.frame)
        memory = ClientMemory(scenario.terms(), boot_id, before)
        super().__init__(scenario, flies, boot_id=memory.boot_id, before=memory.before, **others)
        self._memory = memory
        self._servers.may_tell = self._may_tell

    def keep(self, *, now_ns: int) -> bytes | None:
        return self._memory.keep(self._state(), now_ns=now_ns)

    def kept(self, *, nothing: bool = False) -> None:
        self._memory.kept(nothing=nothing)

    def _may_tell(self, now_ns: int) -> bool:
        may_tell = self._memory.may_tell(self._state(), now_ns=now_ns)
        self._unsaved = self._memory.unsaved
        return may_tell

    def _report(self, now_ns: int) -> None:
        # Nothing is sent before the state is saved or saving has failed: otherwise the server would
        # not know which motion the next run flies.
        may_tell = self._may_tell(now_ns)
        self.waits_for_disk = self._memory.is_stale
        if may_tell:
            super()._report(now_ns)

    def _state(self) -> SavedState:
        """State to save; before the flight has begun, the state of the previous run."""
        pilot, always = self._pilot, {"frame": self._flies.frame} | self._servers.to_keep()
        if pilot.next_ns is None:
            return msgspec.structs.replace(self._memory.before, **always)
        motion = pilot.motion_in_force()
        return SavedState(
            boot_id=self._memory.boot_id,
            began_ns=pilot.began_ns,
            heard_ns=self._failsafe.heard_ns or pilot.began_ns,
            motion=motion and FlownMotion(**motion._asdict()),
            **always,
        )


def _is_same(one: SavedState, other: SavedState) -> bool:
    """Whether two states are equal for the next run; times that only advance are ignored."""
    return _compared_part(one) == _compared_part(other)


def _compared_part(state: SavedState) -> tuple[object, ...]:
    frame = msgspec.structs.replace(state.frame, boot_ms=0, at_ns=0)
    return state.boot_id, state.began_ns, state.motion, frame, state.leadership
