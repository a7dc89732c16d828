"""Quadrotor: rigid body with four rotors, and control loops that track a velocity.

    velocity → acceleration → attitude → rates → rotors → forces

No module of this package reads a clock or draws unseeded random numbers; the caller advances time.
It imports `shared.base` and `shared.law`; `client.simulated.quadrotor` flies it for `vehicle.kind =
"quadrotor"`, and so does the simulated autopilot. Its kernels need the extra `server`.
"""

from skytether.shared.base import extras

extras.need("server")
