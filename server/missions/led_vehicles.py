"""Led vehicles: vehicles of a mission that follow this server, with or without a standby server.

A server plans motions only if all vehicles of the mission have sent it the same leadership number
and were observed since then (docs/together-proof.md, Two servers).
"""

from skytether.shared.law.model import Indices
from skytether.shared.wire.lead import Lead


class LedVehicles:
    def __init__(self) -> None:
        self._numbers: dict[int, int | None] = {}
        """Leadership number with which each row's vehicle follows this server; None if the vehicle
        follows another server."""
        self._alone: set[int] = set()
        """Rows of vehicles that have only this server, without a standby server."""
        self._awaited: dict[int, int] = {}
        """First step whose observation ends the wait, by the row of each vehicle that this server
        has begun to lead but has not observed since."""
        self.missing: int | None = None
        """Row of a vehicle that keeps the server from planning motions; None if there is none."""

    def follow(self, row: int, lead: Lead | None) -> bool:
        """Note a vehicle's leader; return whether `lead` may contain a motion to take over."""
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
        """Whether another server leads all vehicles that have sent packets to this server."""
        return bool(self._numbers) and set(self._numbers.values()) == {None}

    def awaits(self, row: int) -> bool:
        """Whether no observation of a vehicle has arrived since this server began to lead it."""
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
        # If a vehicle has only this server, no other server ever observes all vehicles, and so no
        # other server plans. All vehicles fly this server's motions, or hold their positions.
        self.missing = None if self._alone else next(missing, None)
