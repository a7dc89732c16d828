"""Doubles: flights over UDP, flown again in virtual time over the recorded fates of their packets.

    rows of both ends → lateness of wake-ups, fates of packets (`doubled`) → a `FlightCase`

The double has the recording's scenario, seed and time at which the session opened. Both ends are
woken as late as recorded. A packet has the fate of the recorded packet of the same time; between
two recorded packets its delay is interpolated, and its loss is that of the nearer packet. So each
packet is handled before the same tick as recorded, and `in_force` and `observed_step` are as
recorded.

**A real vehicle** is replaced by the scenario's model, pushed at each step by the recorded
deviation from the model (`doubled`). What the vehicle would have done with other inputs is less
certain, because of wind in other places and errors of the model.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np

from skytether.explain.cases import Command, Double, FlightCase, Stall
from skytether.explain.flying import CaseOutcome, Track, track
from skytether.explain.moments import AROUND_S, Moment
from skytether.explain.units import COMPUTING, DOUBLED, SETTINGS
from skytether.netem.impairments.draws import SLOT_NS, SLOT_S
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.events.flight import Changed, Flying
from skytether.shared.law.model import Array, Indices
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.scenario.registry import File
from skytether.shared.scenario.whole import Scenario, WithFiles
from skytether.shared.telemetry.ends import COLUMNS, PART, End, Happened
from skytether.shared.telemetry.record import Rows
from skytether.shared.telemetry.summary import WORSE
from skytether.sim.flight import MIDNIGHT_NS

if TYPE_CHECKING:  # the module needs the library of MCAP
    from skytether.view.recordings.recorded import Recorded

NEAR_M = 0.1
"""A double is refused if its distance from the recording exceeds this before the moment [m]."""
NOWHERE = 2**16 - 1
"""Path number of packets that the server exchanged with peers other than the client."""
SENT = Happened.SENT
ENDS: tuple[Literal["client", "server"], ...] = ("client", "server")
ASIDE_NS = 5 * MILLISECOND_NS
"""Time after a stall within which packets that arrived during the stall are handled [ns]."""
SIMULATED = "simulated", "quadrotor"
"""Kinds of simulated vehicles: the seed determines their flight. Other kinds fly as a model."""


@dataclass(frozen=True, slots=True)
class Nearness:
    """Largest distances of a double from its recording at equal steps, after the settling time."""

    until_m: float
    """Largest distance until the moment begins; without a moment, in the whole flight [m]."""
    whole_m: float

    def __str__(self) -> str:
        until, whole = f"{self.until_m:.3f} m", f"{self.whole_m:.3f} m"
        before = f"{until} until then, " if until != whole else ""
        return f"at most {before}{whole} from it in the whole flight"


def double(recorded: "Recorded") -> tuple[FlightCase, Track]:
    """Case of the double of a recorded flight, and track of the recorded flight.

    Raises:
        ConfigError: the recording lacks data that a double needs.
    """
    scenario, dt_ns, rows = recorded.scenario, recorded.scenario.dt_ns, recorded.parts["client"]
    client, server = ends = _ends(recorded)
    began_ns = _began_ns(recorded, client)
    # Time 0 of the double is up to one step before the recording's first frame, so that the
    # server's ticks are due when they were recorded.
    tick_ns = int(_of(server, Happened.WOKEN)["due_ns"][-1])
    zero_ns = recorded.begin_ns - (recorded.begin_ns - tick_ns - MIDNIGHT_NS) % dt_ns
    compute_ns = _compute_ns(server)
    late_ns, stalls, stood_ns = [], list[Stall](), []
    for name, each in zip(ENDS, ends, strict=True):
        late = _late_ns(each)
        late_ns.append({at - zero_ns: by for at, by in late.items() if by < dt_ns})
        stood_ns.append([(at, by) for at, by in late.items() if by >= dt_ns and at > began_ns])
        stalls += [
            Stall(name, (at - zero_ns) / SECOND_NS, by / SECOND_NS) for at, by in stood_ns[-1]
        ]
    opens_ns, fates = [], list[File]()
    for path in range(len(scenario.paths)):
        asked = (client["happened"] == SENT) & (client["peer"] == path)
        opens_ns.append(int(client["time_ns"][_causes(client)[np.argmax(asked)]]))
        way = path, opens_ns[-1]
        fates.append(_fates("up", server, client, *way, compute_ns, stood_ns[0]))
        fates.append(_fates("down", client, server, *way, 0, stood_ns[1]))
    clocks = dict.fromkeys(("simulation.clock_offset_s", "simulation.clock_drift_ppm"), 0.0)
    keys: dict[str, Any] = {"simulation.compute_s": compute_ns / SECOND_NS, **clocks}
    if scenario.vehicle.kind not in SIMULATED:
        gone = (changes for name, changes in SETTINGS if name != COMPUTING)
        keys |= dict(chain.from_iterable(gone))
        keys["vehicle.kind"] = DOUBLED
    # The vehicle's port is due 1 ns before step 0 and woken 1 ns late: it is in the air at step 0.
    late_ns[0][began_ns - zero_ns - 1] = 1
    opens_s, (states, inputs) = (opens_ns[0] - zero_ns) / SECOND_NS, _steps(rows)
    sends = bool((client["due_ns"][_causes(client)[client["happened"] == SENT]] == began_ns).any())
    flown = Double(opens_s, began_ns - zero_ns, sends, late_ns[0], late_ns[1], states, inputs)
    commands = tuple(
        Command(
            (recorded.begin_ns + at_ns - zero_ns) / SECOND_NS,
            event.key,
            msgspec.json.decode(event.after),
        )
        for at_ns, process, event in recorded.events()
        if isinstance(event, Changed) and not process.startswith("netem")
    )
    fated = _with_fates(scenario, fates, keys)
    secure = recorded.about.secure
    case = FlightCase(fated, 1, secure, tuple(stalls), commands, double=flown)
    began_s = (began_ns - zero_ns) / SECOND_NS
    return case, track(scenario, rows, recorded.parts["server"], 1, began_s)


def _ends(recorded: "Recorded") -> tuple[Rows, Rows]:
    """Rows of the client's end and of the server's end; `peer` is the number of a path in both."""
    parts = recorded.parts
    rows = parts.get(PART, np.empty(0, COLUMNS))
    client, server = (rows[rows["end"] == end] for end in (End.CLIENT, End.SERVER))
    vehicles = np.unique(parts["client"]["vehicle"]).tolist()
    servers = {process for _, process, _ in recorded.frames if process.startswith("server")}
    for is_met, expected in (
        (vehicles == [1], f"vehicle 1 alone; got {vehicles}"),
        (len(servers) == 1, f"one run of one server; got {len(servers)}"),
        ("server" in parts and len(client) and len(server), "the packets at both ends"),
    ):
        if not is_met:
            raise ConfigError(f"{recorded.path}: it cannot be flown again, expected {expected}")
    return client, _on_paths(client, server)


def _on_paths(client: Rows, server: Rows) -> Rows:
    """The server's rows, with the client's path numbers as `peer`. Packets that were sent only once
    show which path is which; the client numbers its paths in the order of their first use.
    """
    both = Counter[tuple[int, int]]()
    for sender, receiver in ((client, server), (server, client)):
        sent, received = _of(sender, SENT), _of(receiver, Happened.RECEIVED)
        packets, first, counts = np.unique(sent["packet"], return_index=True, return_counts=True)
        once = dict(
            zip(
                packets[counts == 1].tolist(),
                sent["peer"][first[counts == 1]].tolist(),
                strict=True,
            )
        )
        for packet, peer in received[["packet", "peer"]].tolist():
            if packet in once:
                both[(once[packet], peer) if sender is client else (peer, once[packet])] += 1
    paths = {peer: path for (path, peer), _ in reversed(both.most_common())}
    server = server.copy()
    server["peer"] = [paths.get(peer, NOWHERE) for peer in server["peer"].tolist()]
    return server


def _of(rows: Rows, happened: Happened) -> Rows:
    return rows[rows["happened"] == happened]


def _began_ns(recorded: "Recorded", client: Rows) -> int:
    """Time of step 0 [ns]: the wake near `Flying` that is whole steps away from most wakes."""
    times_ns = (at_ns for at_ns, _, event in recorded.events() if isinstance(event, Flying))
    flying_ns, dt_ns = recorded.begin_ns + next(times_ns, 0), recorded.scenario.dt_ns
    due_ns = _of(client, Happened.WOKEN)["due_ns"]
    near = due_ns[np.abs(due_ns - flying_ns) < dt_ns].tolist()
    if not near:
        message = "it cannot be flown again, its first step is not recorded"
        raise ConfigError(f"{recorded.path}: {message}")
    steps = [int(((due_ns - each) % dt_ns == 0).sum()) for each in near]
    return int(near[int(np.argmax(steps))])


def _causes(rows: Rows) -> Indices:
    """Number of the row (wake or arrival) that caused each row; a wake or arrival causes itself."""
    is_sent = rows["happened"] == SENT
    return np.maximum.accumulate(np.where(is_sent, 0, np.arange(len(rows))))


def _arrivals(sender: Rows, receiver: Rows) -> dict[int, int]:
    """Row at which each packet that arrived was received, by the row at which it was sent."""
    sent, found = defaultdict[tuple[int, int], list[int]](list), dict[int, int]()
    for number in np.flatnonzero(sender["happened"] == SENT).tolist():
        sent[_packet(sender[number])].append(number)
    for number in np.flatnonzero(receiver["happened"] == Happened.RECEIVED).tolist():
        equal = sent[_packet(receiver[number])]
        # Of identical packets, such as repeated HELLOs, the newest sent before the arrival counts.
        before = sum(sender["time_ns"][each] <= receiver["time_ns"][number] for each in equal)
        if equal:
            found[equal.pop(max(0, before - 1))] = number
    return found


def _packet(row: np.void) -> tuple[int, int]:
    """Path and hash of a packet; its copies on several paths have the same hash."""
    return int(row["peer"]), int(row["packet"])


def _compute_ns(server: Rows) -> int:
    """Median time from a tick of the server until its packets are sent [ns]."""
    cause = _causes(server)
    is_it = (server["happened"] == SENT) & (server["happened"][cause] == Happened.WOKEN)
    passed_ns = (server["time_ns"] - server["time_ns"][cause])[is_it]
    return int(np.median(passed_ns)) if len(passed_ns) else 0


def _late_ns(rows: Rows) -> dict[int, int]:
    """Lateness of each wake-up of an end [ns], by the time at which the wake-up was due [ns]."""
    woken = _of(rows, Happened.WOKEN)
    late_ns = woken["time_ns"] - woken["due_ns"]
    return dict(zip(woken["due_ns"].tolist(), late_ns.tolist(), strict=True))


def _fates(
    way: str,
    sender: Rows,
    receiver: Rows,
    path: int,
    opens_ns: int,
    compute_ns: int,
    stood_ns: Sequence[tuple[int, int]],
) -> File:
    """File for `doubled`: delay and loss of each packet of a path and direction.

    Args:
        opens_ns: time at which the path's first packet is sent; times in the file count from it.
        compute_ns: time from a tick until its packets are sent.
        stood_ns: beginning and length of each stall of the receiver.
    """
    cause, came = _causes(sender), _arrivals(sender, receiver)
    is_tick = sender["happened"][cause] == Happened.WOKEN
    sent_ns = sender["time_ns"][cause] + np.where(is_tick, compute_ns, 0)
    took_ns = {n: max(0, int(receiver["time_ns"][to] - sent_ns[n])) for n, to in came.items()}
    usual_ns = int(np.median([*took_ns.values()] or [0]))
    for number, to in came.items():
        came_ns = int(receiver["time_ns"][to])
        if any(0 < came_ns - at_ns <= for_ns + ASIDE_NS for at_ns, for_ns in stood_ns):
            took_ns[number] = min(usual_ns, took_ns[number])
    slots, lines = Counter[int](), list[str]()
    for number in np.flatnonzero((sender["happened"] == SENT) & (sender["peer"] == path)).tolist():
        slot, is_lost = int(sent_ns[number] - opens_ns) // SLOT_NS, number not in came
        delay_s = took_ns.get(number, usual_ns) / SECOND_NS
        lines.append(f"{slot * SLOT_S:.3f},{delay_s:.9f},{is_lost:d},{slots[slot]}")
        slots[slot] += 1
    first = [] if slots[0] else [f"0.000,{usual_ns / SECOND_NS:.9f},0,0"]
    text = "\n".join(["time_s,delay_s,lost,rank", *first, *lines, ""])
    return File(f"recorded-{way}link-{path + 1}.csv", text.encode())


def _with_fates(scenario: Scenario, fates: Sequence[File], keys: Mapping[str, Any]) -> Scenario:
    """Scenario with changed keys and two files of fates for each path: uplink, then downlink."""
    texts = [f"doubled({each.name})" for each in fates]
    network = scenario.network
    paths = tuple(
        msgspec.structs.replace(each, uplink=up, downlink=down)
        for each, up, down in zip(network.paths, texts[::2], texts[1::2], strict=False)
    )
    up, down = texts[:2]
    network = msgspec.structs.replace(network, uplink=up, downlink=down, paths=paths)
    fields = {name: getattr(scenario, name) for name in Scenario.__struct_fields__}
    named = WithFiles(**{**fields, "network": network}, contents=(*scenario.files, *fates))
    table = reading.to_table(named)
    set_keys(dict(keys), table)
    return reading.check(table, checked=named)


def _steps(client: Rows) -> tuple[Array, Array]:
    """States and inputs of all steps; missed steps have interpolated states, and the last input."""
    step, states = client["step"], client["state"]
    steps = np.arange(int(step[-1]) + 1)
    columns = [np.interp(steps, step, each) for each in states.reshape(len(states), -1).T]
    before = np.searchsorted(step, steps, side="right") - 1
    through = np.stack(columns, -1).reshape(-1, *states.shape[1:])
    return through, client["input"][np.maximum(before, 0)]


def nearness(
    flown: CaseOutcome, recorded: Track, moment: Moment | None, settled_s: float
) -> Nearness:
    """Distances of a double from its recording.

    Args:
        settled_s: time since step 0 from which on distances count [s].

    Raises:
        ConfigError: the double does not fly, is too far away, or brakes at another time.
    """
    if not flown.tracks:
        raise ConfigError("its double does not fly")
    own = flown.tracks[0]
    at_s, mine, its = np.intersect1d(own.step_s, recorded.step_s, return_indices=True)
    mine, its = mine[at_s >= settled_s], its[at_s >= settled_s]
    distance_m = np.linalg.norm(own.position_m[mine] - recorded.position_m[its], axis=1)
    time_s = own.time_s[mine]
    until = time_s <= (moment.start_s if moment else np.inf)
    near = Nearness(*(float(each.max(initial=0.0)) for each in (distance_m[until], distance_m)))
    if near.until_m > NEAR_M:
        departs_s = time_s[np.argmax(distance_m > NEAR_M)]
        raise ConfigError(
            f"its double is {near.until_m:.2f} m away before the moment, expected at most "
            f"{NEAR_M} m: it departs at {departs_s:.2f} s, because of something that is not "
            "recorded, such as a pilot's commands or another process"
        )
    around = np.abs(recorded.time_s - moment.start_s) <= AROUND_S if moment else np.array([])
    if moment and moment.kind == "brake" and not np.isin(recorded.mode[around], WORSE).any():
        says = f"its double {moment.says} at {moment.start_s:.2f} s"
        raise ConfigError(f"{says}, unlike the recorded flight")
    return near
