"""Quadrotor: rigid body with four rotors, and control loops that track a velocity.

    velocity → acceleration → attitude → rates → rotors → forces

No module of this package reads a clock or draws unseeded random numbers; the caller advances time.
The package imports `shared.base` and `shared.law`. `client.simulated.quadrotor` and the simulated
autopilot fly the quadrotor. The package's kernels need the extra `server`.
"""

from skytether.shared.base import extras

extras.need("server")
