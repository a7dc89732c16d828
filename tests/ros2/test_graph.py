"""Names on a Zenoh network: those that rmw_zenoh's design document has as examples."""

from hypothesis import example, given
from hypothesis import strategies as st

from skytether.ros2 import graph
from skytether.ros2.graph import Entity, Node, Topic

HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
SESSION = "8b20917502ee955ac4476e0266340d5c"
CHATTER = Topic("/chatter", "std_msgs/msg/String", HASH)
TALKER = Node("127.0.0.1", 7447, 0, "talker", CHATTER, Topic("/a/b", "std_msgs/msg/String", HASH))


def test_a_topic_is_named_like_that_of_rmw_zenoh() -> None:
    assert CHATTER.key(0) == f"0/chatter/std_msgs::msg::dds_::String_/{HASH}"
    assert TALKER.subscribes.key(3) == f"3/a/b/std_msgs::msg::dds_::String_/{HASH}"


def test_tokens_are_like_those_of_rmw_zenoh() -> None:
    """The document's talker has depth 7, and 10 as its entity's number."""
    node, publisher, subscriber = TALKER.tokens(SESSION)
    kind = f"std_msgs::msg::dds_::String_/{HASH}/::,1:,:,:,,"
    assert node == f"@ros2_lv/0/{SESSION}/0/0/NN/%/%/talker"
    assert publisher == f"@ros2_lv/0/{SESSION}/0/1/MP/%/%/talker/%chatter/{kind}"
    assert subscriber == f"@ros2_lv/0/{SESSION}/0/2/MS/%/%/talker/%a%b/{kind}"


def test_the_entity_of_a_token_is_known() -> None:
    node, publisher, subscriber = TALKER.tokens(SESSION)
    kind = "std_msgs::msg::dds_::String_"
    talks = Entity(graph.PUBLISHER, "/talker", "/chatter", kind, HASH)
    assert graph.entity_of(publisher) == talks
    apart = graph.entity_of(publisher.replace("/%/%/", "/%/%robot/"))
    assert apart == talks._replace(node="/robot/talker")
    listens = talks._replace(kind=graph.SUBSCRIBER, topic="/a/b")
    assert graph.entity_of(subscriber) == listens
    assert graph.entity_of(node) is None
    assert talks.takes(CHATTER)
    assert not talks._replace(type_hash="TypeHashNotSupported").takes(CHATTER)


@given(st.text("@ros2_lv/%NMPtalker0:,\0\u20ac\ud800"))
@example("@ros2_lv")
@example("/" * 20)
def test_any_text_is_a_token_or_none(text: str) -> None:
    assert graph.entity_of(text) is None


def test_an_attachment_has_33_bytes_in_the_order_of_rmw_zenoh() -> None:
    publisher = graph.identity(TALKER.publisher(SESSION))
    attachment = graph.attachment(2, 3, publisher)
    assert attachment == bytes([2, *[0] * 7, 3, *[0] * 7, 16]) + publisher
    assert len(attachment) == 33
