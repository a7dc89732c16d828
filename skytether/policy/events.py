"""Events of both ends of a policy that is far from its robot."""

from skytether.shared.events.flight import Event


class RobotEvent(Event):
    robot: int


class PolicyJoined(RobotEvent):
    sentence = "robot {robot}: session with the policy server at {peer}"
    peer: str


class RobotJoined(RobotEvent):
    sentence = "robot {robot} has joined"


class PolicySilent(RobotEvent):
    sentence = (
        "robot {robot}: nothing from the policy server for {silence_s:.1f} s; saying hello again"
    )
    silence_s: float


class RobotSilent(RobotEvent):
    sentence = "robot {robot}: nothing for {silence_s:.0f} s, its session has ended"
    silence_s: float


class JoinRefused(RobotEvent):
    sentence = "robot {robot}: the policy server refuses it: {reason}"
    reason: str


class ProgramConnected(RobotEvent):
    sentence = "robot {robot}: its program has connected"


class ProgramGone(RobotEvent):
    sentence = "robot {robot}: its program has disconnected"


class Holding(RobotEvent):
    sentence = "robot {robot}: no action is left, it holds"


class PlaysAgain(RobotEvent):
    sentence = "robot {robot}: actions again after {after_s:.2f} s"
    after_s: float


class ObservationRefused(RobotEvent):
    sentence = "robot {robot}: an observation is refused: {reason}"
    reason: str


class UpstreamLost(RobotEvent):
    sentence = "robot {robot}: the policy's connection was lost: {reason}; it is opened again"
    reason: str


class UpstreamFound(RobotEvent):
    sentence = "robot {robot}: connected to the policy"


class ChunkRefused(RobotEvent):
    sentence = "robot {robot}: a chunk is not played: {reason}"
    reason: str


class PolicyFailed(RobotEvent):
    sentence = "robot {robot}: the policy answered with an error: {reason}"
    reason: str
