"""Form of a message: the datagrams in which it is sent, with parity.

A message is split into blocks of k <= BLOCK_PARTS data parts of equal length, and m parity parts
are added to each block: any k of the k + m parts restore the block. m follows the packet loss
ratio. With 18 data parts and a packet loss ratio of 5 %, 40 % of the messages arrive complete
without parity, and 99.6 % with 4 parity parts.

`parts` encodes the parts; `gym` sends only their sizes.
"""

from math import comb
from typing import NamedTuple

PART_BYTES_MAX = 1120
"""Largest part [B]; with headers and encryption the datagram stays below 1200 B."""
PART_HEAD_BYTES = 40
"""Size of header and encryption of a datagram with a part [B]."""
BLOCK_PARTS = 192
"""Largest number of data parts of a block."""
PARITY_MAX = 64
"""Largest number of parity parts of a block; the code has at most 256 parts."""
WHOLE_MIN = 0.995
"""Required share of complete messages at the measured loss."""


class Form(NamedTuple):
    blocks: int
    data: int
    """Number k of data parts of a block."""
    parity: int
    """Number m of parity parts of a block."""
    length: int
    """Length of each part [B]."""


def form_of(
    size: int, loss: float, *, is_urgent: bool = False, part_bytes: int = PART_BYTES_MAX
) -> Form:
    """Form of a message of this size [B].

    Args:
        loss: packet loss ratio.
        is_urgent: whether at least as many parity parts as data parts are sent, so that any half of
            the parts restores the message.
        part_bytes: largest part [B].
    """
    blocks = blocks_of(size, part_bytes)
    count, length = block_parts(size, blocks, part_bytes)
    parity = max(parity_for(count, loss), count if is_urgent else 0)
    return Form(blocks, count, min(parity, PARITY_MAX), length)


def block_parts(size: int, blocks: int, part_bytes: int = PART_BYTES_MAX) -> tuple[int, int]:
    """Number k of data parts of a block, and the length of each part [B]."""
    count = max(1, -(-size // (blocks * part_bytes)))
    return count, max(1, -(-size // (blocks * count)))


def blocks_of(size: int, part_bytes: int = PART_BYTES_MAX) -> int:
    """Number of blocks of a message of this size [B]."""
    return max(1, -(-size // (part_bytes * BLOCK_PARTS)))


def parity_for(count: int, loss: float) -> int:
    """Number of parity parts with which a block is restored with probability WHOLE_MIN.

    Args:
        count: number of data parts.
        loss: packet loss ratio; losses are assumed independent.
    """
    for extra in range(PARITY_MAX):
        sent = count + extra
        whole = sum(
            comb(sent, lost) * loss**lost * (1.0 - loss) ** (sent - lost)
            for lost in range(extra + 1)
        )
        if whole >= WHOLE_MIN:
            return extra
    return PARITY_MAX
