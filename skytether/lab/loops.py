"""Linear loops of a scenario's axes, timings of its packets, and the loops' responses to pushes.

`lab.linear` propagates the pushes; the numbers that it takes come from the scenario here.
"""

import math

import numpy as np

from skytether.client.filter import Kalman
from skytether.client.navigation import filters, sensing
from skytether.client.simulated.sensor import Sensor
from skytether.lab.linear import NOISE, SCHEMES, WIND, Loop, Past, Timing, propagate
from skytether.server.control.memory import HOVERS
from skytether.server.control.mpc import LATER, MPC, make_mpc, pose
from skytether.server.control.observer import decay_of
from skytether.shared.base.chance import stream
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.law.dead_time import dead_time
from skytether.shared.law.model import Array, Indices, Model, discretise, white_acceleration
from skytether.shared.scenario import policies
from skytether.shared.scenario.gain import feedback_gain, regulator
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.wire.protocol import committed_max


def make_loops(scenario: Scenario, steps: int) -> list[Loop]:
    """Loops on each axis of a scenario, for flights of so many steps."""
    terms, control = scenario.terms(), scenario.control
    dt, tau, gain = control.dt, scenario.true_tau_s, scenario.true_gain
    true_axes = zip(tau, scenario.true_dead_time_s, gain, strict=True)
    late = [dead_time(tau_s, late_s, terms.dt_ns, g) for tau_s, late_s, g in true_axes]
    known_late = terms.dead_times
    nowhere = discretise([1.0], 0.0).axes()[0]
    plans, before = np.zeros((terms.axes, 1, 3)), np.zeros((terms.axes, 0, 0))
    if not terms.splines:
        plans, before = _plans(terms.model, make_mpc(terms, control))
    # K is sent as float32 with inputs; along a trajectory the vehicle computes its own.
    sent = feedback_gain(scenario).astype("f4").astype("f8")
    back = regulator(scenario) if terms.splines else sent
    delay, corrections = _corrections(scenario, steps)
    pushes = white_acceleration(tau, dt)
    return [
        Loop(
            model=model,
            true=axis,
            late=np.array(late[i].late),
            dead_steps=late[i].steps,
            known_late=np.array(known_late[i].late),
            known_dead_steps=known_late[i].steps,
            rest=known_late[i].rest or nowhere,
            push=pushes[i],
            sensor_delay=delay,
            corrections=corrections[i],
            predicts=scenario.sensor.filter == "kalman",
            scheme=SCHEMES.index(terms.scheme),
            plan=plans[i],
            before=before[i] if control.change_weight > 0.0 else np.zeros((0, 0)),
            feeds_back=terms.feedback,
            back=back[i],
            decay=decay_of(terms, control) if terms.commits or terms.indexed else 1.0,
            holds=terms.brake == 0.0,
            age_max=terms.age_max,
            dt_ns=terms.dt_ns,
        )
        for i, (model, axis) in enumerate(
            zip(terms.model.axes(), discretise(tau, dt, gain).axes(), strict=True)
        )
    ]


def _plans(model: Model, mpc: MPC) -> tuple[Array, Array]:
    """Unconstrained plans of eq. (9), U = -𝓗⁻¹ g, as gains from the quantities in g.

    Returns:
        for position and velocity where planning starts and ŵ, shape (axes, H, 3), and for the
        horizon before, shape (axes, H, H).
    """
    H, axes = len(mpc.weights.states), len(model.b0)
    hessian = pose(model, mpc, LATER).hessian
    free = np.zeros((axes, 3, H, 2))
    """States 1 … H without any input, for unit initial values."""
    forced = np.zeros((axes, H, H, 2))
    """States 1 … H for a unit input at each stage."""
    for j, start in enumerate(([1.0, 0.0], [0.0, 1.0], [0.0, 0.0])):
        x = np.tile(start, (axes, 1))
        for i in range(H):
            x = free[:, j, i] = model.step(x, np.full(axes, float(j == 2)))
    for j in range(H):
        x = np.zeros((axes, 2))
        for i in range(j, H):
            x = forced[:, j, i] = model.step(x, np.full(axes, float(i == j)))
    gradient = np.einsum("auip,ip,ajip->auj", forced, mpc.weights.states, free)
    gradient[:, :, 2] += mpc.weights.input
    changes = np.tile(np.diag(mpc.weights.changes[LATER]), (axes, 1, 1))
    return -np.linalg.solve(hessian, gradient), np.linalg.solve(hessian, changes)


