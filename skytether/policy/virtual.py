"""Both ends and the network between in virtual time: what is deployed, evaluated.

    with Emulated(policy, actions="absolute", step=0.02, to_policy="constant(50ms) & loss(5%)",
                  to_robot="constant(50ms) & loss(5%)", thinking=0.086) as robot:
        reply = robot.infer(observation)   # time passes until it is answered
        robot.sleep(0.1)                   # the robot plays five rows

The ends are `RobotEnd` and `PolicyEnd`, the network is netem's: with one seed, a run is the same
each time, to the last bit.
"""

from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count
from typing import Any

from skytether.client.link import ClientLink, PlainLink
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.netem.link import QUEUE_BYTES_MAX, Lane, Link
from skytether.policy import values
from skytether.policy.robot import LINE, RobotEnd, RobotOptions, Said
from skytether.policy.serving import PolicyEnd
from skytether.server.gate import Gate, PlainGate
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.scenario import reading
from skytether.shared.scenario.grammar import GrammarError

SERVER: Address = ("192.0.2.1", 47010)
ROBOT: Address = ("192.0.2.2", 5000)
PROGRAM: Address = ("program", 1)
CONNECTS_NS = 60 * SECOND_NS
"""Longest time for the policy's metadata to arrive [ns]."""


class NoActionError(RuntimeError):
    """A call was answered with an error; the message says why."""


class Emulated:
    """A robot's program, with the policy at the far end of an emulated network.

    Args:
        policy: from an observation to the reply, a dict with an array `actions`; what it raises is
            an error of the policy.
        options: the robot's end.
        to_policy, to_robot: impairments of each direction (`skytether list impairments`).
        thinking: time that the policy takes [s]; None: it never answers.
        seed: seed of the network.
        metadata: what the policy says when it is connected.
        link, gate: of both ends, with keys or without.
        compress, unpacker: see `images`.
        gives_rows: see `PolicyEnd`.

    Raises:
        ConfigError: an impairment is impossible.
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
        unpacker: Callable[[], Callable[[dict[Any, Any]], Any]] | None = None,
        gives_rows: bool = False,
        boot_ids: tuple[int, int] = (1, 2),
    ) -> None:
        self._policy, self._metadata = policy, values.pack(metadata)
        self.thinking_ns = None if thinking is None else seconds_to_ns(thinking)
        sessions = count(1)
        self.robot = RobotEnd(
            1,
            {0: SERVER},
            link or PlainLink(),
            options,
            boot_id=boot_ids[0],
            compress=compress,
        )
        self.server = PolicyEnd(
            gate or PlainGate(),
            boot_id=boot_ids[1],
            draw=lambda: next(sessions),
            gives_rows=gives_rows,
            unpacker=unpacker,
        )
        self.now_ns = 0
        self.answers: list[tuple[int, bytes]] = []
        """Time of each message to the program [ns], and what it says, see `robot.Said`."""
        self.is_cut = False
        """Whether nothing passes."""
        self._ways = [
            _way(to_policy, seed, "to_policy"),
            _way(to_robot, seed, "to_robot"),
        ]
        self._later: list[tuple[int, int, bytes, Address]] = []
        """What the policy's line will hear: time [ns], order, what, and of which robot."""
        self._order = count()
        self.on_datagram: Callable[[Datagram], None] = lambda _: None
        """Called with each datagram as it leaves."""

    def connect(self) -> Any:
        """Connect the program; returns the policy's metadata."""
        self.say(Said.OPENED.value)
        self.run(self.now_ns + CONNECTS_NS, lambda: bool(self.answers))
        if not self.answers:
            raise NoActionError("no policy has answered")
        return values.unpack(self.answers[-1][1][1:])

    def infer(self, observation: Any) -> Any:
        """The policy's reply, from the present row on; time passes until it is there.

        Raises:
            NoActionError: there is nothing to play.
        """
        before = len(self.answers)
        self.say(Said.MESSAGE.value + values.pack(observation))
        # Every call is answered: by its deadline, or with the first chunk.
        self.run(self.now_ns + 3600 * SECOND_NS, lambda: len(self.answers) > before)
        said = self.answers[-1][1]
        if said[:1] == Said.ERROR:
            raise NoActionError(said[1:].decode())
        return values.unpack(said[1:])

    def sleep(self, seconds: float) -> None:
        self.run(self.now_ns + seconds_to_ns(seconds))

    def say(self, said: bytes, peer: Address = PROGRAM) -> None:
        """Let the robot's line hear what a program says."""
        self.robot.receive(Datagram(said, peer, LINE), now_ns=self.now_ns)

    def policy_says(self, said: bytes, peer: Address) -> None:
        """Let the policy's line hear something."""
        self.server.receive(Datagram(said, peer, LINE), now_ns=self.now_ns)

    def run(self, until_ns: int, stop: Callable[[], bool] = lambda: False) -> None:
        """Let time pass until then, or until `stop` is true."""
        while True:
            self._collect(self.robot)
            self._collect(self.server)
            if stop():
                return
            ends = [self.robot.next_wake_ns(), self.server.next_wake_ns()]
            ends += [link.next_due_ns() for link, _ in self._ways]
            due = [each for each in ends if each is not None]
            due += [self._later[0][0]] if self._later else []
            next_ns = max(min([*due, until_ns]), self.now_ns)
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
            elif socket == LINE:
                self._ask(payload, peer)
            else:
                self.on_datagram(datagram)
                link, lane = self._ways[peer != SERVER]
                if not self.is_cut:
                    link.accept(Datagram(payload, peer, 0), lane, now_ns=self.now_ns)

    def _ask(self, payload: bytes, peer: Address) -> None:
        if payload[:1] == Said.OPENED:
            self._answer(Said.OPENED.value + self._metadata, peer, 0)
        elif payload[:1] == Said.MESSAGE and self.thinking_ns is not None:
            try:
                said = Said.MESSAGE.value + values.pack(self._policy(values.unpack(payload[1:])))
            except Exception as error:
                said = Said.ERROR.value + str(error).encode()
            self._answer(said, peer, self.thinking_ns)

    def _answer(self, said: bytes, peer: Address, after_ns: int) -> None:
        heappush(self._later, (self.now_ns + after_ns, next(self._order), said, peer))


def _way(text: str, seed: int, name: str) -> tuple[Link, Lane]:
    try:
        made = impairments(text, reading.files_of("network.uplink", text, name))
    except GrammarError as error:
        raise ConfigError(f"{name}: {error}") from None
    return Link(0, QUEUE_BYTES_MAX, None, made), Lane(0, Fates(made, seed, name, 0), 0)
