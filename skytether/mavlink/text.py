"""Sentences in STATUSTEXT: 50 bytes a message, and longer ones in chunks that are put together."""

from collections import OrderedDict

from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect

CHUNK_BYTES = 50
"""Longest text of a message [B]."""
UNFINISHED_MAX = 8
"""Most texts that wait for their last chunk; the oldest gives way."""
CHUNKS_MAX = 8
"""Most chunks that are put together."""


def chunks(severity: int, text: str, number: int) -> list[Message]:
    """Messages that say a text.

    Args:
        severity: MAV_SEVERITY.
        text: what is said.
        number: number of the text from 1 to 65535, which tells its chunks from another's.
    """
    said = text.encode()
    parts = [said[at : at + CHUNK_BYTES] for at in range(0, len(said), CHUNK_BYTES)]
    if len(said) % CHUNK_BYTES == 0:
        parts.append(b"")  # a chunk that is not full is the last one
    own = number if len(parts) > 1 else 0
    return [
        dialect.MAVLink_statustext_message(severity, part, own, k) for k, part in enumerate(parts)
    ]


class Texts:
    """Puts the chunks of texts together."""

    def __init__(self) -> None:
        self._begun: OrderedDict[tuple[int, int, int], list[str]] = OrderedDict()
        """Chunks so far of each text, by its system, component and number."""

    def take(self, message: Message) -> str | None:
        """Text that a message has ended; None where there is more to come, or its begin is lost."""
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
