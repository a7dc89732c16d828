"""Quadrotor: a rigid body with four rotors, and control loops that track a velocity.

    velocity → acceleration → attitude → rates → rotors → forces

No module of this package reads a clock or draws unseeded random numbers; the caller advances time.
"""

from skytether.shared.base import extras

extras.need("server")
