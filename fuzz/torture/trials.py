"""Torture: the real endpoints, encrypted, under a schedule of faults, with invariants checked.

    clients ── saboteur ── netem ── server          on hosts that stop, freeze, and set their clocks
               observer ────┘

The scenario is drawn from a trial's seed, and the faults are part of the trial, so every trial is
reproducible. A failure is a `Violation` of an invariant (`invariants`), or an exception of an
endpoint. A vehicle that has landed is restarted after a while, as an operator would do.
"""

import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import msgspec
import numpy as np

from fuzz.engine import shrink
from fuzz.torture.faults import HARMLESS, FaultKind, ScheduledFault, Trial, schedule
from fuzz.torture.invariants import (
    FLYING,
    Gatekeeper,
    Ledger,
    Violation,
    WatchedLife,
    check_bounds,
)
from fuzz.torture.saboteur import NETEM, OBSERVER, SABOTEUR, SERVER, Observer, Saboteur
from skytether.client import secure as client_secure
from skytether.client.endpoint import Client
from skytether.client.failsafe import GOOD_NS
from skytether.client.link import AGAIN_NS
from skytether.client.several import Several
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.sensor import Sensor
from skytether.client.simulated.vehicle import SimulatedVehicle
from skytether.client.simulated.weather import Weather
from skytether.netem.proxy import Proxy
from skytether.server import secure as server_secure
from skytether.server.endpoint import Server
from skytether.server.mpc.solver import Solver
from skytether.server.planning.clock import BUCKET_NS, BUCKETS, RECENT
from skytether.server.schemes.horizons import HorizonScheme
from skytether.server.sessions import WELCOME_NS
from skytether.shared.base.chance import stream
from skytether.shared.base.units import JUMP_NS, MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.endpoints.steady import Steady
from skytether.shared.events.flight import Event, ModeChanged
from skytether.shared.law.model import Array, Flags
from skytether.shared.scenario import reading
from skytether.shared.scenario.registry import IMPAIRMENTS
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire.channel import LIFE_NS
from skytether.shared.wire.keys import Keyring
from skytether.shared.wire.protocol import Mode
from skytether.sim.hosts import Clock
from skytether.sim.process import VirtualProcess
from skytether.sim.sealed import make_keys
from skytether.sim.standby import STANDBY
from skytether.sim.world import World

CLOCK_NS = 10**7 * SECOND_NS
"""Initial time on all clocks [ns], so large that no backward step makes it negative."""
LANDED_NS = 5 * SECOND_NS
QUIET_NS = SECOND_NS
"""Time for which a flight continues after the recovery deadline [ns]."""
SHORT_S = (8.0, 25.0)
"""Range of the time within which the faults of a short trial begin and end [s]."""
RESTARTED = (FaultKind.RESTART, "client")
TRAJECTORIES = 0.5
REKEYING = 0.3
"""Share of the trials in which vehicles renew their keys every REKEY_NS."""
REKEY_NS = 4 * SECOND_NS
TWO_PATHS = 0.3
"""Share of the trials in which vehicles have a second path."""
SECOND_PATH = ("second netem", 0)
STANDBYS = 0.3
"""Share of the trials with a standby server."""
STANDBY_PATH = ("standby netem", 0)
CHANGES = 3
"""Number of time-outs within which another server comes to lead."""
STEP_FOUND_NS = (BUCKETS + RECENT) * BUCKET_NS
"""Time after a clock step by which the server holds no older clock measurements [ns]."""
FLOWS = 128
"""Capacity of netem in flows: more than a single host may occupy, and fewer than an observer's
ports.
"""
COMPUTE_NS = MILLISECOND_NS


