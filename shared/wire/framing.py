"""Loss report that precedes a message in a session with several paths.

`shared.wire.paths` explains the contents. An end with a single path ignores the report.
"""

from struct import Struct
from typing import NamedTuple

from skytether.shared.wire.drop import Drop, ProtocolError

PATHS_MAX = 4
HEAD, BIN8 = Struct("<HH"), 0xC4


class Report(NamedTuple):
    """Loss report that precedes a message."""

    sequence: int
    newest: int
    arrived: tuple[int, ...]


def split(payload: bytes) -> tuple[Report | None, bytes]:
    """Loss report that precedes a message, or None, and the message.

    Raises:
        ProtocolError: the report is incomplete, or not for 2 to PATHS_MAX paths.
    """
    if not payload or payload[0] != BIN8:
        return None, payload
    count, odd = divmod(payload[1] - HEAD.size, 2) if len(payload) > 1 else (0, 0)
    end = 2 + HEAD.size + 2 * count
    if odd or not 2 <= count <= PATHS_MAX or len(payload) < end:
        raise ProtocolError(Drop.FIELD)
    sequence, newest = HEAD.unpack_from(payload, 2)
    masks = Struct(f"<{count}H").unpack_from(payload, 2 + HEAD.size)
    return Report(sequence, newest, masks), payload[end:]
