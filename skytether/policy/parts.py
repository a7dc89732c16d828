"""Split messages into datagrams with parity, and reassemble them.

The number of parts is that of `form`, the code is Reed-Solomon's (zfec). Parts of the blocks are
sent interleaved, so that a burst of losses is spread over the blocks.

Parts are not retransmitted. The receiver keeps the newest HELD_MAX incomplete messages. When a
message is complete, the receiver discards older messages, because the newer one replaces them.
"""

from typing import NamedTuple

import zfec

from skytether.policy.form import PARITY_MAX, block_parts, blocks_of
from skytether.policy.messages import Part
from skytether.policy.values import BYTES_MAX
from skytether.shared.wire.drop import Drop, ProtocolError

HELD_MAX = 4
"""Largest number of incomplete messages that a receiver keeps of a stream."""

_Shape = tuple[int, int, int]
"""Size of a message [B], number of blocks, and number of parity parts of each block."""


def split(message: bytes, session: int, stream: int, number: int, parity: int) -> list[Part]:
    """Parts of a message, with `parity` parity parts of each block, in the order of sending; their
    `sent_us` is 0.
    """
    size, blocks = len(message), blocks_of(len(message))
    count, length = block_parts(size, blocks)
    padded = message.ljust(blocks * count * length, b"\0")
    coded = []
    for block in range(blocks):
        begins = range(block * count * length, (block + 1) * count * length, length)
        data = [padded[at : at + length] for at in begins]
        more = zfec.Encoder(count, count + parity).encode(data)[count:] if parity else []
        coded.append([*data, *more])
    return [
        Part(session, stream, number, size, blocks, parity, block, index, 0, coded[block][index])
        for index in range(count + parity)
        for block in range(blocks)
    ]


class Whole(NamedTuple):
    """Complete message."""

    message: bytes
    repaired: int
    """Number of lost data parts that were restored from parity."""


class Reassembly:
    """Reassembly of the messages of one stream."""

    def __init__(self) -> None:
        self._partial: dict[int, tuple[_Shape, list[dict[int, bytes]]]] = {}
        """Incomplete messages by sequence number: the parts of each block by index."""
        self.newest = -1
        """Sequence number of the newest complete message; -1: none."""
        self.given_up = 0
        """Number of incomplete messages that were discarded, because newer messages arrived."""

    def accept(self, part: Part) -> Whole | None:
        """Accept a part; returns the message if this part completes it.

        Raises:
            ProtocolError: the part's fields are invalid or differ from those of the message's other
                parts, the part is a duplicate, or the message or a newer one is already complete.
        """
        _check(part)
        if part.number <= self.newest:
            raise ProtocolError(Drop.OVERTAKEN)
        held = self._partial.get(part.number)
        shape = part.size, part.blocks, part.parity
        if held is None:
            if len(self._partial) == HELD_MAX:
                oldest = min(self._partial)
                if part.number < oldest:
                    raise ProtocolError(Drop.OVERTAKEN)
                del self._partial[oldest]
                self.given_up += 1
            held = self._partial[part.number] = shape, [{} for _ in range(part.blocks)]
        if held[0] != shape:
            raise ProtocolError(Drop.FIELD)
        blocks = held[1]
        block = blocks[part.block]
        if part.place in block:
            raise ProtocolError(Drop.COPY)
        count, _ = block_parts(part.size, part.blocks)
        if len(block) < count:
            block[part.place] = part.data
        if any(len(each) < count for each in blocks):
            return None
        self.newest = part.number
        older = [number for number in self._partial if number <= part.number]
        self.given_up += len(older) - 1
        for number in older:
            del self._partial[number]
        repaired = sum(index >= count for each in blocks for index in each)
        joined = b"".join(_joined(each, count, part.parity) for each in blocks)
        return Whole(joined[: part.size], repaired)


def _joined(block: dict[int, bytes], count: int, parity: int) -> bytes:
    if all(index < count for index in block):
        return b"".join(block[index] for index in range(count))
    # The decoder requires each received data part at its own index.
    spare = iter([index for index in block if index >= count])
    order = [index if index in block else next(spare) for index in range(count)]
    return b"".join(zfec.Decoder(count, count + parity).decode([block[i] for i in order], order))


def _check(part: Part) -> None:
    if not 0 < part.size <= BYTES_MAX or part.blocks != blocks_of(part.size):
        raise ProtocolError(Drop.FIELD)
    count, length = block_parts(part.size, part.blocks)
    if not (part.block < part.blocks and part.parity <= PARITY_MAX):
        raise ProtocolError(Drop.FIELD)
    if part.place >= count + part.parity or len(part.data) != length:
        raise ProtocolError(Drop.FIELD)
