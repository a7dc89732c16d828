"""What sent the plans of a flight, from rows of the server's part of the record."""

from typing import NamedTuple

import numpy as np

from skytether.shared.law.model import Array
from skytether.shared.telemetry.record import Compared, Rows


def compared(rows: Rows) -> Array:
    """Figure that the trigger compared in each row of the server's part; shape (n,).

    If nothing was compared it is V(k) of eq. (16), or NaN without a figure V(k).
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
    """Number of plans sent, by what sent them."""

    above: int
    """The figure that the trigger compares was above its threshold, also if a sign of life was due
    as well."""
    due: int
    """Plans sent below the threshold: as a sign of life, by a schedule, or as the first plan."""


def sent_by(rows: Rows) -> SentBy:
    """Count the plans sent in rows of the server's part, by what sent them."""
    sent = rows[rows["event"]]
    above = (sent["compared"] != Compared.NOTHING) & (compared(sent) > sent["threshold"])
    return SentBy(int(above.sum()), int((~above).sum()))
