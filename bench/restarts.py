"""Restarts in flight: server, netem and client are killed and stopped during flights over real UDP.

A vehicle flies the demonstration's figure eight, encrypted, over a network of 30 to 50 ms each way
with 5 % loss. Repeatedly one of the three processes is killed with SIGKILL and restarted, at once
or after 3 s in which nothing listens at its port, or stopped with SIGSTOP for 3 s. The vehicle's
reaction is read from its own record.

Speed is compared with the braking curve from the step at which the vehicle brakes, or from 1.2 s
after the process stopped at the latest: 1 s of silence makes the vehicle brake, and 0.2 s are
allowed for packets still in flight and for the step that has begun. With v the speed commanded at
that step and a = `vehicle.brake_mps2`,

    commanded   b(t) = max(0, v - a t)
    true        τ ds/dt = b(t) - s,   s(0) = the true speed at that step

The vehicle follows its command with the lag τ, equal on each axis, so that its speed is at most the
lagged commanded speed; there is no wind. Without the lag in the curve every vehicle would exceed
it. The curve applies until the first horizon that was made after the process was back; then the
vehicle flies again. A vehicle whose own process was stopped brakes when the process wakes, and its
times are counted from there. A vehicle whose process was killed starts again at rest, and must stay
at rest until it flies.
"""

import math
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.children import HOST, ChildProcess, Lab
from bench.harness import TextTable, WakeLateness, progress
from bench.problems import derive
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Flying, ModeChanged
from skytether.shared.law.model import Array
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import parts
from skytether.shared.telemetry.record import Rows
from skytether.shared.wire.protocol import Mode

DOWN_S = 3.0
"""Length of an outage with a closed port, or of a stop [s]."""
BRAKES_S = 1.2
"""Target of the time from an outage to braking [s]."""
RETURNS_S = 3.0
"""Target of the time from the return of a process to flying again [s]."""
ROUNDING_MPS = 1e-6
"""Rounding tolerance of speeds against a curve [m/s]."""

Subject = Literal["server", "netem", "client"]
Way = Literal["killed", "killed, nothing listens for 3 s", "stopped for 3 s"]
SUBJECTS: tuple[Subject, ...] = ("server", "netem", "client")
WAYS: tuple[Way, Way, Way] = ("killed", "killed, nothing listens for 3 s", "stopped for 3 s")
KILLED, CLOSED, STOPPED = WAYS


@dataclass(frozen=True)
class RestartsCounts:
    kills: int
    """Number of kills; after every second kill the port stays closed for 3 s."""
    stops: int
    """Number of stops by SIGSTOP."""
    flight_s: float
    """Least time of flight between two outages [s]."""
    subjects: tuple[Subject, ...] = SUBJECTS


FULL, QUICK = (
    RestartsCounts(kills=50, stops=10, flight_s=5.0),
    RestartsCounts(kills=1, stops=0, flight_s=4.0),
)


class ProcessOutage(NamedTuple):
    subject: Subject
    way: Way
    began_ns: int
    back_ns: int
    """Time since which the process has listened again."""


@dataclass(frozen=True)
class ProcessLife:
    """Record of one run of the vehicle's process."""

    time_ns: NDArray[np.int64]
    """Time at which each row's step begins; shape (n,)."""
    commanded: Array
    """Commanded speed from that time on [m/s]; shape (n,)."""
    speed: Array
    """True speed [m/s]; shape (n,)."""
    off_m: Array
    """Distance from the reference [m]; shape (n,)."""
    in_force: NDArray[np.int64]
    """Step that the horizon in force was made for, -1 if none is; shape (n,)."""
    mode: NDArray[np.uint8]

    @classmethod
    def of(cls, rows: Rows, epoch_ns: int, scenario: Scenario) -> "ProcessLife":
        """Record of a run whose step 0 began at the epoch."""
        state = rows["state"]
        reference = scenario.make_reference()(rows["step"] * scenario.control.dt)
        return cls(
            epoch_ns + rows["step"] * scenario.dt_ns,
            np.linalg.norm(rows["input"], axis=1),
            np.linalg.norm(state[:, :, 1], axis=1),
            np.linalg.norm((state - reference)[:, :2, 0], axis=1),
            rows["in_force"],
            rows["mode"],
        )


