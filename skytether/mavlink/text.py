"""STATUSTEXT messages. A text of more than 50 bytes is split into several messages, its chunks."""

from collections import OrderedDict

from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect

CHUNK_BYTES = 50
"""Largest number of bytes of text in one message [B]."""
UNFINISHED_MAX = 8
"""Largest number of unfinished texts that are kept; a further text replaces the oldest text."""
CHUNKS_MAX = 8


def chunks(severity: int, text: str, number: int) -> list[Message]:
    """Messages that carry a text.

    Args:
        severity: MAV_SEVERITY.
        number: id of the text, from 1 to 65535; all chunks of the text have this id.
    """
    encoded = text.encode()
    parts = [encoded[at : at + CHUNK_BYTES] for at in range(0, len(encoded), CHUNK_BYTES)]
    if len(encoded) % CHUNK_BYTES == 0:
        parts.append(b"")  # an empty chunk: a text ends with a chunk that is not full
    text_id = number if len(parts) > 1 else 0
    return [
        dialect.MAVLink_statustext_message(severity, part, text_id, k)
        for k, part in enumerate(parts)
    ]


class Texts:
    def __init__(self) -> None:
        self._begun: OrderedDict[tuple[int, int, int], list[str]] = OrderedDict()
        """Received chunks of each unfinished text, by system id, component id and text id."""

    def take(self, message: Message) -> str | None:
        """Text completed by a message; None if chunks are missing."""
        if message.id == 0:
            return str(message.text)
        key = message.get_srcSystem(), message.get_srcComponent(), message.id
        parts = self._begun.setdefault(key, [])
        if message.chunk_seq != len(parts) or len(parts) == CHUNKS_MAX:
            del self._begun[key]
            return None
        parts.append(str(message.text))
        if len(parts[-1].encode()) == CHUNK_BYTES:
            if len(self._begun) > UNFINISHED_MAX:
                self._begun.popitem(last=False)
            return None
        del self._begun[key]
        return "".join(parts)
