"""Both ends over an emulated network in virtual time, to evaluate a policy before deployment.

    robot = Emulated(policy, RobotOptions("absolute", deadline_ns=150_000_000, step_ns=20_000_000),
                     to_policy="constant(50ms) & loss(5%)", to_robot="constant(50ms)")
    robot.connect()
    reply = robot.infer(observation)   # advances the virtual time until the answer
    robot.sleep(0.1)                   # the robot executes five rows

The ends are `RobotEnd` and `PolicyEnd`, as deployed; the network is emulated by `netem`. Runs with
the same seed are equal bit for bit.
"""

from collections import deque
from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count
from typing import Any

from skytether.client.link import ClientLink, PlainLink
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments_of
from skytether.netem.link import QUEUE_BYTES_MAX, Lane, Link
from skytether.policy import values
from skytether.policy.robot import LINE, FrameType, RobotEnd, RobotOptions
from skytether.policy.serving import PolicyEnd, reply_of
from skytether.server.gate import Gate, PlainGate
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint

SERVER: Address = ("192.0.2.1", 47010)
ROBOT: Address = ("192.0.2.2", 5000)
PROGRAM: Address = ("program", 1)
ANSWERS_MAX = 4096
CONNECTS_NS = 60 * SECOND_NS
"""Longest time for the policy's metadata to arrive [ns]."""


class NoActionError(RuntimeError):
    """Error as the answer to a call; the message gives the reason."""