@dataclass(frozen=True)
class RestartVerdict:
    """Vehicle's reaction to an outage; None where a figure does not apply."""

    subject: Subject
    way: Way
    down_s: float
    """Length of the outage [s]."""
    brakes_s: float | None
    """Time to braking [s]; None if the process was back before."""
    over_commanded_mps: float | None
    """Largest excess of the commanded speed over its curve, negative if below [m/s]."""
    over_true_mps: float | None
    """Largest excess of the true speed over its curve [m/s]."""
    flies_s: float
    """Time from the return to flying again [s]; infinite if it never flies again."""
    on_path_s: float
    """Time from the return until the vehicle was within half a metre of the reference [s]."""

    @property
    def is_inside(self) -> bool:
        over = (self.over_commanded_mps, self.over_true_mps)
        braked = self.brakes_s is None or self.brakes_s <= BRAKES_S
        return (
            braked
            and all(each is None or each <= ROUNDING_MPS for each in over)
            and self.flies_s <= RETURNS_S
        )


def scenario() -> Scenario:
    """`demo-committed` without wind, on another network, with a time-out of 1 s."""
    way = "paper(0.03, 0.005, 1.0) & loss(0.05)"
    return derive(
        "demo-committed",
        duration=7200.0,
        vehicle={"wind": 0.0, "report": "always"},
        network={"uplink": way, "downlink": way},
        link={"heartbeat_s": 0.1, "timeout_s": 1.0},
    )


def schedule(counts: RestartsCounts) -> list[tuple[Subject, Way]]:
    kills: list[tuple[Subject, Way]] = [
        (subject, CLOSED if number % 2 else KILLED)
        for number in range(counts.kills)
        for subject in counts.subjects
    ]
    stops: list[tuple[Subject, Way]] = [
        (subject, STOPPED) for _ in range(counts.stops) for subject in counts.subjects
    ]
    return [*kills, *stops]


