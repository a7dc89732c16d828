"""Names of topics and nodes on a Zenoh network, as in `docs/design.md` of rmw_zenoh.

    topic       <domain>/<topic>/<type>/<type hash>
    token       @ros2_lv/<domain>/<session>/<node>/<entity>/<kind>/<enclave>/<namespace>/<name>
                and, of a publisher or a subscriber, /<topic>/<type>/<type hash>/<quality>
    attachment  sequence number (8 B), time stamp (8 B), 16 (1 B), identity (16 B)

In a token each `/` of a name is written `%`; enclave and namespace of our nodes are empty. Tokens
are Zenoh's liveliness tokens: they end with their session, and `ros2 topic list` shows topics with
a token. Numbers are little-endian.
"""

import struct
from dataclasses import dataclass
from hashlib import blake2b
from typing import NamedTuple

TOKENS = "@ros2_lv"
IDENTITY_BYTES = 16
ATTACHMENT = struct.Struct(f"<qqB{IDENTITY_BYTES}s")
QUALITY = "::,1:,:,:,,"
"""Quality of service in a token: rmw_zenoh's defaults (reliable, volatile, keep the last), and a
depth of 1."""
NODE, PUBLISHER, SUBSCRIBER = "NN", "MP", "MS"
NAME_AT, PARTS = 8, 13
"""Index of the node's name among a token's parts, and number of parts of a publisher's or a
subscriber's token."""


@dataclass(frozen=True, slots=True)
class Topic:
    name: str
    """Name of the topic with its namespace, as in `/cmd_vel`."""
    kind: str
    """Type of the topic's messages, as in `geometry_msgs/msg/Twist`."""
    type_hash: str
    """Hash of the type's definition (REP 2016), as in `RIHS01_…`."""

    @property
    def dds_kind(self) -> str:
        """Name of the type on the network: `geometry_msgs::msg::dds_::Twist_`."""
        package, folder, name = self.kind.split("/")
        return f"{package}::{folder}::dds_::{name}_"

    def key(self, domain: int) -> str:
        return f"{domain}/{self.name.strip('/')}/{self.dds_kind}/{self.type_hash}"


@dataclass(frozen=True, slots=True)
class Node:
    """Node of the ROS graph that Skytether adds to a Zenoh network."""

    host: str
    """Host of a Zenoh router or peer that uses TCP."""
    port: int
    domain: int
    name: str
    publishes: Topic
    subscribes: Topic
    alternatives: tuple[Topic, ...] = ()
    """The published topic with each other message type that it may have. If there are alternatives,
    the first message to publish determines the type."""

    @property
    def forms(self) -> tuple[Topic, ...]:
        """The published topic with each message type that it may have. The peer of a message to
        publish is the topic's name and the index of the message's type in this list.
        """
        return self.publishes, *self.alternatives

    def tokens(self, session: str) -> list[str]:
        """Tokens of node, publisher and subscriber; `session` is the id of the Zenoh session."""
        subscriber = self._token(session, 2, SUBSCRIBER, self.subscribes)
        return [self._token(session, 0, NODE), self.publisher(session), subscriber]

    def publisher(self, session: str, form: int = 0) -> str:
        return self._token(session, 1, PUBLISHER, self.forms[form])

    def _token(self, session: str, number: int, kind: str, topic: Topic | None = None) -> str:
        parts = [TOKENS, str(self.domain), session, "0", str(number), kind, "%", "%", self.name]
        if topic is not None:
            parts += [mangled(topic.name), topic.dds_kind, topic.type_hash, QUALITY]
        return "/".join(parts)

    @property
    def others(self) -> list[str]:
        """Patterns of tokens that the node watches: tokens of other publishers and subscribers of
        its published topic, and of publishers of its subscribed topic.
        """
        out, into = mangled(self.publishes.name), mangled(self.subscribes.name)
        pairs = ((PUBLISHER, out), (SUBSCRIBER, out), (PUBLISHER, into))
        return [f"{TOKENS}/{self.domain}/*/*/*/{kind}/*/*/*/{name}/**" for kind, name in pairs]


class Entity(NamedTuple):
    """Publisher or subscriber of a node."""

    kind: str
    """Kind of the entity: PUBLISHER or SUBSCRIBER."""
    node: str
    """Name of the node, with its namespace."""
    topic: str
    dds_kind: str
    type_hash: str

    def takes(self, topic: Topic) -> bool:
        """Whether the entity has the message type and the type hash of a topic."""
        return (self.dds_kind, self.type_hash) == (topic.dds_kind, topic.type_hash)

    def __str__(self) -> str:
        kind = self.dds_kind.replace("::msg::dds_::", "/").removesuffix("_")
        return f"{self.node} with {kind}, {self.type_hash}"


def mangled(name: str) -> str:
    return name.replace("/", "%")


def entity_of(token: str) -> Entity | None:
    """Publisher or subscriber that a token describes; None for any other text."""
    parts = token.split("/")
    if len(parts) != PARTS or parts[0] != TOKENS or parts[5] not in (PUBLISHER, SUBSCRIBER):
        return None
    named = (part.replace("%", "/") for part in parts[NAME_AT - 1 : NAME_AT + 2])
    namespace, name, topic = named
    return Entity(parts[5], f"{namespace.rstrip('/')}/{name}", topic, *parts[NAME_AT + 2 : -1])


def identity(token: str) -> bytes:
    """Identity of a publisher in its attachments: 16 bytes made from its token."""
    return blake2b(token.encode(), digest_size=IDENTITY_BYTES).digest()


def attachment(number: int, stamp_ns: int, publisher: bytes) -> bytes:
    """Attachment of a message.

    Args:
        number: sequence number of the message, from 1.
        stamp_ns: time of sending since 1970 [ns].
        publisher: `identity` of the publisher.
    """
    return ATTACHMENT.pack(number, stamp_ns, IDENTITY_BYTES, publisher)


def session_settings(node: Node) -> dict[str, object]:
    """Settings of a Zenoh session, as in rmw_zenoh: no multicast; peers learn of each other by
    gossip, so that they stay connected if the router fails.
    """
    host = f"[{node.host}]" if ":" in node.host else node.host
    return {
        "mode": "peer",
        "connect/endpoints": [f"tcp/{host}:{node.port}"],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "listen/endpoints": ["tcp/localhost:0"],  # any free port, for peers on this machine
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
    }