def _corrections(scenario: Scenario, steps: int) -> tuple[int, Array]:
    """Delay of the sensor [steps], and `Loop.corrections` of each axis."""
    sensor, axes = Sensor(scenario, stream(scenario.seed, "sensor")), scenario.model.axes
    if sensing(scenario).exact and not filters(scenario):
        return 0, np.zeros((axes, 0, 2, 3))
    found, nothing = np.zeros((axes, steps, 2, 3)), [(0.0, 0.0)] * axes
    kalman = Kalman(scenario, sensor.delay) if filters(scenario) else None
    for step in range(steps):
        measured = sensor.measure(nothing)
        if kalman is None:  # each measurement is reported unfiltered
            for which, values in enumerate(measured[1:]):
                found[:, step, which, which] = values is not None
            continue
        if step == 0:
            kalman.begin(measured)
            continue
        kalman.advance([0.0] * axes)
        kalman.take(measured)
        for which, gains in enumerate(kalman.gains):
            if gains:
                found[:, step, which] = gains
    return sensor.delay, found


def timing_of(flight: Record) -> Timing:
    """Timing of a flight of one vehicle, from its record."""
    client, server = flight.client, flight.server
    assert (np.diff(client["step"]) == 1).all()
    return Timing(
        in_force=client["in_force"].copy(),
        step=server["step"].copy(),
        ahead=server["ahead"].copy(),
        observed=server["observed_step"].copy(),
        event=server["event"].copy(),
    )


def no_packets(steps: int) -> Timing:
    """Timing of a flight without packets."""
    none = np.zeros(0, dtype=np.int64)
    return Timing(np.full(steps, HOVERS), none, none, none, none.astype(np.bool_))


def _periods(scenario: Scenario) -> list[int]:
    """Periods in a loop [steps]; pushes must cover all phases of them."""
    control, sensor = scenario.control, scenario.sensor
    periods = [
        int(each.values[0]) if each.values else control.period
        for each in policies.policies(policies.parse(control.trigger))
        if each.name == "periodic"
    ]
    measured = (sensor.position_every_s, sensor.velocity_every_s)
    times_s = [each for each in measured if isinstance(each, float) and each > 0.0]
    return periods + [-(-seconds_to_ns(each) // scenario.dt_ns) for each in times_s]


def respond(
    scenario: Scenario, loop: Loop, timing: Timing, begin: int, window: int, width: int
) -> tuple[Array, Indices]:
    """Mean squares after pushes, along a flight's timing.

    Args:
        begin: step of the first push.
        window: number of steps simulated after each push.
        width: number of pushes of each source simulated at once.

    Returns:
        p² and u² of each source 0 … window - 1 steps after a push of strength 1, summed over the
        pushes, shape (2, sources, window), and the number of pushes, shape (window,).
    """
    terms = scenario.terms()
    H, most = terms.planned, committed_max(terms)
    sources = WIND + (NOISE if len(loop.corrections) else 0)
    every = -(-window // width)
    while math.gcd(every, math.prod(_periods(scenario))) > 1:
        every += 1
    columns = sources * width
    steps, observed = timing.step, timing.observed
    last = np.concatenate([observed[:1], observed[:-1]])
    known = observed - last <= terms.age_max
    longest = int(max((steps + timing.ahead - observed).max(initial=0), terms.age_max)) + 2
    dead_steps = max(loop.dead_steps, loop.known_dead_steps)
    reach = int((steps - last)[known].max(initial=1)) + dead_steps + loop.sensor_delay + 8
    sent = steps[timing.event]
    needed = [
        np.searchsorted(sent, np.arange(len(timing.in_force)))
        - np.searchsorted(sent, timing.in_force),
        np.searchsorted(sent, steps) - np.searchsorted(sent, timing.in_force[last]),
    ]
    room = int(max(each.max(initial=0) for each in needed)) + 3
    past = Past(
        true=np.zeros((reach, 2, columns)),
        filtered=np.zeros((3, columns)),
        reported=np.zeros((reach, 2, columns)),
        flown=np.zeros((reach, columns)),
        first=np.zeros((reach, columns)),
        made=np.full(room, -1),
        due=np.full(room, -1),
        length=np.ones(room, dtype=np.int64),
        inputs=np.zeros((room, most + H, columns)),
        origins=np.zeros((room, 3, columns)),
        plan=np.zeros((H, columns)),
        scratch=np.zeros((max(H, 3), columns)),
        disturbance=np.zeros(columns),
        led=np.zeros((2, columns)),
        commands=np.zeros((longest, columns)),
        track=np.zeros((longest + 1, 2, columns)),
        marks=np.array([0, -1, 0, -1, 0]),
    )
    squares: Array = np.zeros((2, sources, window))
    counts = np.zeros(window, dtype=np.int64)
    propagate(loop, timing, past, begin, every, squares, counts)
    return squares, counts