def make_scenario(seed: int) -> tuple[Scenario, int]:
    rng = stream(seed, "torture", "scenario")
    kind = rng.choice(3, p=(0.6, 0.2, 0.2))
    scheme = ("committed", "committed", "predictive")[kind]
    dt_s, axes = (0.05, 0.1)[rng.choice(2, p=(0.25, 0.75))], (2, 3)[rng.integers(2)]
    delay_s = round(float(np.exp(rng.uniform(np.log(0.005), np.log(0.4)))), 3)
    direction = f"paper({delay_s!r}, {delay_s / 20.0!r}, 2.0)"
    table: dict[str, Any] = {
        "seed": seed,
        "duration": 86_400.0,
        "settle": 0.0,
        "model": {"axes": axes, "tau_s": [0.84], "u_max": [1.6]},
        "control": {
            "dt": dt_s,
            "horizon": round(2.0 / dt_s),
            "scheme": scheme,
            "feedback": bool(kind == 1),
            "input_weight": 0.01,  # tight rate limit: inputs change as fast as allowed
            "input_reference": False,
            "trigger": f"{'state_gap' if scheme == 'predictive' else 'cost_gap'} | silence(1)",
        },
        "reference": {
            "shape": "figure-eight",
            "radius_m": 2.0,
            "period_s": 30.0,
            "altitude_m": 3.0 if axes == 3 else 0.0,
        },
        "vehicle": {"exhausted": "brake", "wind": 0.05, "slew_mps2": 5.0},
        "network": {"uplink": direction, "downlink": direction},
        "link": {"heartbeat_s": 0.1, "timeout_s": 1.0, "age_max_s": 3.0, "connect_s": 3600.0},
    }
    vehicles = 1 + int(rng.random() < 0.3)
    if rng.random() < 0.3:
        table["sensor"] = {"position_noise_m": 0.02, "velocity_noise_mps": 0.05}
    if rng.random() < 0.3:
        late_s, gain = rng.uniform(0.0, 0.4, axes), rng.uniform(0.8, 1.2, axes)
        table["model"] |= {"dead_time_s": late_s.tolist(), "gain": gain.tolist()}
    later = stream(seed, "torture", "trajectories")
    if later.random() < TRAJECTORIES:
        _follow_trajectories(table, later)
    return reading.check(table, "torture"), vehicles


def _follow_trajectories(table: dict[str, Any], rng: np.random.Generator) -> None:
    axes = table["model"]["axes"]
    error_m, silence_s = round(rng.uniform(0.003, 0.1), 3), round(rng.uniform(0.3, 2.0), 2)
    gap = f"{round(float(np.exp(rng.uniform(np.log(0.01), np.log(3.0)))), 3)}"
    table["control"] |= {
        "scheme": "trajectory",
        "feedback": True,
        "input_weight": float(rng.choice((0.01, 0.1, 1.0))),
        "spline_error_m": error_m,
        "trigger": str(
            rng.choice(
                (
                    f"expected_gap({gap}) | silence({silence_s})",
                    f"expected_gap({gap}) | heartbeat",
                    f"expected_gap({gap})",
                    f"cost_gap({gap}) | heartbeat | silence({silence_s})",
                    f"deviation({error_m}) | silence({silence_s})",
                    f"(expected_gap({gap}) | heartbeat) & budget(5, 3) | silence({silence_s})",
                )
            )
        ),
    }
    table["reference"]["preview"] = ("all", "none", 1.0, 3.0)[rng.integers(4)]
    table["vehicle"]["report"] = str(
        rng.choice(
            (
                "always",
                f"deviation({error_m}) | silence({silence_s})",
                f"deviation({error_m}) & periodic(2) | silence({silence_s})",
                f"periodic(3) | silence({silence_s})",
            )
        )
    )
    table["link"]["heartbeat_s"] = (0.1, "auto")[rng.integers(2)]
    if rng.random() < 0.3:
        gain = np.broadcast_to(table["model"].get("gain", 1.0), axes)
        table["vehicle"] |= {
            "gain": (gain * rng.uniform(0.8, 1.2, axes)).tolist(),
            "steady_wind_mps": rng.uniform(-0.2, 0.2, axes).tolist(),
        }
    table["control"]["change_weight"] = float(rng.choice((0.0, 0.05, 0.6)))


def short_trial(seed: int) -> Trial:
    rng = stream(seed, "torture", "faults")
    two_paths = stream(seed, "torture", "paths").random() < TWO_PATHS
    standby = stream(seed, "torture", "standby").random() < STANDBYS
    faults = schedule(rng, seconds_to_ns(rng.uniform(*SHORT_S)))
    return Trial(seed, faults, two_paths, standby)


