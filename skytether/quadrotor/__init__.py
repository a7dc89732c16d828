"""The quadrotor: a rigid body with four rotors, and the loops that make it fly a velocity.

    velocity → acceleration → attitude → rates → rotors → forces

No module in here reads a clock or throws unseeded dice: a quadrotor is advanced by its caller.
"""

from skytether.shared.base import extras

extras.need("server")
