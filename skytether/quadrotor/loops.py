"""Control loops of a quadrotor, compiled: from a velocity command to rotor speeds.

    velocity      v* follows the target within limits of jerk and acceleration, if there are any;
                  e = v* - v + K ∫(v* - v) dt      a = a* + P e + I ∫e dt + D (a* - v̇)
    attitude      thrust along a - g; attitude error → commanded rates
    rates         rate error → commanded torques
    rotors        rotor forces with that thrust and those torques, from 0 to the largest that the
                  battery's voltage allows

The limits follow ArduPilot's input shaping, with Δ = |target - v*| and p = jerk / acceleration: the
size of a* follows p Δ for Δ up to jerk / p², and √(2 jerk (Δ - jerk / (2 p²))) above, both at most
the acceleration limit. The jerk of a* is limited, too. K, P, I and D are gains.
"""

from typing import NamedTuple

import numpy as np

from skytether.quadrotor.air import Air, blow
from skytether.quadrotor.body import FRONT, RIGHT, STEP_S, TURN, advance, rotated
from skytether.quadrotor.frames import GRAVITY, Frame
from skytether.shared.base.kernel import F1, F2, inline, making_kernel, making_part


class Gains(NamedTuple):
    """Gains of an autopilot's velocity loop."""

    jerk: float
    """Largest horizontal jerk of the shaped velocity [m/s³]; 0 for no shaping."""
    acceleration: float
    """Largest horizontal acceleration of the shaped velocity [m/s²]."""
    jerk_up: float
    """Largest vertical jerk of the shaped velocity [m/s³]."""
    acceleration_up: float
    """Largest vertical acceleration of the shaped velocity [m/s²]."""
    catch_up: float
    """Gain K from the position error ∫(v* - v) dt of the shaped motion to velocity [1/s]."""
    p: float
    """Gain from horizontal velocity error to acceleration [1/s]."""
    i: float
    """Gain from the integral of the horizontal velocity error to acceleration [1/s²]."""
    d: float
    """Gain D of the measured horizontal acceleration; damps the velocity loop."""
    p_up: float
    """Gain from vertical velocity error to acceleration [1/s]."""
    i_up: float
    """Gain from the integral of the vertical velocity error to acceleration [1/s²]."""
    integral_max: float
    """Largest integral term of the commanded acceleration, on each axis [m/s²]."""
    tilt_max: float


ARDUPILOT = Gains(
    jerk=5.0,
    acceleration=2.5,
    jerk_up=5.0,
    acceleration_up=1.0,
    catch_up=1.0,
    p=2.0,
    i=1.0,
    d=0.25,
    p_up=5.0,
    i_up=2.5,
    integral_max=10.0,
    tilt_max=0.52,
)
"""Gains of ArduCopter 4.5: defaults of PSC_JERK_XY, WPNAV_ACCEL, PSC_JERK_Z, WPNAV_ACCEL_Z,
PSC_POSXY_P, PSC_VELXY_P, _I, _D and _IMAX, PSC_VELZ_P and _IMAX, and ANGLE_MAX."""

PX4 = Gains(
    jerk=0.0,
    acceleration=0.0,
    jerk_up=0.0,
    acceleration_up=0.0,
    catch_up=0.0,
    p=1.8,
    i=0.4,
    d=0.2,
    p_up=4.0,
    i_up=2.0,
    integral_max=GRAVITY,
    tilt_max=0.785,
)
"""Gains of PX4 1.17: defaults of MPC_XY_VEL_P_ACC, _I_ACC and _D_ACC, MPC_Z_VEL_P_ACC and _I_ACC
and MPC_TILTMAX_AIR. An external velocity set-point is not shaped. PX4 limits the vertical integral
to g, and the horizontal integral by the largest tilt, here 45°: also g."""

CRAZYFLIE = Gains(
    jerk=0.0,
    acceleration=0.0,
    jerk_up=0.0,
    acceleration_up=0.0,
    catch_up=0.0,
    p=4.3,
    i=0.17,
    d=0.0,
    p_up=7.3,
    i_up=4.4,
    integral_max=5.0,
    tilt_max=0.349,
)
"""Gains of the Crazyflie's firmware: `position_controller_pid.c`, converted to accelerations. Gains
P and I: 25° and 1° of tilt per m/s, at most 20°; vertically, 25 000 and 15 000 of 65 535 units of
thrust. The integrals do not reach their limits, here assumed as 5 m/s²."""