class Emulated:
    """Robot program and policy at the two ends of an emulated network, in virtual time.

    Args:
        policy: function from an observation to the reply, see `serving.reply_of`.
        options: options of the robot end.
        to_policy, to_robot: network impairments of each direction (`skytether list impairments`).
        thinking: computation time of the policy [s]; None: it never replies.
        seed: random seed of the network.
        metadata: metadata that the policy sends when it is connected.
        link, gate: encryption at the robot end and at the policy end; None: plaintext.
        compress: compression of images, see `images.Compressor`.
        gives_rows: see `PolicyEnd`.
        boot_ids: run numbers of robot end and policy end.

    Raises:
        ConfigError: an impairment is invalid.
    """

    def __init__(
        self,
        policy: Callable[[Any], Any],
        options: RobotOptions,
        *,
        to_policy: str = "none",
        to_robot: str = "none",
        thinking: float | None = 0.0,
        seed: int = 1,
        metadata: Any = None,
        link: ClientLink | None = None,
        gate: Gate | None = None,
        compress: Callable[[Any], Any] = lambda observation: observation,
        gives_rows: bool = False,
        boot_ids: tuple[int, int] = (1, 2),
    ) -> None:
        self._policy, self._metadata = policy, values.pack(metadata)
        self.thinking_ns = None if thinking is None else seconds_to_ns(thinking)
        sessions = count(1)
        link = link or PlainLink()
        self.robot = RobotEnd(1, {0: SERVER}, link, options, boot_id=boot_ids[0], compress=compress)
        self.server = PolicyEnd(
            gate or PlainGate(),
            boot_id=boot_ids[1],
            draw=lambda: next(sessions),
            gives_rows=gives_rows,
        )
        self.now_ns = 0
        self.answers: deque[tuple[int, bytes]] = deque(maxlen=ANSWERS_MAX)
        """Time [ns] and content of the newest frames sent to the program, see `robot.FrameType`."""
        self._is_answered = False
        self.is_cut = False
        """Whether the network is cut."""
        ways = ("to_policy", to_policy), ("to_robot", to_robot)
        made = [(name, impairments_of(name, text)) for name, text in ways]
        self._ways = [
            (Link(0, QUEUE_BYTES_MAX, None, each), Lane(0, Fates(each, seed, name, 0), 0))
            for name, each in made
        ]
        self._later: list[tuple[int, int, bytes, Address]] = []
        """Pending frames of the policy: due time [ns], order, frame, connection."""
        self._order = count()
        self.on_datagram: Callable[[Datagram], None] = lambda _: None
        """Called with each datagram when it is sent."""

    def connect(self) -> Any:
        """Connect the program; returns the policy's metadata.

        Raises:
            NoActionError: no metadata has arrived within CONNECTS_NS.
        """
        if not self._is_answered_within(CONNECTS_NS, FrameType.OPENED.value):
            raise NoActionError("no metadata from the policy")
        return values.unpack(self.answers[-1][1][1:])

    def infer(self, observation: Any) -> Any:
        """Reply to an observation, from the present row on; advances the virtual time.

        Raises:
            NoActionError: the reply is an error.
        """
        # Each call is answered by its deadline; the first call is answered within `begin_ns`.
        said = FrameType.MESSAGE.value + values.pack(observation)
        self._is_answered_within(3600 * SECOND_NS, said)
        said = self.answers[-1][1]
        if said[:1] == FrameType.ERROR:
            raise NoActionError(said[1:].decode())
        return values.unpack(said[1:])

    def _is_answered_within(self, longest_ns: int, said: bytes) -> bool:
        """Whether a frame of the program is answered in this time [ns], until which time passes."""
        self._is_answered = False
        self.say(said)
        self.run(self.now_ns + longest_ns, lambda: self._is_answered)
        return self._is_answered

    def sleep(self, seconds: float) -> None:
        """Advance the virtual time by `seconds` [s]."""
        self.run(self.now_ns + seconds_to_ns(seconds))

    def say(self, said: bytes, peer: Address = PROGRAM) -> None:
        """Deliver a frame of a program to the robot end."""
        self.robot.receive(Datagram(said, peer, LINE), now_ns=self.now_ns)

    def policy_says(self, said: bytes, peer: Address) -> None:
        """Deliver a frame of the policy to the policy end."""
        self.server.receive(Datagram(said, peer, LINE), now_ns=self.now_ns)

    def run(self, until_ns: int, stop: Callable[[], bool] = lambda: False) -> None:
        """Advance the virtual time to `until_ns`, or until `stop` returns true."""
        while True:
            self._collect(self.robot)
            self._collect(self.server)
            if stop():
                return
            due = [self.robot.next_wake_ns(), self.server.next_wake_ns(), until_ns]
            due += [link.next_due_ns() for link, _ in self._ways]
            due += [at_ns for at_ns, *_ in self._later[:1]]
            next_ns = max(min(each for each in due if each is not None), self.now_ns)
            if next_ns >= until_ns:
                self.now_ns = until_ns
                return
            self._step(next_ns)

    def _step(self, now_ns: int) -> None:
        self.now_ns = now_ns
        while self._later and self._later[0][0] <= now_ns:
            _, _, said, peer = heappop(self._later)
            self.policy_says(said, peer)
        for (link, _), end, sender in zip(
            self._ways, (self.server, self.robot), (ROBOT, SERVER), strict=True
        ):
            for payload, _, _ in link.release(now_ns=now_ns):
                end.receive(Datagram(payload, sender, 0), now_ns=now_ns)
        for end in (self.robot, self.server):
            wake_ns = end.next_wake_ns()
            if wake_ns is not None and wake_ns <= now_ns:
                end.wake(now_ns=now_ns)

    def _collect(self, end: Endpoint) -> None:
        for datagram in end.outbox():
            payload, peer, socket = datagram
            if socket == LINE and end is self.robot:
                self.answers.append((self.now_ns, payload))
                self._is_answered = True
            elif socket == LINE:
                self._ask(payload, peer)
            else:
                self.on_datagram(datagram)
                link, lane = self._ways[peer != SERVER]
                if not self.is_cut:
                    link.accept(Datagram(payload, peer, 0), lane, now_ns=self.now_ns)

    def _ask(self, payload: bytes, peer: Address) -> None:
        said, after_ns = FrameType.OPENED.value + self._metadata, 0
        if payload[:1] == FrameType.MESSAGE:
            if self.thinking_ns is None:
                return
            said, after_ns = reply_of(self._policy, payload[1:]), self.thinking_ns
        elif payload[:1] == FrameType.CLOSED:
            return
        heappush(self._later, (self.now_ns + after_ns, next(self._order), said, peer))
