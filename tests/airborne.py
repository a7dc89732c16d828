"""Flights with a scripted autopilot in virtual time: server, netem, client and autopilot."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from skytether.autopilot.endpoint import TRUTH_COLUMNS, Autopilot
from skytether.autopilot.faults import parse as parse_fault
from skytether.autopilot.flavours import FlavourName, FlightMode
from skytether.client import vehicles
from skytether.client.endpoint import Client
from skytether.client.memory import SavedState, SavingClient, recall
from skytether.mavlink.codec import Codec, Message
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.endpoints.change import Running
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.events.flight import Event, ModeChanged
from skytether.shared.scenario.reading import check
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import MemoryRecorder, Rows, client_columns
from skytether.shared.wire.protocol import Mode
from skytether.sim.hosts import Clock
from skytether.sim.world import World

SAFE: dict[FlavourName, dict[str, float]] = {
    "ardupilot": {"GUID_TIMEOUT": 1.0, "FS_GCS_ENABLE": 5, "SYSID_MYGCS": 245},
    "px4": {"COM_OBL_RC_ACT": 4},
}
"""Autopilot parameters with which the client accepts the vehicle."""
BOTH: tuple[FlavourName, ...] = ("ardupilot", "px4")
ARM, TAKE_OFF, SET_MODE = 400, 22, 176
"""MAVLink numbers of commands."""
SECOND = 1_000_000_000
OFFSET_NS = 86_400_000_000_000
FIGURE = {
    "shape": "figure-eight",
    "radius_m": 5.0,
    "period_s": 30.0,
    "altitude_m": 2.0,
}
NONE = ""


def documented() -> str:
    """Scenario `field.toml` of docs/fly-a-real-one.md."""
    document = (Path(__file__).parents[1] / "docs" / "fly-a-real-one.md").read_text()
    (table,) = re.findall(r"```toml\n(.*?)```", document, re.DOTALL)
    return str(table)


def scenario(**table: Any) -> Scenario:
    """Figure eight in space over a network without delay, with some keys changed."""
    default: dict[str, Any] = {
        "duration": 10.0,
        "control": {"dt": 0.05},
        "model": {"axes": 3, "tau_s": [0.5, 0.5, 0.25], "u_max": [3.0]},
        "reference": FIGURE,
        "vehicle": {"kind": "mavlink", "address": "udpout:autopilot:0"},
        "network": {"uplink": NONE, "downlink": NONE},
    }
    for key, value in table.items():
        default[key] = default.get(key, {}) | value if isinstance(value, dict) else value
    return check(default, "test")


class Tap(Endpoint):
    """Wrapper around an endpoint: records incoming datagrams; can drop, alter or add outgoing
    ones.
    """

    def __init__(self, inner: Endpoint) -> None:
        super().__init__()
        self.inner = inner
        self._heard: list[tuple[int, bytes]] = []
        """Datagrams that arrived, and when [ns]."""
        self.deaf = self.dumb = False
        """Whether all incoming, and all outgoing, datagrams are dropped."""
        self.alter: Callable[[Message], bytes | None] | None = None
        """Function that returns the bytes sent in place of a message, or None to send it
        unchanged.
        """
        self.extra: list[bytes] = []
        self._reader = Codec(9, 9)

    def heard(self, since_ns: int = 0) -> list[tuple[int, Message]]:
        return [
            (time_ns, message)
            for time_ns, payload in self._heard
            if time_ns >= since_ns
            for message in self._reader.decode(payload)
        ]

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self._heard.append((now_ns, datagram.payload))
        if not self.deaf:
            self.inner.receive(datagram, now_ns=now_ns)
        self._pass_on()

    def wake(self, *, now_ns: int) -> None:
        self.inner.wake(now_ns=now_ns)
        self._pass_on()

    def next_wake_ns(self) -> int | None:
        return self.inner.next_wake_ns()

    def _pass_on(self) -> None:
        sent = self.inner.outbox()
        if self.alter is not None:
            sent = [self._altered(datagram) for datagram in sent]
        if not self.dumb:
            self._out += sent
            self._out += [Datagram(payload, ("client", 1)) for payload in self._take()]
        self._events += self.inner.events()

    def _altered(self, datagram: Datagram) -> Datagram:
        assert self.alter is not None
        messages = self._reader.decode(datagram.payload)  # none of a type that the dialect lacks
        altered = self.alter(messages[0]) if messages else None
        return datagram if altered is None else datagram._replace(payload=altered)

    def _take(self) -> list[bytes]:
        extra, self.extra = self.extra, []
        return extra


def altered(kind: str, **fields: Callable[[Any], Any]) -> Callable[[Message], bytes | None]:
    """Function for `Tap.alter` that replaces fields in messages of one kind."""

    def alter(message: Message) -> bytes | None:
        if message.get_type() != kind:
            return None
        for name, change in fields.items():
            setattr(message, name, change(getattr(message, name)))
        return Codec(1, 1).encode(message)

    return alter


class Air:
    """Flight of a vehicle with an autopilot.

    Args:
        flavour: flavour of the autopilot.
        faults: faults of the autopilot, as on the command line.
        parameters: parameters of the autopilot that replace SAFE.
        sets: whether the client may set parameters.
        host: name of the autopilot's host; "line" is the host of a serial line.
        ready_s: time until the autopilot can be armed [s].
        drift_ppm: drift of the client's clock.
        autopilot_ppm: drift of the autopilot's clock, including its simulation.
        table: keys of the scenario.
    """

    def __init__(
        self,
        flavour: FlavourName = "ardupilot",
        *,
        faults: tuple[str, ...] = (),
        parameters: dict[str, float] | None = None,
        sets: bool = False,
        host: str = "autopilot",
        ready_s: float = 1.0,
        drift_ppm: float = 0.0,
        autopilot_ppm: float = 0.0,
        **table: Any,
    ) -> None:
        self.scenario = scenario(**table)
        self.truth = MemoryRecorder(TRUTH_COLUMNS)
        """True states of the vehicle."""
        self.autopilot = Autopilot(
            self.scenario,
            flavour,
            peers=[("client", 1)] if self.scenario.vehicle.address.startswith("udp:") else [],
            ready_s=ready_s,
            faults=[parse_fault(each) for each in faults],
            recorder=self.truth,
        )
        self.autopilot.flight.parameters |= SAFE[flavour] if parameters is None else parameters
        self.tap = Tap(self.autopilot)
        self.events: list[tuple[int, str, Event]] = []
        self.world = World(lambda time_ns, host, event: self.events.append((time_ns, host, event)))
        self.lives = 0
        flies = vehicles.make(self.scenario, 1)
        if sets:
            assert flies.set_parameters()
        self.flies: Any = flies
        self._recorder = MemoryRecorder(client_columns(self.scenario.model.axes))
        self.client = self._client(0, None)
        clock = Clock(OFFSET_NS, round(1000 * drift_ppm))
        self.world.add(host, self.tap, clock=Clock(0, round(1000 * autopilot_ppm)))
        self.world.add("netem", Proxy(self.scenario, server=("server", 0), flows=1))
        self.world.add("client", self.client, clock=clock)
        server = Server(self.scenario, boot_id=2**60, entropy=bytes)
        self.world.add("server", server, clock=Clock(OFFSET_NS))

    def _client(self, life: int, before: SavedState | None) -> Client:
        client = SavingClient(
            self.scenario,
            self.flies,
            server=("netem", 0),
            vehicle=1,
            boot_id=2**60 + life,
            recorder=self._recorder,
            before=before,
        )
        self._running = Running(client, self.scenario)
        return client

    def restart(self, down_s: float = 1.0, *, remembers: bool = True, **table: Any) -> None:
        """Kill the client's process, and start a new one after `down_s` [s].

        Args:
            remembers: whether the new process finds the state that the old one saved.
            table: keys of the scenario that change for the new process.
        """
        self.world.stop("client")
        self.run(down_s)
        if table:
            self.scenario = scenario(**table)
        self.flies, before, self.lives = vehicles.make(self.scenario, 1), None, self.lives + 1
        kept = self.world.memory("client")
        if remembers and kept:
            now_ns = OFFSET_NS + self.world.now_ns
            before = recall(*kept, now_ns, self.scenario.terms())
        self.client = self._client(self.lives, before)
        self.world.restart("client", self.client)

    @property
    def flight(self) -> Any:
        return self.autopilot.flight

    @property
    def now_s(self) -> float:
        return self.world.now_ns / 1e9

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """Run until a condition holds, for at most `seconds`; returns the time that passed [s]."""
        began_ns, over = self.world.now_ns, []
        until_ns = began_ns + round(1e9 * seconds)
        # End by an action: `World.run` drops the event that lies beyond its limit.
        self.world.at(until_ns, lambda: over.append(True))
        self.world.run(lambda: bool(over) or until(), limit_ns=until_ns)
        return (self.world.now_ns - began_ns) / 1e9

    def until(self, so: Callable[[], object], seconds: float) -> float:
        """Run until a condition holds, which must happen in time; returns the time passed [s]."""
        passed_s = self.run(seconds, lambda: bool(so()))
        assert so(), self.said("client")[-5:]
        return passed_s

    def fly(self, seconds: float = 60.0) -> None:
        self.until(lambda: self.client._pilot.step, seconds)

    def end(self, seconds: float = 120.0) -> None:
        self.until(lambda: self.client.finished, seconds)

    def lands(self, seconds: float = 30.0) -> float:
        """Run until the motors are disarmed; returns the time that passed [s]."""
        return self.until(lambda: not self.flight.armed, seconds)

    def close(self, seconds: float = 0.5) -> int:
        """End the client as a signal does; returns how often it requests a mode afterwards."""
        before = len(self.commands(SET_MODE))
        self.world.act("client", self.client.close)
        self.run(seconds)
        return len(self.commands(SET_MODE)) - before

    def quiet(self, seconds: float) -> None:
        """Run for a time in which the client must send no set-point."""
        since_ns = self.world.now_ns
        self.run(seconds)
        assert not self.setpoints(since_ns)

    def change(self, **values: object) -> None:
        """Set keys of the client, as an operator does; `vehicle__report` is `vehicle.report`."""
        keys = {name.replace("__", "."): value for name, value in values.items()}
        self.world.act("client", lambda now_ns: self._running.change(keys, now_ns=now_ns))

    def take_over(self) -> None:
        self.flight.act(FlightMode.PILOT, "Pilot has taken over")

    @property
    def mode(self) -> Mode:
        return self.client._failsafe.mode

    def rows(self) -> Rows:
        return self._recorder.rows()

    def said(self, host: str = "client") -> list[str]:
        return [str(event) for _, name, event in self.events if name == host]

    def of(self, kind: type[Event]) -> list[Any]:
        return [event for _, name, event in self.events if name == "client" and type(event) is kind]

    def heard(self, kind: str, since_ns: int = 0) -> list[tuple[int, Message]]:
        heard = self.tap.heard(since_ns)
        return [(time_ns, each) for time_ns, each in heard if each.get_type() == kind]

    def setpoints(self, since_ns: int = 0) -> list[tuple[int, Message]]:
        return self.heard("SET_POSITION_TARGET_LOCAL_NED", since_ns)

    def commands(self, command: int) -> list[Message]:
        return [each for _, each in self.heard("COMMAND_LONG") if each.command == command]

    def figures(self) -> dict[str, Any]:
        return self.client.vehicle_figures()["autopilot"]

    def rmse(self, settle_s: float = 5.0) -> float:
        """RMS distance between true and desired position in the plane [m]."""
        rows = self.rows()
        dt = self.scenario.control.dt
        times = rows["step"] * dt
        wanted = self.scenario.make_reference()(times)[:, :2, 0]
        error = rows["state"][:, :2, 0] - wanted
        return float(np.sqrt(np.mean(np.sum(error[times > settle_s] ** 2, axis=1))))

    def json(self) -> list[dict[str, Any]]:
        events = [event for _, name, event in self.events if name == "client"]
        return [msgspec.json.decode(msgspec.json.encode(event)) for event in events]


def flying(flavour: FlavourName, *faults: str, seconds: float = 1.0, **table: Any) -> Air:
    """Vehicle in the air that has followed a plan for some seconds."""
    air = Air(flavour, faults=faults, **{"duration": 60.0} | table)
    air.fly()
    air.until(lambda: air.mode is Mode.TRACK, 5.0)
    air.run(seconds)
    assert air.mode is Mode.TRACK
    return air


def modes(air: Air) -> list[tuple[str, str]]:
    return [(each.after, each.reason) for each in air.of(ModeChanged)]