AHEAD_MAX_M = 2.0
"""Largest position error ∫(v* - v) dt, on each axis [m]."""
CELL_V = (0.0, 3.3, 3.6, 3.68, 3.75, 3.82, 3.95, 4.2)
CELL_CHARGE = (-0.05, 0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Remaining charge (1 is full) of a lithium polymer cell at the open-circuit voltages CELL_V [V];
typical, not measured. The first entry extends the curve below charge 0.
"""
CELL_FULL_V = 4.2
"""Voltage of a full cell without load [V]."""


class Quad(NamedTuple):
    """State of a quadrotor in flight."""

    x: F1
    """States of the body, see `body.STATES`; shape (17,)."""
    wanted: F1
    """Shaped velocity v* (0 to 2), its acceleration a* (3 to 5), and the position error of the
    shaped motion, ∫(v* - v) dt (6 to 8) [north, east, down]; shape (9,).
    """
    integral: F1
    """Integral terms of the acceleration command [m/s²]; shape (3,)."""
    acceleration: F1
    """Acceleration over the last step [m/s²]; shape (3,)."""
    turning: F1
    """Angular acceleration over the last step [rad/s²]; shape (3,)."""
    battery: F1
    """Remaining charge from 1 to 0, voltage [V] and current [A]; shape (3,)."""


@inline
def clipped(value: float, most: float) -> float:
    return min(max(value, -most), most)


@inline
def pull(error: float, jerk: float, acceleration: float) -> float:
    """Acceleration that removes a velocity error as fast as the jerk limit allows."""
    p = jerk / acceleration
    near = jerk / (p * p)
    if error <= near:
        return p * error
    return np.sqrt(2.0 * jerk * (error - 0.5 * near))


@making_part
def shape(gains: Gains, wanted: F1, target: F1) -> None:
    """Move the shaped velocity one step towards the target, within the limits."""
    if gains.jerk == 0.0:
        for i in range(3):
            wanted[i] = target[i]
            wanted[3 + i] = 0.0
        return
    for first, last, jerk, most in (
        (0, 2, gains.jerk, gains.acceleration),
        (2, 3, gains.jerk_up, gains.acceleration_up),
    ):
        error = change = 0.0
        for i in range(first, last):
            error += (target[i] - wanted[i]) ** 2
        error = np.sqrt(error)
        pulled = min(pull(error, jerk, most), most) / error if error > 0.0 else 0.0
        for i in range(first, last):
            change += (pulled * (target[i] - wanted[i]) - wanted[3 + i]) ** 2
        change = np.sqrt(change)
        share = min(1.0, jerk * STEP_S / change) if change > 0.0 else 1.0
        for i in range(first, last):
            wanted[3 + i] += share * (pulled * (target[i] - wanted[i]) - wanted[3 + i])
            wanted[i] += STEP_S * wanted[3 + i]


@making_part
def accelerate(gains: Gains, quad: Quad, out: F1) -> None:
    """Compute the specific force a - g commanded by the velocity loop [m/s²]; shape (3,)."""
    x, wanted, integral = quad.x, quad.wanted, quad.integral
    for i in range(3):
        p, i_, d = (gains.p, gains.i, gains.d) if i < 2 else (gains.p_up, gains.i_up, 0.0)
        slower = wanted[i] - x[3 + i]
        wanted[6 + i] = clipped(wanted[6 + i] + slower * STEP_S, AHEAD_MAX_M)
        error = slower + gains.catch_up * wanted[6 + i]
        integral[i] = clipped(integral[i] + i_ * error * STEP_S, gains.integral_max)
        lead = wanted[3 + i]
        out[i] = lead + p * error + integral[i] - d * (quad.acceleration[i] - lead)
    # Altitude has priority over horizontal motion, which the largest tilt limits.
    out[2] = clipped(out[2], 0.9 * GRAVITY) - GRAVITY
    aside = np.sqrt(out[0] * out[0] + out[1] * out[1])
    most = np.tan(gains.tilt_max) * -out[2]
    if aside > most:
        out[0] *= most / aside
        out[1] *= most / aside


@making_part
def point(frame: Frame, quad: Quad, force: F1, torque: F1) -> float:
    """Thrust [N] and torques [N m] that align the body with the commanded force, nose north.

    Args:
        force: specific force [m/s²; north, east, down].
        torque: output: torques about the body's axes; shape (3,).
    """
    q, rates = quad.x[6:10], quad.x[10:13]
    unit, column = np.zeros((3, 3)), np.empty((3, 3))
    for i in range(3):
        unit[i, i] = 1.0
        rotated(q, unit[i], column[i])
    size = np.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    down = np.empty(3)
    for i in range(3):
        down[i] = -force[i] / size
    # Right is the cross product down × north; forward is right × down.
    right = np.array([0.0, down[2], -down[1]])
    length = np.sqrt(right[1] * right[1] + right[2] * right[2])
    for i in range(1, 3):
        right[i] /= length
    ahead = np.array(
        [
            right[1] * down[2] - right[2] * down[1],
            right[2] * down[0] - right[0] * down[2],
            right[0] * down[1] - right[1] * down[0],
        ]
    )
    roll = pitch = yaw = thrust = 0.0
    for i in range(3):
        roll += 0.5 * (column[1, i] * down[i] - right[i] * column[2, i])
        pitch += 0.5 * (column[2, i] * ahead[i] - down[i] * column[0, i])
        yaw += 0.5 * (column[0, i] * right[i] - ahead[i] * column[1, i])
        thrust -= force[i] * column[2, i]
    errors = np.array([-roll, -pitch, -yaw])
    inertia = np.array([frame.roll_inertia, frame.pitch_inertia, frame.yaw_inertia])
    for i in range(3):
        rate = frame.attitude_gain * errors[i] * (0.4 if i == 2 else 1.0)
        turning = frame.rate_gain * (rate - rates[i]) - frame.rate_damping * quad.turning[i]
        torque[i] = inertia[i] * turning
    return frame.mass_kg * max(thrust, 0.0)


@making_part
def mix(frame: Frame, thrust: float, torque: F1, rotor_max: float, command: F1) -> None:
    """Rotor speeds that produce a thrust and torques, within the rotors' limits.

    If a rotor would saturate, the thrust of all rotors is lowered: torques have priority over
    thrust, and roll and pitch over yaw.
    """
    most = frame.thrust * rotor_max * rotor_max
    yaw = clipped(0.25 * torque[2] * frame.thrust / frame.torque, 0.15 * most)
    above = below = 0.0
    for k in range(4):
        command[k] = (
            0.25 * thrust
            - 0.25 * RIGHT[k] * torque[0] / frame.arm_y_m
            + 0.25 * FRONT[k] * torque[1] / frame.arm_x_m
            + TURN[k] * yaw
        )
        above, below = max(above, command[k] - most), max(below, -command[k])
    for k in range(4):
        force = min(max(command[k] - above + min(below, 0.25 * thrust), 0.0), most)
        command[k] = np.sqrt(force / frame.thrust)


@making_part
def drain(frame: Frame, x: F1, battery: F1) -> None:
    """Discharge the battery by one step; its voltage sags with the current."""
    hover = np.sqrt(frame.mass_kg * GRAVITY / (4.0 * frame.thrust))
    drawn = 0.0
    for k in range(4):
        drawn += 0.25 * (x[13 + k] / hover) ** 3
    battery[2] = frame.hover_a * drawn
    battery[0] = max(battery[0] - battery[2] * STEP_S / (3600.0 * frame.capacity_ah), -0.05)
    charge, k = battery[0], 1
    while k < len(CELL_CHARGE) - 1 and charge > CELL_CHARGE[k]:
        k += 1
    share = (charge - CELL_CHARGE[k - 1]) / (CELL_CHARGE[k] - CELL_CHARGE[k - 1])
    rest = CELL_V[k - 1] + share * (CELL_V[k] - CELL_V[k - 1])
    battery[1] = max(frame.cells * rest - frame.resistance_ohm * battery[2], 0.0)


@making_part
def stand(quad: Quad, ground: float) -> None:
    """Keep the body above the ground; a body on the ground stands level."""
    x = quad.x
    if x[2] < ground:
        return
    x[2] = ground
    if x[5] >= 0.0:
        x[3:6] = 0.0
        x[6], x[7], x[8], x[9] = 1.0, 0.0, 0.0, 0.0
        x[10:13] = 0.0
        quad.wanted[:2] = 0.0
        quad.wanted[6:] = 0.0
        quad.integral[:] = 0.0


@making_kernel
def fly(
    frame: Frame, gains: Gains, quad: Quad, air: Air, drawn: F2, target: F1, ground: float, on: bool
) -> None:
    """Fly one step per row of `drawn` with a velocity command.

    Args:
        drawn: random numbers of the gusts, one row per step; shape (steps, 3).
        target: commanded velocity [m/s; north, east, down]; shape (3,).
        ground: height of the ground, positive downwards [m].
        on: whether the rotors turn.
    """
    x = quad.x
    force, torque, command, before = np.zeros(3), np.zeros(3), np.zeros(4), np.zeros(13)
    wind = np.zeros(3)
    for k in range(len(drawn)):
        blow(air, drawn[k], -x[2], wind)
        if on:
            shape(gains, quad.wanted, target)
            accelerate(gains, quad, force)
            thrust = point(frame, quad, force, torque)
            rotor_max = frame.rotor_max * quad.battery[1] / (CELL_FULL_V * frame.cells)
            mix(frame, thrust, torque, rotor_max, command)
        before[:] = x[:13]
        advance(frame, x, command, wind)
        drain(frame, x, quad.battery)
        stand(quad, ground)
        for i in range(3):
            quad.acceleration[i] = (x[3 + i] - before[3 + i]) / STEP_S
            quad.turning[i] = (x[10 + i] - before[10 + i]) / STEP_S
