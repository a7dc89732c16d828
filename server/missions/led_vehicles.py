"""Led vehicles: which vehicles of a mission follow this server, with a standby server or without.

A server plans motions only if every vehicle of the mission has sent it the same number, with which
this server leads, and was observed since (docs/together-proof.md, Two servers).
"""

from skytether.shared.law.model import Indices
from skytether.shared.wire.lead import Lead


class LedVehicles:
    def __init__(self) -> None:
        self._numbers: dict[int, int | None] = {}
        """Number of the leadership with which each row is led by this server; None if another
        server leads it."""
        self._alone: set[int] = set()
        """Rows of vehicles that have no other server."""
        self._awaited: dict[int, int] = {}
        """Rows that this server has begun to lead and has not observed since, with the step from
        which on an observation was made under its lead."""
        self.missing: int | None = None
        """Row because of which no motion may be planned; None if there is none."""

    def follow(self, row: int, lead: Lead | None) -> bool:
        """Note who leads a vehicle; returns whether `lead` may contain a motion to take over."""
        if lead is None:
            self._alone.add(row)
        else:
            self._alone.discard(row)
        leads = lead is None or bool(lead.leads)
        self._numbers[row] = (lead.number if lead else 0) if leads else None
        if lead is not None and leads:
            self._awaited[row] = lead.step
        self._look()
        return lead is not None and leads

    def leads(self, row: int) -> bool:
        return self._numbers.get(row, 0) is not None

    @property
    def is_standby(self) -> bool:
        """Whether all vehicles that were heard are led by another server."""
        return bool(self._numbers) and set(self._numbers.values()) == {None}

    def awaits(self, row: int) -> bool:
        """Whether nothing was observed of a vehicle since this server began to lead it."""
        return row in self._awaited

    def observed(self, rows: Indices, observed_step: Indices) -> None:
        """Note the newest observations of vehicles."""
        if self._awaited:
            for row in self._awaited.keys() & set(rows.tolist()):
                if observed_step[row] >= self._awaited[row]:
                    del self._awaited[row]
            self._look()

    def _look(self) -> None:
        newest = max((each or 0 for each in self._numbers.values()), default=0)
        missing = (
            row for row, number in self._numbers.items() if number != newest or row in self._awaited
        )
        # Where a vehicle has no other server, that server never hears all, and plans nothing.
        # Whatever the others say, they fly what this server has sent, or hold their place.
        self.missing = None if self._alone else next(missing, None)
