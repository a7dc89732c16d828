"""Causes of the plans sent in a flight, from rows of the server's part of the record."""

from typing import NamedTuple

import numpy as np

from skytether.shared.law.model import Array
from skytether.shared.telemetry.record import Compared, Rows


def compared(rows: Rows) -> Array:
    """Figure that the trigger compared in each row of the server's part; shape (n,).

    If nothing was compared, the figure is V(k) of eq. (16), or NaN if the scheme has no V(k).
    """
    names = rows.dtype.names or ()
    figures = np.full(len(rows), np.nan)
    for number in np.unique(rows["compared"]).tolist():
        name = str(Compared(number) or Compared.STATE_GAP)
        if name in names:
            chosen = rows["compared"] == number
            figures[chosen] = rows[name][chosen]
    return figures


class SentBy(NamedTuple):
    """Numbers of plans sent, by cause."""

    above: int
    """Number of plans sent because the trigger's figure was above its threshold, even if a
    heartbeat was due too."""
    due: int
    """Number of other plans sent: as a heartbeat, by a schedule, or as the first plan."""


def sent_by(rows: Rows) -> SentBy:
    """Count the plans sent in rows of the server's part, by cause."""
    sent = rows[rows["event"]]
    above = (sent["compared"] != Compared.NOTHING) & (compared(sent) > sent["threshold"])
    return SentBy(int(above.sum()), int((~above).sum()))
