"""Fuzz target of `skytether.policy`: each payload is used as datagram, observation and reply.

Invariant: whatever the payloads, each call of the robot program gets one answer by its deadline.
"""

from collections.abc import Sequence
from random import Random
from typing import Any

import msgpack
import numpy as np

from fuzz.mutators import bytes_changed, corpus, fields_changed
from fuzz.target import Target
from skytether.client.secure import SecureLink
from skytether.policy import exchange, images, messages, parts, robot, schedule, serving, values
from skytether.policy.images import Compressor
from skytether.policy.robot import FrameType, RobotOptions
from skytether.policy.virtual import ROBOT, SERVER, Emulated, NoActionError
from skytether.server.secure import SecureGate
from skytether.shared.base.chance import stream
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import EVENTS_MAX, Datagram
from skytether.sim.sealed import make_keys

OPTIONS = RobotOptions("delta", 50 * MILLISECOND_NS, begin_ns=SECOND_NS)
OBSERVATION = {"state": np.zeros(2), "image": np.full((32, 40, 3), 9, np.uint8), "prompt": "go"}
LIFE = 500
"""Number of payloads after which both ends are restarted."""
NEWEST = 40
"""Number of newest datagrams used as seeds."""


def rows(_: Any) -> dict[str, Any]:
    return {"actions": np.ones((8, 2), np.float32)}


class RobotAndPolicy(Target):
    """Robot end and policy end, which each receive the payload in addition to their own messages.

    Args:
        sealed: whether the link is encrypted; then each payload is encrypted with the peer's key,
            as by a faulty peer.
    """

    code = (exchange, images, messages, parts, robot, schedule, serving, values)

    def __init__(self, *, sealed: bool = False) -> None:
        self._keyring = make_keys(1, 2) if sealed else None
        self._entropy = stream(1, "entropy").bytes
        self._begin()

    def _begin(self) -> None:
        self._heard = 0
        self._newest: list[bytes] = []
        more: dict[str, Any] = {}
        if self._keyring:
            more["link"] = SecureLink(self._keyring.of(1), entropy=self._entropy)
            more["gate"] = SecureGate(self._keyring, entropy=self._entropy)
        self._link = more.get("link")
        self._lab = Emulated(rows, OPTIONS, compress=Compressor(), **more)
        self._lab.on_datagram = self._note
        self._lab.connect()
        self._call()

    def _note(self, datagram: Datagram) -> None:
        self._newest = [*self._newest[-NEWEST:], datagram.payload]

    def _call(self) -> None:
        lab, before, began_ns = self._lab, len(self._lab.answers), self._lab.now_ns
        program = lab.robot._program
        assert program
        longest_ns = OPTIONS.begin_ns if program.newest < 0 else OPTIONS.deadline_ns
        try:
            reply = lab.infer(OBSERVATION)
        except NoActionError:
            pass
        else:
            assert np.isfinite(reply["actions"]).all()
        assert lab.now_ns - began_ns <= longest_ns
        assert len(lab.answers) == before + 1

    def __call__(self, payload: bytes) -> None:
        if self._heard == LIFE:
            self._begin()
        self._heard += 1
        lab, now_ns = self._lab, self._lab.now_ns
        served = lab.server._robots.get(1)
        to_server = to_robot = payload
        if self._link and served:
            to_server, to_robot = self._link.seal(payload), served.reply.seal(payload)
        lab.server.receive(Datagram(to_server, ROBOT), now_ns=now_ns)
        lab.robot.receive(Datagram(to_robot, SERVER), now_ns=now_ns)
        lab.say(FrameType.MESSAGE.value + payload)
        lab.policy_says(FrameType.MESSAGE.value + payload, ("policy", lab.server._connections))
        lab.run(now_ns + 1)
        lab.sleep(0.1)
        self._call()
        for end in (lab.robot, lab.server):
            assert len(end.events()) <= EVENTS_MAX
        lab.answers.clear()

    def seeds(self) -> Sequence[bytes]:
        """Datagrams of both ends, observations, replies and malformed payloads."""
        packed = [values.pack(each) for each in (OBSERVATION, rows(None), [3, b"", "error"])]
        spoilt = msgpack.packb({b"__jpeg__": b"\xff\xd8\xff\xe0", b"channels_first": True})
        plain = [] if self._link else self._newest
        return (*corpus().values(), *packed, spoilt, *plain)

    def mutated(self, rng: Random, payload: bytes) -> bytes:
        change = fields_changed if rng.random() < 0.5 else bytes_changed
        return change(rng, payload)