class Processes:
    """Server, netem and a vehicle, each of which can be killed or stopped."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._lab = Lab(stack, folder, scenario())
        self._folder = folder
        self._lives = 0
        self._parts: list[tuple[Path, ChildProcess]] = []
        """Record and process of each run of the vehicle."""
        self._children = {"server": self._lab.server()}
        self._addresses = {"server": self._children["server"].address}
        self._children["netem"] = self._start("netem")
        self._addresses["netem"] = self._children["netem"].address
        self._children["client"] = self._start("client")
        self.wait_for_flight()

    def _start(self, subject: str) -> ChildProcess:
        self._lives += 1
        addresses = self._addresses
        match subject:
            case "server":
                return self._lab.server(addresses["server"])
            case "netem":
                bind = addresses.get("netem", (HOST, 0))
                return self._lab.netem(addresses["server"], bind, seed=self._lives)
        part = self._folder / f"client.{self._lives}"
        child = self._lab.client(addresses["netem"], part)
        self._parts.append((part, child))
        return child

    def suffer(self, subject: Subject, way: Way) -> ProcessOutage:
        child = self._children[subject]
        if way == STOPPED:
            return ProcessOutage(subject, way, *child.freeze(DOWN_S))
        began_ns = child.kill()
        if way == CLOSED:
            time.sleep(DOWN_S)
        child = self._children[subject] = self._start(subject)
        return ProcessOutage(subject, way, began_ns, child.listening_ns())

    def wait_for_flight(self) -> None:
        """Wait until the vehicle reports that it flies a plan, unless it does already."""
        client = self._children["client"]
        while True:
            modes = [line.event for line in client.all(ModeChanged)]
            if modes and getattr(modes[-1], "after", None) == str(Mode.TRACK):
                return
            client.wait_for(ModeChanged, len(modes) + 1)

    def end(self) -> list[ProcessLife]:
        """End the client; returns all runs of the vehicle that flew, in order."""
        self._children["client"].stop()
        flown_scenario = scenario()
        lives = []
        for part, child in self._parts:
            if flying := child.all(Flying):
                lives.append(ProcessLife.of(parts.read(part), flying[0].time_ns, flown_scenario))
        return lives


def judge(
    outage: ProcessOutage, lives: Sequence[ProcessLife], scenario: Scenario
) -> RestartVerdict:
    """Reaction to an outage, from the record."""
    life = _life(outage, lives)
    died = outage.subject == "client" and outage.way != STOPPED
    # A vehicle whose process was stopped can brake only when the process wakes.
    zero_ns = outage.back_ns if outage.subject == "client" else outage.began_ns
    time_s = (life.time_ns - zero_ns) / SECOND_NS
    newest_before = life.in_force[life.time_ns < outage.back_ns].max(initial=-1)
    after = life.time_ns >= outage.back_ns
    resumed = _first(after & (life.mode == Mode.TRACK) & (life.in_force > newest_before))
    on_path = _first(np.arange(len(after)) >= resumed) if resumed < len(after) else resumed
    on_path += _first(life.off_m[on_path:] < 0.5)
    braking = _first((time_s >= 0.0) & (life.mode == Mode.BRAKE)) if not died else len(after)
    begins = 0 if died else min(braking, _first(time_s >= BRAKES_S))
    over: tuple[float | None, float | None] = None, None
    if begins < resumed:
        over = _over(life, slice(begins, resumed), scenario)
    back_s = (life.time_ns - outage.back_ns) / SECOND_NS
    return RestartVerdict(
        outage.subject,
        outage.way,
        (outage.back_ns - outage.began_ns) / SECOND_NS,
        float(time_s[braking]) if braking < resumed else None,
        *over,
        _at(back_s, resumed),
        _at(back_s, on_path),
    )


def _life(outage: ProcessOutage, lives: Sequence[ProcessLife]) -> ProcessLife:
    for life in lives:
        if life.time_ns[-1] > outage.back_ns:
            return life
    return lives[-1]


def _first(which: NDArray[np.bool_]) -> int:
    return int(which.argmax()) if which.any() else len(which)


def _at(values: Array, index: int) -> float:
    return float(values[index]) if index < len(values) else math.inf


def _over(life: ProcessLife, rows: slice, scenario: Scenario) -> tuple[float, float]:
    """Largest excesses of commanded and true speed over their curves [m/s]."""
    time_ns, commanded, speed = life.time_ns[rows], life.commanded[rows], life.speed[rows]
    since_s = (time_ns - time_ns[0]) / SECOND_NS
    curve, lagged = curves(float(commanded[0]), float(speed[0]), since_s, scenario)
    return float((commanded - curve).max()), float((speed - lagged).max())


def curves(
    commanded: float, speed: float, since_s: Array, scenario: Scenario
) -> tuple[Array, Array]:
    """Braking curves of commanded and true speed [m/s].

    Args:
        commanded: v, the commanded speed at the first time [m/s].
        speed: true speed at the first time [m/s].
        since_s: times at which steps begin, the first of them 0 [s]; shape (n,).
    """
    curve = np.maximum(0.0, commanded - scenario.vehicle.brake_mps2 * since_s)
    tau_s, lagged = float(scenario.true_tau_s.max()), np.empty_like(curve)
    lagged[0] = speed
    for i, passed_s in enumerate(np.diff(since_s)):
        # Between two steps the command is constant.
        lagged[i + 1] = curve[i] + (lagged[i] - curve[i]) * math.exp(-passed_s / tau_s)
    return curve, lagged


def measure(counts: RestartsCounts) -> dict[str, Any]:
    lateness, rng, outages = WakeLateness(), np.random.default_rng(1), []
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="skytether-"))
        flight = Processes(stack, Path(folder))
        for subject, way in progress(schedule(counts), "restarts"):
            lateness.sleep(counts.flight_s + float(rng.random()))
            outages.append(flight.suffer(subject, way))
            # After a short outage the vehicle may still be flying: wait until it must have braked.
            lateness.sleep(BRAKES_S)
            flight.wait_for_flight()
        lateness.sleep(counts.flight_s)
        lives = flight.end()
    flown_scenario = scenario()
    return {
        "verdicts": [asdict(judge(outage, lives, flown_scenario)) for outage in outages],
        "wake": lateness.figures(),
    }


def verdicts_of(result: Mapping[str, Any]) -> list[RestartVerdict]:
    return [RestartVerdict(**each) for each in result["verdicts"]]


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    headings = ["process", "times", "down\n[s]", f"brakes [s]\n(≤ {BRAKES_S:g})", "\nworst"]
    headings += ["over curve\n[m/s]", "\ntrue", f"flies [s]\n(≤ {RETURNS_S:g})", "\nworst"]
    headings += ["within\n0.5 m [s]", "\nworst", "outside"]
    rows, verdicts = [], verdicts_of(result)
    for subject in SUBJECTS:
        for way in WAYS:
            those = [each for each in verdicts if (each.subject, each.way) == (subject, way)]
            if those:
                rows.append([f"{subject} {way}", *_row(those)])
    return {"restarts": TextTable(headings, rows)}


def _row(those: Sequence[RestartVerdict]) -> list[str]:
    over = [
        _worst((getattr(each, name) for each in those), ".3f")
        for name in ("over_commanded_mps", "over_true_mps")
    ]
    return [
        str(len(those)),
        f"{np.median([each.down_s for each in those]):.2f}",
        *_both(each.brakes_s for each in those),
        *over,
        *_both(each.flies_s for each in those),
        *_both(each.on_path_s for each in those),
        str(sum(not each.is_inside for each in those)),
    ]


def _both(values: Iterable[float | None]) -> list[str]:
    present = [each for each in values if each is not None]
    return [f"{np.median(present):.2f}", f"{max(present):.2f}"] if present else ["–", "–"]


def _worst(values: Iterable[float | None], spec: str) -> str:
    present = [each for each in values if each is not None]
    return format(max(present), spec) if present else "–"
