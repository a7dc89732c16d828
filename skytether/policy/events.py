"""Log events of the robot end and the policy end."""

from skytether.shared.events.flight import Event


class RobotEvent(Event):
    robot: int


class PolicyJoined(RobotEvent):
    sentence = "robot {robot}: session with `policy serve` at {peer}"
    peer: str


class RobotJoined(RobotEvent):
    sentence = "robot {robot} has joined"


class PolicySilent(RobotEvent):
    sentence = (
        "robot {robot}: no datagram from `policy serve` for {silence_s:.1f} s; sending HELLO again"
    )
    silence_s: float


class RobotSilent(RobotEvent):
    sentence = "robot {robot}: no datagram for {silence_s:.0f} s; its session has ended"
    silence_s: float


class NoWelcome(RobotEvent):
    sentence = (
        "robot {robot}: no reply from `policy serve` at {peers}; check that it runs, that UDP "
        "reaches it, and that both ends have the same keys"
    )
    peers: str


class JoinRefused(RobotEvent):
    sentence = "robot {robot}: refused by `policy serve`: {reason}"
    reason: str


class ProgramConnected(RobotEvent):
    sentence = "robot {robot}: program connected; counted as executed: {counts}"
    counts: str


class ProgramGone(RobotEvent):
    sentence = "robot {robot}: program disconnected"


class Holding(RobotEvent):
    sentence = "robot {robot}: no row remains: {reason}; executing the hold action"
    reason: str


class PlaysAgain(RobotEvent):
    sentence = "robot {robot}: executing rows of the policy again after {after_s:.2f} s"
    after_s: float


class ObservationRefused(RobotEvent):
    sentence = "robot {robot}: observation refused: {reason}"
    reason: str


class UpstreamLost(RobotEvent):
    sentence = "robot {robot}: connection to the policy lost: {reason}; reconnecting"
    reason: str


class UpstreamFound(RobotEvent):
    sentence = "robot {robot}: connected to the policy"


class ChunkRefused(RobotEvent):
    sentence = "robot {robot}: action chunk refused: {reason}"
    reason: str


class PolicyFailed(RobotEvent):
    sentence = "robot {robot}: error of the policy: {reason}"
    reason: str
