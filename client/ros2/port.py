"""The connection to a robot as an endpoint; topics take the place of the datagrams' addresses.

    in   odometry; other nodes' commands; tokens that announce other nodes (removed: empty payload)
    out  commands, at each of the pilot's steps; after a landing zeros for ZEROS_NS, then silence

Commands have the type that a subscriber accepts: TwistStamped or Twist. Without a subscriber of one
of these types no flight begins, because the robot would not move.

No command is repeated: if the pilot stops, the robot's own time-out acts.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

from skytether.client.positions import Vector
from skytether.client.ros2 import drive
from skytether.client.ros2.keys import Ros2Config
from skytether.client.ros2.odometry import OdometryFilter
from skytether.ros2 import messages
from skytether.ros2.graph import PUBLISHER, SUBSCRIBER, TOKENS, Entity, Node, Topic, entity_of
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Datagram, Endpoint, by_name
from skytether.shared.endpoints.line import Line
from skytether.shared.events.aboard import OdometryDropped, SecondPublisher
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason

TICK_NS = 100 * MILLISECOND_NS
"""Interval at which timers are checked while nothing arrives."""
ZEROS_NS = 500 * MILLISECOND_NS
"""Time for which zero velocities are commanded at the end of a flight, before the silence."""
CLOSES = 3
"""Number of zero velocities sent when the process ends."""
ZERO = 0.0, 0.0, 0.0
RIVAL_NS, RIVALS_LEAST = SECOND_NS, 2
"""Window, and number of other nodes' commands within it that reveal a second commander."""
QUIET_NS = 3 * SECOND_NS
"""Silence after which a second commander counts as gone."""
REPORT_NS = 10 * SECOND_NS
"""Time after which a second commander is reported again."""
ENTITIES_MAX = 96
"""Largest number of other nodes' publishers and subscribers that are stored."""