def long_trial(seed: int, hours: float = 1.0) -> Trial:
    """Trial of a number of hours, with faults throughout."""
    return Trial(seed, schedule(stream(seed, "torture", "faults"), seconds_to_ns(3600.0 * hours)))


class TrialOutcome(msgspec.Struct, frozen=True, kw_only=True):
    trial: Trial
    failure: str = ""
    """Violation or exception that ended the trial; empty if there was none."""
    invariant: str = ""
    """Name of the violated invariant, or `raises` for an exception."""
    flown_s: float
    """Length of the trial in virtual time [s]."""
    counts: dict[str, int]
    """Counters of steps, runs of processes, packets and so on, by name."""


class Failing:
    def __init__(self, inner: Solver, share: float, rng: np.random.Generator) -> None:
        self.inner = inner
        self._share = share
        self._rng = rng

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        inputs, solved = self.inner.solve(gradient, guess)
        failed = self._rng.random(len(solved)) < self._share
        inputs[failed] = guess[failed]
        return inputs, solved & ~failed


class Torture:
    def __init__(self, trial: Trial) -> None:
        self.trial = trial
        self.scenario, count = make_scenario(trial.seed)
        self._keyring: Keyring = make_keys(trial.seed, count)
        rekeys = stream(trial.seed, "torture", "keys").random() < REKEYING
        self._rekey_ns = REKEY_NS if rekeys else LIFE_NS
        self._wrong_keys = 0
        """Number of active faults for which the server has wrong keys."""
        self._chance = stream(trial.seed, "torture", "flight")
        self.world = World(self._hear)
        self._up, self._down = Ledger(), Ledger()
        self._calm_ns = 0
        """Virtual time since which no fault is active [ns]; unused while one is."""
        self._under_way = 0
        """Number of faults that are active, or still have effects."""
        restarts = any((each.kind, each.where) == RESTARTED for each in trial.faults)
        steps = any(each.kind is FaultKind.STEP and is_small(each.amount) for each in trial.faults)
        self._step_ns = STEP_FOUND_NS if steps else 0
        """Additional recovery time after a small forward step of a clock [ns], which looks like a
        freeze until the server has newer measurements.
        """
        if trial.standby:
            self._step_ns += CHANGES * seconds_to_ns(self.scenario.link.timeout_s)
        self._recovery_ns = recovery_ns(self.scenario, restarts=restarts) + self._step_ns
        """Time within which a vehicle must fly again after the last fault [ns]."""
        self.counts: Counter[str] = Counter()
        self._servers = 0
        self._processes: dict[str, VirtualProcess[Steady]] = {}
        names = [f"client {number}" for number in range(1, count + 1)]
        self.saboteur = Saboteur(
            stream(trial.seed, "torture", "saboteur"), [(name, 0) for name in names]
        )
        self.world.add(SABOTEUR[0], self.saboteur)
        self.observer = Observer(stream(trial.seed, "torture", "observer"), self.saboteur)
        self.world.add(OBSERVER, self.observer)
        self._add(NETEM[0], self._new_netem)
        if trial.two_paths:
            self._add_netem(SECOND_PATH, SERVER, trial.seed + 2**31)
        if trial.standby:
            self._add_netem(STANDBY_PATH, STANDBY, trial.seed + 2**30)
        self._lives: dict[str, WatchedLife] = {}
        """Newest run of each client."""
        for number, name in enumerate(names, start=1):
            weather = Weather(self.scenario, stream(trial.seed, "wind", number))
            plant = FirstOrderPlant(self.scenario, weather)
            client = partial(self._new_client, name, number, plant)
            self._add(name, client, within_ns=self.scenario.dt_ns)
        self._add(SERVER[0], self._new_server, compute_ns=COMPUTE_NS)
        if trial.standby:
            self._add(STANDBY[0], self._new_standby, compute_ns=COMPUTE_NS)
        self._down_hosts: Counter[str] = Counter()
        """Number of active faults that keep each host down."""
        for fault in trial.faults:
            self._plan(fault)
        self.end_ns = trial.end_ns + self._recovery_ns + QUIET_NS

    def run(self, stopped: Callable[[], bool] = lambda: False) -> TrialOutcome:
        failure = invariant = ""
        try:
            self.world.run(stopped, limit_ns=self.end_ns)
            if not stopped():
                self._check_end()
        except Violation as violation:
            failure, invariant = str(violation), violation.invariant
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            message = f"{type(error).__name__} {error} ({where.filename}:{where.lineno})"
            failure, invariant = f"raises: {message}", "raises"
        for life in self._lives.values():
            self._count(life)
        self.counts += self.saboteur.counts
        return TrialOutcome(
            trial=self.trial,
            failure=f"{self.world.now_ns / SECOND_NS:.3f} s: {failure}" if failure else "",
            invariant=invariant,
            flown_s=self.world.now_ns / SECOND_NS,
            counts=dict(self.counts),
        )

    def _add(
        self, name: str, make: Callable[[int], Steady], *, within_ns: int = 1, compute_ns: int = 0
    ) -> None:
        """Add a host and its process, which starts at a random time before `within_ns`."""
        self._processes[name] = process = VirtualProcess(name, make)
        start_ns, clock = int(self._chance.integers(within_ns)), Clock(CLOCK_NS)
        self.world.add(
            name, process.endpoint, clock=clock, start_ns=start_ns, compute_ns=compute_ns
        )

    def _add_netem(self, at: Address, server: Address, seed: int) -> None:
        """Add a network without a saboteur."""
        scenario = msgspec.structs.replace(self.scenario, seed=seed)
        self.world.add(at[0], Proxy(scenario, server=server, flows=FLOWS))

    # -- lives -------------------------------------------------------------------------------

    def _boot_id(self) -> int:
        return int(self._chance.integers(2**63)) | 2**62

    def _new_server(self, _: int) -> Steady:
        wrong = make_keys(self.trial.seed + 1, len(self._keyring))
        keyring = wrong if self._wrong_keys else self._keyring
        self._server, self._gate = self._made_server(keyring)
        return Steady(self._server)

    def _new_standby(self, _: int) -> Steady:
        return Steady(self._made_server(self._keyring)[0])

    def _made_server(self, keyring: Keyring) -> tuple[Server, Gatekeeper]:
        self._servers += 1
        entropy = self._chance.bytes
        gate = server_secure.SecureGate(keyring, entropy=entropy)
        watched = Gatekeeper(gate, self._servers, self._up, self._down)
        server = Server(
            self.scenario,
            boot_id=self._boot_id(),
            entropy=entropy,
            gate=watched,
            capacity=len(self._keyring),
        )
        return server, watched

    def _new_netem(self, number: int) -> Steady:
        scenario = msgspec.structs.replace(self.scenario, seed=self.trial.seed + number)
        self._netem = Proxy(scenario, server=SERVER, flows=FLOWS)
        return Steady(self._netem)

    def _new_client(self, name: str, vehicle: int, plant: FirstOrderPlant, earlier: int) -> Steady:
        """Next run of a client; its simulated vehicle persists through all of them."""
        key, world = self._keyring.of(vehicle), self.world
        if before := self._lives.get(name):
            self._count(before)
        links = [
            client_secure.SecureLink(key, entropy=self._chance.bytes)
            for _ in range(1 + self.trial.standby)
        ]
        life = WatchedLife(
            links,
            self.scenario,
            vehicle=vehicle,
            number=earlier + 1,
            up=self._up,
            down=self._down,
            clock=lambda: world.now_ns,
            overdue=self._overdue,
            rekey_ns=self._rekey_ns,
            drifted_m=before.drifted_m if before else 0.0,
        )
        sensor = Sensor(self.scenario, stream(self.trial.seed, "sensor", vehicle, earlier + 1))
        client = Client(
            self.scenario,
            SimulatedVehicle(self.scenario.dt_ns, plant, sensor),
            server=Several(
                (SABOTEUR, SECOND_PATH) if self.trial.two_paths else (SABOTEUR,),
                life.links[0],
                standby=[STANDBY_PATH] if self.trial.standby else [],
                standby_link=life.links[-1],
            ),
            vehicle=vehicle,
            boot_id=self._boot_id(),
            recorder=life,
        )
        life.disturbance = lambda: tuple(client.disturbance.tolist())
        self._lives[name] = life
        return Steady(client)

    def _renew(self, name: str) -> None:
        self.counts[f"lives of {name.partition(' ')[0]}"] += 1
        self._processes[name].start(self.world)

    def set_clock(self, name: str, step_ns: int) -> None:
        self.world.set_clock(name, step_ns=step_ns)
        if life := self._lives.get(name):
            life.clock_set = True

    def _count(self, life: WatchedLife) -> None:
        self.counts["steps"] += life.steps
        self.counts["steps by inputs"] += life.planned
        self.counts["steps along trajectories"] += life.followed
        self.counts["steps slept through"] += life.missed
        self.counts["landed"] += life.mode is Mode.LAND

    # -- faults ------------------------------------------------------------------------------

    def _overdue(self) -> bool:
        """Whether faults have been over for so long that every vehicle must fly."""
        return not self._under_way and self.world.now_ns - self._calm_ns > self._recovery_ns

    def _plan(self, fault: ScheduledFault) -> None:
        world = self.world

        harm = int(fault.kind not in HARMLESS)

        def begin() -> None:
            self._under_way += harm
            self.counts[f"faults: {fault.kind}"] += 1
            act(self, fault, begins=True)
            world.at(max(world.now_ns, fault.end_ns), end)

        def end() -> None:
            act(self, fault, begins=False)
            world.at(fault.over_ns, over)

        def over() -> None:
            self._under_way -= harm
            if harm:
                self._calm_ns = world.now_ns

        world.at(fault.start_ns, begin)

    def hosts(self, fault: ScheduledFault) -> list[str]:
        if fault.where == SERVER[0] and self.trial.standby and fault.start_ns % 2:
            return [STANDBY[0]]
        return [*self._lives] if fault.where == "client" else [fault.where]

    def set_down(self, name: str, *, down: bool) -> None:
        """Take a host down, or start its process again once no fault keeps it down."""
        self._down_hosts[name] += 1 if down else -1
        if down:
            self._processes[name].kill(self.world)
        elif not self._down_hosts[name]:
            self._renew(name)

    def set_keys(self, *, right: bool) -> None:
        """Let the server's next runs use the vehicles' keys, or wrong ones."""
        self._wrong_keys += -1 if right else 1

    def set_solver(self, share: float, *, failing: bool) -> None:
        """Let a share of the solves of the server's present run fail, or none."""
        scheme = self._server.controller.scheme
        if not isinstance(scheme, HorizonScheme):  # trajectories need no solver
            return
        planner = scheme.planner
        solvers = [getattr(solver, "inner", solver) for solver in planner.solvers]
        if failing:
            rng = self._chance
            solvers = [Failing(solver, share, rng) for solver in solvers]
        planner.solvers = solvers

    # -- checks ------------------------------------------------------------------------------

    def _hear(self, time_ns: int, _: str, event: Event) -> None:
        """Check a change of mode; restart a vehicle that has landed."""
        if not isinstance(event, ModeChanged):
            return
        name = f"client {event.vehicle}"
        life = self._lives[name]
        life.check_change(event.before, event.after)
        self.counts[f"{event.after}: {event.reason}"] += event.before != event.after
        due_ns = time_ns + LANDED_NS
        recovery_after_ns = recovery_ns(self.scenario, restarts=True) + self._step_ns

        def renew() -> None:
            if self._lives[name] is life and not self._down_hosts[name]:
                self._renew(name)
                self._calm_ns, self._recovery_ns = due_ns, recovery_after_ns

        landing = event.after == str(Mode.LAND) and event.before != event.after
        if landing and due_ns + recovery_after_ns < self.end_ns:
            self.world.at(due_ns, renew)

    def _check_end(self) -> None:
        """Check that every vehicle flies, and that no container exceeds its bound."""
        for life in self._lives.values():
            silent_ns = self.end_ns - life.row_ns
            if life.row_ns < 0 or silent_ns > 3 * self.scenario.dt_ns:
                raise Violation("recovers", f"vehicle {life.vehicle} does not fly at the end")
            if life.mode not in FLYING and life.mode is not Mode.LAND:
                raise Violation("recovers", f"vehicle {life.vehicle} in {life.mode} at the end")
        check_bounds("server", self._server)
        check_bounds("gate", self._gate.gate)
        check_bounds("netem", self._netem)


