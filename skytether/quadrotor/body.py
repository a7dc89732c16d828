"""Equations of motion of the rigid body and its rotors, compiled.

    ṗ = v      v̇ = g + R F / m      q̇ = q ⊗ (0, Ω) / 2
    J Ω̇ = M - Ω × J Ω      ω̇ = (ω* - ω) / τ

p and v are position and velocity, Ω the rates, F and M the rotors' and the air's force and torque
on the body, J its inertia, ω and ω* the rotors' actual and commanded speeds, and τ their lag. In
this package, world vectors are north, east, down, and body vectors forward, right, down. R, the
rotation matrix of the quaternion q, turns body vectors into world vectors.
"""

from typing import NamedTuple

import numpy as np

from skytether.quadrotor.frames import GRAVITY, Frame
from skytether.shared.base.kernel import F1, making_kernel, making_part

STATES = 17
"""Number of states: position (0 to 2), velocity (3 to 5), quaternion (6 to 9, w first), rates (10
to 12) and rotor speeds (13 to 16).
"""
STEP_NS = 2_000_000
"""Time step of the equations of motion and of the control loops [ns]."""
STEP_S = 0.002


class Signs(NamedTuple):
    """Signs of rotors' positions and torques: front right, back left, front left, back right."""

    front: tuple[float, ...] = (1.0, -1.0, 1.0, -1.0)
    """Position of each rotor along the forward axis: 1 in front, -1 behind."""
    right: tuple[float, ...] = (1.0, -1.0, -1.0, 1.0)
    """Position of each rotor along the right axis: 1 right, -1 left."""
    turn: tuple[float, ...] = (1.0, 1.0, -1.0, -1.0)
    """Sign of each rotor's torque on the body: 1 clockwise, seen from above."""


FRONT, RIGHT, TURN = Signs()


@making_part
def rotated(q: F1, body: F1, out: F1) -> None:
    """Rotate a body vector to north, east, down; vectors of shape (3,), q of shape (4,)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    a, b, c = body[0], body[1], body[2]
    out[0] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c
    out[1] = 2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c
    out[2] = 2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c


@making_part
def turned_back(q: F1, world: F1, out: F1) -> None:
    """Rotate a vector from north, east, down to the body's axes."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    a, b, c = world[0], world[1], world[2]
    out[0] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c
    out[1] = 2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c
    out[2] = 2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c


@making_part
def derivative(frame: Frame, x: F1, command: F1, wind: F1, out: F1) -> None:
    """Time derivative of the states, by the module's equations; shape (STATES,).

    Args:
        command: commanded rotor speeds ω* [rad/s]; shape (4,).
        wind: velocity of the air [m/s; north, east, down]; shape (3,).
    """
    q, rates = x[6:10], x[10:13]
    air, force, pushed = np.empty(3), np.zeros(3), np.empty(3)
    for i in range(3):
        pushed[i] = x[3 + i] - wind[i]
    turned_back(q, pushed, air)
    speed = np.sqrt(air[0] * air[0] + air[1] * air[1] + air[2] * air[2])
    for i in range(3):
        force[i] = -frame.body_drag * speed * air[i]
    roll = pitch = yaw = 0.0
    for k in range(4):
        rotor = x[13 + k]
        ahead, aside = FRONT[k] * frame.arm_x_m, RIGHT[k] * frame.arm_y_m
        # Force at each rotor's position: thrust, and drag from its own airspeed v + Ω × r.
        along = -frame.rotor_drag * rotor * (air[0] - rates[2] * aside)
        across = -frame.rotor_drag * rotor * (air[1] + rates[2] * ahead)
        inflow = air[2] + rates[0] * aside - rates[1] * ahead
        down = -frame.thrust * rotor * rotor - frame.inflow_drag * rotor * inflow
        force[0] += along
        force[1] += across
        force[2] += down
        roll += aside * down
        pitch -= ahead * down
        yaw += ahead * across - aside * along + TURN[k] * frame.torque * rotor * rotor
        out[13 + k] = (command[k] - rotor) / frame.rotor_lag_s
    rotated(q, force, pushed)
    for i in range(3):
        out[i] = x[3 + i]
        out[3 + i] = pushed[i] / frame.mass_kg
    out[5] += GRAVITY
    out[6] = 0.5 * (-q[1] * rates[0] - q[2] * rates[1] - q[3] * rates[2])
    out[7] = 0.5 * (q[0] * rates[0] + q[2] * rates[2] - q[3] * rates[1])
    out[8] = 0.5 * (q[0] * rates[1] - q[1] * rates[2] + q[3] * rates[0])
    out[9] = 0.5 * (q[0] * rates[2] + q[1] * rates[1] - q[2] * rates[0])
    jx, jy, jz = frame.roll_inertia, frame.pitch_inertia, frame.yaw_inertia
    out[10] = (roll + (jy - jz) * rates[1] * rates[2]) / jx
    out[11] = (pitch + (jz - jx) * rates[2] * rates[0]) / jy
    out[12] = (yaw + (jx - jy) * rates[0] * rates[1]) / jz


@making_part
def advance(frame: Frame, x: F1, command: F1, wind: F1) -> None:
    """Advance the states by one step of the fourth-order Runge-Kutta method."""
    slopes, between = np.empty((4, STATES)), np.empty(STATES)
    derivative(frame, x, command, wind, slopes[0])
    for stage in range(1, 4):
        length = STEP_S if stage == 3 else 0.5 * STEP_S
        for i in range(STATES):
            between[i] = x[i] + length * slopes[stage - 1, i]
        derivative(frame, between, command, wind, slopes[stage])
    for i in range(STATES):
        mean = slopes[0, i] + 2 * slopes[1, i] + 2 * slopes[2, i] + slopes[3, i]
        x[i] += STEP_S / 6.0 * mean
    norm = np.sqrt(x[6] * x[6] + x[7] * x[7] + x[8] * x[8] + x[9] * x[9])
    for i in range(6, 10):
        x[i] /= norm


@making_kernel
def drive(frame: Frame, x: F1, command: F1, wind: F1, steps: int) -> None:
    """Advance the states by `steps` steps with constant rotor commands, without control loops."""
    for _ in range(steps):
        advance(frame, x, command, wind)