class Port(Endpoint):
    """Connection to one robot."""

    def __init__(self, scenario: Scenario, vehicle: int, line: Line) -> None:
        super().__init__()
        keys = self._keys = scenario.section(Ros2Config)
        self._vehicle, self._step_ns = vehicle, scenario.dt_ns
        self._silence_ns = seconds_to_ns(keys.silence_s)
        stamped, plain = (
            messages.topic(keys.command, kind) for kind in (messages.TWIST_STAMPED, messages.TWIST)
        )
        self.node = Node(
            line.host,
            line.number,
            keys.domain,
            f"skytether_{vehicle}",
            stamped if keys.stamped else plain,
            messages.topic(keys.odometry, messages.ODOMETRY),
            (plain,) if keys.stamped == "auto" else (),
        )
        self.odometry = OdometryFilter(scenario, vehicle)
        self._entities: dict[str, Entity] = {}
        """Other nodes' publishers and subscribers of the client's topics, by token."""
        self._form: int | None = None
        """Index of the commands' type in `Node.forms`; None before the first command."""
        self._rivals_ns: deque[int] = deque(maxlen=RIVALS_LEAST)
        self._rival_ns: int | None = None
        """Time of the newest command of a second commander; None without one."""
        self._reported_ns: int | None = None
        self._reported_fault = False
        self._tick_ns = self._zero_ns = 0
        self._silent_ns: int | None = None
        """Time at which the zeros after a landing end; None before the landing."""
        self._commands = self._rival_commands = 0
        self.now_ns = 0

    # -- for the vehicle ---------------------------------------------------------------------

    @property
    def is_down(self) -> bool:
        """Whether the client has sent no commands to the robot, or has stopped sending them."""
        return not self._commands or (
            self._silent_ns is not None and self.now_ns >= self._silent_ns
        )

    @property
    def is_ready(self) -> bool:
        return self._has_odometry and self._known_form is not None

    @property
    def _has_odometry(self) -> bool:
        return self.odometry.newest is not None and self._is_fresh(self.now_ns)

    @property
    def _known_form(self) -> int | None:
        """Index of the commands' type; None while no type has a subscriber."""
        if self._form is not None:
            return self._form
        takers = self._those(SUBSCRIBER, self._keys.command)
        taken = (
            index
            for index, topic in enumerate(self.node.forms)
            if any(each.takes(topic) for each in takers)
        )
        return next(taken, None)

    def _those(self, kind: str, topic: str) -> list[Entity]:
        entities = self._entities.values()
        return [each for each in entities if (each.kind, each.topic) == (kind, topic)]

    @property
    def waits_for(self) -> str:
        if self.is_ready:
            return ""
        keys, node = self._keys, self.node
        wanted = f"nav_msgs/Odometry on {keys.odometry}"
        at = f", domain {keys.domain}, at {node.host}:{node.port}"
        if self._is_past(self.odometry.positions.heard_ns, self.now_ns):
            sources = self._those(PUBLISHER, keys.odometry)
            others = [each for each in sources if not each.takes(node.subscribes)]
            return f"{wanted}{at}" + _instead(others, [node.subscribes])
        if not self._has_odometry:
            return f"usable {wanted}: {self.odometry.fault}"
        kinds = " or ".join(topic.kind.replace("/msg/", "/") for topic in node.forms)
        others = self._those(SUBSCRIBER, keys.command)
        return f"a subscriber of {kinds} on {keys.command}{at}" + _instead(others, node.forms)

    def fly(self, velocity: Vector) -> None:
        if self._silent_ns is None:
            self._command(velocity)

    def land(self) -> None:
        if self._silent_ns is None:
            self._silent_ns, self._zero_ns = self.now_ns + ZEROS_NS, self.now_ns

    def hindrance(self, *, now_ns: int) -> Reason | None:
        """Reason that forbids following a plan: second commander, silence or unusable odometry."""
        self.now_ns = now_ns
        if self._rival_ns is not None and now_ns - self._rival_ns <= QUIET_NS:
            return Reason.RIVAL
        positions = self.odometry.positions
        if self._is_fresh(now_ns):
            self._reported_fault = False
            return None
        if self._is_past(positions.heard_ns, now_ns):
            return Reason.MUTE
        if not self._reported_fault and self.odometry.fault:
            self._reported_fault = True
            self._events.append(OdometryDropped(vehicle=self._vehicle, why=self.odometry.fault))
        return Reason.UNUSABLE

    def _is_fresh(self, now_ns: int) -> bool:
        return not self._is_past(self.odometry.positions.came_ns, now_ns)

    def _is_past(self, came_ns: int | None, now_ns: int) -> bool:
        return came_ns is None or now_ns - came_ns > self._silence_ns

    # -- received ----------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self.now_ns = now_ns
        payload, (topic, _), _ = datagram
        if topic == self._keys.odometry:
            self.odometry.hear(payload, now_ns=now_ns)
        elif topic == self._keys.command:
            self._hear_rival(now_ns)
        elif topic.startswith(TOKENS):
            self._hear_token(topic, is_gone=not payload)

    def _hear_rival(self, now_ns: int) -> None:
        self._rival_commands += 1
        self._rivals_ns.append(now_ns)
        if len(self._rivals_ns) < RIVALS_LEAST or now_ns - self._rivals_ns[0] > RIVAL_NS:
            return
        self._rival_ns = now_ns
        if self._silent_ns is not None:  # after the flight other nodes may command the robot
            return
        if self._reported_ns is None or now_ns - self._reported_ns >= REPORT_NS:
            self._reported_ns = now_ns
            topic = self._keys.command
            nodes = tuple(sorted({each.node for each in self._those(PUBLISHER, topic)}))
            self._events.append(SecondPublisher(vehicle=self._vehicle, topic=topic, nodes=nodes))

    def _hear_token(self, token: str, *, is_gone: bool) -> None:
        if is_gone:
            self._entities.pop(token, None)
        elif (entity := entity_of(token)) and len(self._entities) < ENTITIES_MAX:
            self._entities[token] = entity

    # -- sent --------------------------------------------------------------------------------

    def wake(self, *, now_ns: int) -> None:
        self.now_ns = now_ns
        self._tick_ns = now_ns + TICK_NS
        if self._silent_ns is not None and self._zero_ns <= now_ns < self._silent_ns:
            self._zero_ns = now_ns + self._step_ns
            self._command(ZERO)

    def next_wake_ns(self) -> int:
        if self._silent_ns is None or self.now_ns >= self._silent_ns:
            return self._tick_ns
        return min(self._tick_ns, self._zero_ns)

    def _command(self, velocity: Vector) -> None:
        newest, keys, form = self.odometry.newest, self._keys, self._known_form
        if newest is None or form is None:
            return
        self._form = form
        command = drive.command(velocity, newest, keys.drive, keys.ahead_m)
        payload = messages.twist(command.linear, command.turn)
        if self.node.forms[form].kind == messages.TWIST_STAMPED:
            stamp_ns = self.odometry.clock.boot_ns(self.now_ns)
            payload = messages.twist_stamped(stamp_ns, *command)
        self._commands += 1
        self.send(payload, (keys.command, form))

    def close(self, *, now_ns: int) -> None:
        """Send zero velocities, because not every robot stops when commands end."""
        self.now_ns = now_ns
        if self._commands and not self.is_down:
            for _ in range(CLOSES):
                self._command(ZERO)

    def figures(self) -> dict[str, Any]:
        """Figures under the names of an autopilot's figures, so that the same metrics show them."""
        return {
            "measurements": self.odometry.positions.taken,
            "heard": self.odometry.heard,
            "setpoints": self._commands,
            "dropped": by_name(self.odometry.positions.dropped)
            | {"for_others": self._rival_commands},
            "drift_ppm": 1e6 * self.odometry.clock.drift,
        }


def _instead(others: Sequence[Entity], expected: Iterable[Topic]) -> str:
    """Message that the type found differs from the expected one; empty if no type was found."""
    if not others:
        return ""
    hashes = " or ".join(topic.type_hash for topic in expected)
    return f"; got {str(others[0])[:200]}, expected {hashes}, as ROS 2 has them from Jazzy on"
