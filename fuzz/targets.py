"""Targets by name, each made with a folder for its files."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from random import Random
from types import MappingProxyType

from fuzz.datagrams import SCENARIOS, Decoder, EndpointInFlight
from fuzz.feeds import FeedTarget, PageTarget
from fuzz.handshake import Holder, Strangers
from fuzz.policies import RobotAndPolicy
from fuzz.recordings import RecordingFile
from fuzz.target import Target
from fuzz.texts import ControlTarget, LogLines, NamedFiles, ScenarioFile


class Both(Target):
    """Several targets that take the same inputs, such as flights in the plane and in 3-D."""

    def __init__(self, *targets: Target) -> None:
        self._targets = targets
        self.code = targets[0].code

    def __call__(self, payload: bytes) -> None:
        for target in self._targets:
            target(payload)

    def seeds(self) -> Sequence[bytes]:
        return self._targets[0].seeds()

    def mutated(self, rng: Random, payload: bytes) -> bytes:
        return self._targets[0].mutated(rng, payload)


TARGETS: Mapping[str, Callable[[Path], Target]] = MappingProxyType(
    {
        "decoder": lambda _: Both(*map(Decoder, SCENARIOS)),
        "flight": lambda _: Both(*map(EndpointInFlight, SCENARIOS)),
        "sealed": lambda _: Both(*(EndpointInFlight(each, sealed=True) for each in SCENARIOS)),
        "handshake": lambda _: Strangers(),
        "holder": lambda _: Holder(),
        "control": lambda _: ControlTarget(),
        "recording": RecordingFile,
        "scenario": ScenarioFile,
        "files": NamedFiles,
        "feed": lambda _: FeedTarget(),
        "page": lambda _: PageTarget(),
        "policy": lambda _: Both(RobotAndPolicy(), RobotAndPolicy(sealed=True)),
        "log": lambda _: LogLines(),
    }
)
