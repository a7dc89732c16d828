"""Frames: physical parameters of quadrotors, with the source of each number.

Rotor k turns with the speed ω_k [rad/s]; its thrust along the body's axis is k_T ω_k², its torque
k_M ω_k². The drag of each rotor is ω_k diag(k_d, k_d, k_z) times its own airspeed; the drag of the
body is c |v| v. This is the model of rotorpy (Folk, Paulos, Kumar, "RotorPy: A Python-based
Multirotor Simulator with Aerodynamics for Education and Research", 2023).
"""

from typing import NamedTuple


class Frame(NamedTuple):
    """Quadrotor in X configuration: rotors front right, back left, front left, back right."""

    mass_kg: float
    roll_inertia: float
    """Moment of inertia about the forward axis [kg m²]."""
    pitch_inertia: float
    """Moment of inertia about the right axis [kg m²]."""
    yaw_inertia: float
    """Moment of inertia about the axis of thrust [kg m²]."""
    arm_x_m: float
    """Distance of each rotor from the centre, forward or backward [m]."""
    arm_y_m: float
    """Distance of each rotor from the centre, to the right or left [m]."""
    thrust: float
    """Coefficient k_T: thrust of a rotor, divided by its speed squared [N s²]."""
    torque: float
    """Coefficient k_M: torque of a rotor, divided by its speed squared [N m s²]."""
    rotor_drag: float
    """Coefficient k_d: drag of a rotor in its plane, divided by speed and airspeed [N s²/m]."""
    inflow_drag: float
    """Coefficient k_z: drag of a rotor along its axis, divided by speed and airspeed [N s²/m]."""
    body_drag: float
    """Coefficient c: drag of the body, divided by its airspeed squared [N s²/m²]."""
    rotor_lag_s: float
    rotor_max: float
    """Largest speed of a rotor with a full battery [rad/s]."""
    cells: int
    capacity_ah: float
    resistance_ohm: float
    """Internal resistance of the battery [Ω]."""
    hover_a: float
    """Battery current in hover [A]."""
    attitude_gain: float
    """Gain from attitude error to angular rate [1/s]."""
    rate_gain: float
    """Gain from rate error to angular acceleration [1/s]."""
    rate_damping: float
    """Gain of the angular-acceleration feedback, which compensates the rotors' lag."""

    @property
    def hover(self) -> float:
        """Speed of each rotor in hover [rad/s]."""
        return float((self.mass_kg * GRAVITY / (4.0 * self.thrust)) ** 0.5)


GRAVITY = 9.81
"""Gravitational acceleration [m/s²]."""

CRAZYFLIE = Frame(
    mass_kg=0.03,
    roll_inertia=1.43e-5,
    pitch_inertia=1.43e-5,
    yaw_inertia=2.89e-5,
    arm_x_m=0.0304,
    arm_y_m=0.0304,
    thrust=2.3e-8,
    torque=7.8e-10,
    rotor_drag=1.02506e-6,
    inflow_drag=7.553e-7,
    body_drag=0.0,
    rotor_lag_s=0.072,
    rotor_max=2500.0,
    cells=1,
    capacity_ah=0.25,
    resistance_ohm=0.15,
    hover_a=2.1,
    attitude_gain=6.0,
    rate_gain=72.0,
    rate_damping=3.0,
)
"""Crazyflie 2.0: body, rotors and lag as in rotorpy 3.0 (`crazyflie_params.py`). rotorpy's sources
are Förster, "System Identification of the Crazyflie 2.0 Nano Quadrocopter", ETH Zürich 2015,
measurements by Bitcraze, and for the lag Eschmann et al., "Data-Driven System Identification of
Quadrotors Subject to Motor Delays", 2024. Battery and current: 250 mAh and 7 minutes of flight, as
stated by Bitcraze; the resistance is assumed, typical of a cell of that size."""

KG15 = Frame(
    mass_kg=1.5,
    roll_inertia=0.029125,
    pitch_inertia=0.029125,
    yaw_inertia=0.055225,
    arm_x_m=0.13,
    arm_y_m=0.21,
    thrust=5.84e-6,
    torque=3.504e-7,
    rotor_drag=1.75e-4,
    inflow_drag=0.0,
    body_drag=0.0,
    rotor_lag_s=0.02,
    rotor_max=1100.0,
    cells=3,
    capacity_ah=5.1,
    resistance_ohm=0.02,
    hover_a=18.0,
    attitude_gain=6.5,
    rate_gain=60.0,
    rate_damping=1.0,
)
"""3DR Iris, 1.5 kg: body, rotors and drag as in PX4's model for Gazebo (`models/iris/iris.sdf`).

Means are used where that model has two values: lateral rotor distances of 0.22 m (front) and 0.20 m
(back), lags of 0.0125 s (speeding up) and 0.025 s (slowing down). Battery: the Iris' 5.1 Ah in
three cells, for 16 to 22 minutes; the resistance is assumed, typical of a battery of that size.
"""

SIH = Frame(
    mass_kg=1.0,
    roll_inertia=0.025,
    pitch_inertia=0.025,
    yaw_inertia=0.03,
    arm_x_m=0.2,
    arm_y_m=0.2,
    thrust=5.0e-6,
    torque=1.0e-7,
    rotor_drag=3.57e-4,
    inflow_drag=3.57e-4,
    body_drag=0.0,
    rotor_lag_s=0.05,
    rotor_max=1000.0,
    cells=3,
    capacity_ah=5.1,
    resistance_ohm=0.02,
    hover_a=12.0,
    attitude_gain=6.5,
    rate_gain=60.0,
    rate_damping=3.0,
)
"""Vehicle of PX4's simulation in hardware: `sih_params.c` of PX4 1.17.

PX4's drag of 1 N per m/s is used here as rotor drag in hover. The largest rotor speed, 1000 rad/s,
is as in rotorpy. PX4's simulation has no battery model; the battery here is that of the 1.5 kg
frame.
"""

FRAMES = {"crazyflie": CRAZYFLIE, "1.5kg": KG15, "sih": SIH}
