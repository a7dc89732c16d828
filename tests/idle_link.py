"""Idle link, kept alive by the real code of both ends, and cut at the end of each session.

The vehicle's `Failsafe` and `Hearing`, the server's `Session` and `Hearing`, each on its own grid
of steps, and netem's loss and delay. There is no vehicle and no plan, so only heartbeats are sent.
"""

from heapq import heappop, heappush
from typing import NamedTuple

from skytether.client.failsafe import TRANSITIONS, Failsafe
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.netem.impairments.draws import SLOT_NS
from skytether.server.sessions import Session
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.law.heartbeat import NUMBERS, Hearing
from skytether.shared.scenario.schema import LinkConfig

STEP_NS = 50 * MILLISECOND_NS
"""Length of a step of both ends [ns]; the server's steps begin half a step later."""
SESSION_S = 600
"""Length of a session, which starts without an estimate of the loss [s]."""


class Alive(NamedTuple):
    """Results of an idle link."""

    false_per_h: float
    """False losses of the link per hour, declared by the vehicle."""
    noticed_s: list[float]
    packets_per_s: float
    """Rate of the vehicle's heartbeats."""


def keep(network: str, sessions: int, link: LinkConfig | None = None) -> Alive:
    kept = [_session(network, link or LinkConfig(), seed) for seed in range(1, sessions + 1)]
    false, noticed_s, packets = zip(*kept, strict=True)
    length_s = sessions * SESSION_S
    return Alive(sum(false) * 3600.0 / length_s, list(noticed_s), sum(packets) / length_s)


def _session(network: str, link: LinkConfig, seed: int) -> tuple[int, float, int]:
    """False losses of a session, time to detect its end [s], and packets of the vehicle."""
    timeout_ns, end_ns = seconds_to_ns(link.timeout_s), SESSION_S * SECOND_NS
    up, down = (Fates(impairments(network), seed, name, 0) for name in ("uplink", "downlink"))
    ear = Hearing(timeout_ns, STEP_NS, link.fixed_ns)
    failsafe = Failsafe(
        TRANSITIONS,
        armed=True,
        timeout_ns=timeout_ns,
        brake_ns=0,
        land_after_ns=end_ns,
    )
    nowhere = ("nowhere", 0)
    hearing = Hearing(link.patience_ns, STEP_NS, link.fixed_ns)
    server = Session(1, 1, 1, nowhere, nowhere, _Unsealed(), hearing)
    asked, said, told_ns, heard_ns = ear.silence, 0, -end_ns, 0
    false, is_lost, never_ns = 0, False, 2 * end_ns
    failsafe.heard(now_ns=0)
    under_way: list[tuple[int, bool, int, int]] = []
    """Heap: arrival time [ns], whether to the vehicle, number, requested silence [half steps]."""
    now_ns = 0
    while True:
        at_ns = under_way[0][0] if under_way else never_ns
        due_ns = _grid(max(told_ns + asked * STEP_NS // 2, now_ns), 0)
        owed_ns = _grid(max(server.sent_ns + server.asked_ns, now_ns), STEP_NS // 2)
        owed_ns = owed_ns if server.asked_ns else never_ns
        lost_ns = never_ns if is_lost else _grid(heard_ns + timeout_ns + 1, 0)
        now_ns = min(at_ns, due_ns, owed_ns, lost_ns)
        if now_ns >= end_ns:
            break
        if now_ns == at_ns:
            _, to_vehicle, number, silence = heappop(under_way)
            if to_vehicle:
                failsafe.heard(now_ns=now_ns)
                ear.hear(number % NUMBERS, number)
                heard_ns, asked, is_lost = now_ns, silence, False
            else:
                server.hearing.hear(number % NUMBERS, number)
                server.asked_ns = silence * STEP_NS // 2
        elif now_ns == lost_ns:
            assert failsafe.is_lost(now_ns)
            is_lost, false = True, false + 1
        elif now_ns == due_ns:
            _send(under_way, down, now_ns, said, ear.silence, to_vehicle=False)
            said, told_ns = said + 1, now_ns
        else:
            assert server.is_heartbeat_due(now_ns)
            asks = server.hearing.silence
            _send(under_way, up, now_ns, server.sent, asks, to_vehicle=True)
            server.sent, server.sent_ns = server.sent + 1, now_ns
    last_ns = max([heard_ns, *(at for at, to_vehicle, _, _ in under_way if to_vehicle)])
    noticed_ns = max(0, _grid(last_ns + timeout_ns + 1, 0) - end_ns)
    return false, noticed_ns / SECOND_NS, said


class _Unsealed:
    """Reply path of a session without encryption."""

    def seal(self, payload: bytes) -> bytes:
        return payload


def _grid(time_ns: int, phase_ns: int) -> int:
    """First start of a step at a time or later [ns]."""
    return -(-(time_ns - phase_ns) // STEP_NS) * STEP_NS + phase_ns


def _send(
    under_way: list[tuple[int, bool, int, int]],
    fates: Fates,
    now_ns: int,
    number: int,
    silence: int,
    *,
    to_vehicle: bool,
) -> None:
    fate = fates.at(now_ns // SLOT_NS)
    if not fate.lost:
        heappush(under_way, (now_ns + fate.delay_ns, to_vehicle, number, silence))