def is_small(step_s: float) -> bool:
    """Whether a forward step of a clock [s] is so small that it may be taken for a freeze."""
    return 0 < seconds_to_ns(step_s) <= JUMP_NS


def recovery_ns(scenario: Scenario, *, restarts: bool) -> int:
    """Time within which a vehicle must fly again after the last fault [ns].

    The sum of the stages: the client notices the end of the session; HELLO, cookie and session are
    exchanged; the link is good for the required time; a horizon planned after that arrives. With
    `restarts` the server may have to wait for the end of the session of the client's earlier run.
    """
    (paper,) = IMPAIRMENTS.calls(scenario.network.uplink)
    least_s, slot_s, *_ = map(float, paper.values)
    trip_ns = 2 * seconds_to_ns(least_s + 8 * slot_s)
    noticed_ns = WELCOME_NS if restarts else seconds_to_ns(scenario.link.timeout_s)
    return noticed_ns + 2 * AGAIN_NS + GOOD_NS + 4 * trip_ns + 4 * scenario.dt_ns


def act(  # noqa: PLR0912 - a branch for each kind of fault
    torture: Torture, fault: ScheduledFault, *, begins: bool
) -> None:
    world, dt_ns = torture.world, torture.scenario.dt_ns
    names = torture.hosts(fault)
    match fault.kind:
        case FaultKind.STEP if begins:
            for name in names:
                torture.set_clock(name, seconds_to_ns(fault.amount))
        case FaultKind.STEP:
            pass
        case FaultKind.SKEW:
            for name in names:
                world.set_clock(name, drift_ppb=round(1000 * fault.amount) if begins else 0)
        case FaultKind.RESTART:
            for name in names:
                torture.set_down(name, down=begins)
        case FaultKind.KEYS:
            torture.set_keys(right=not begins)
            torture.set_down(SERVER[0], down=True)
            torture.set_down(SERVER[0], down=False)
        case FaultKind.FREEZE:
            for name in names:
                (world.freeze if begins else world.thaw)(name)
        case FaultKind.SOLVER:
            torture.set_solver(fault.amount, failing=begins)
        case FaultKind.OVERLOAD:
            world.set_compute(SERVER[0], round(fault.amount * dt_ns) if begins else COMPUTE_NS)
        case FaultKind.PORT if begins:
            torture.saboteur.change_ports()
        case FaultKind.PORT:
            pass
        case FaultKind.CROWD if begins:
            torture.observer.begin(fault, world.now_ns)
            world.rearm(OBSERVER)
        case FaultKind.CROWD:
            torture.observer.end(fault)
        case _ if begins:
            torture.saboteur.begin(fault, world.now_ns)
            world.rearm(SABOTEUR[0])
        case _:
            torture.saboteur.end(fault)


def fly(trial: Trial, stopped: Callable[[], bool] = lambda: False) -> TrialOutcome:
    return Torture(trial).run(stopped)


def shrunk(outcome: TrialOutcome) -> TrialOutcome:
    """Result of the shortest schedule of a failed trial that violates the same invariant."""

    def fails(faults: tuple[ScheduledFault, ...]) -> bool:
        return fly(replace(outcome.trial, faults=faults)).invariant == outcome.invariant

    faults, until_ns = outcome.trial.faults, seconds_to_ns(outcome.flown_s)
    begun = tuple(fault for fault in faults if fault.start_ns <= until_ns)
    faults = shrink(begun if fails(begun) else faults, fails)
    return fly(replace(outcome.trial, faults=faults))
