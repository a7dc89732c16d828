"""Terms of a flight: the values on which server and client must agree before it.

Everything that both ends use for prediction is a term, and both build it from the terms alone, so
that no other value can be used. Keys of a scenario that are not terms belong to one end, which may
set them freely; `shared/scenario/schema.py` names the owner of each.
"""

from typing import NamedTuple

import msgspec

from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.law.model import Model, discretise


class Difference(msgspec.Struct, frozen=True):
    key: str
    here: str
    there: str


FLOWN_AS = ("committed", "predictive", "trajectory", "none")
"""Ways in which a vehicle flies the server's messages, by the names of the built-in schemes."""
INDEXED = ("committed", "predictive")
"""Ways in which the vehicle reads a horizon at the present stage, not always at its first."""
COMMITTING = ("committed",)
"""Ways in which horizons begin with committed inputs."""
ALONG_SPLINES = ("trajectory",)
"""Ways in which splines of the desired trajectory are sent instead of inputs."""


class Terms(NamedTuple):
    """Values on which both ends must agree before a flight: plain numbers and texts."""

    dt_ns: int
    horizon: int
    axes: int
    tau_s: tuple[float, ...]
    """Time constant of the model, eq. (2)-(3), of each axis [s]."""
    gain: tuple[float, ...]
    """Gain of the model of each axis: steady velocity over desired velocity."""
    dead_time_s: tuple[float, ...]
    """Dead time of the model of each axis [s]."""
    u_max: tuple[float, ...]
    """Bound of the input, eq. (6), on each axis [m/s]."""
    scheme: str
    """How the vehicle flies the messages of the server, one of FLOWN_AS."""
    feedback: bool
    exhausted: str
    """Behaviour after a horizon's last input: "hold" or "brake"."""
    brake_mps2: float
    """Deceleration with which braking takes the desired velocity to zero [m/s²]."""
    age_max_s: float
    join_s: float
    """Time after a trajectory's first knot up to which it is accepted [s]; 0: at any time."""
    land_after_s: float
    """Time of hovering with a silent server after which the vehicle lands [s]; 0: never."""
    shape: str
    radius_m: float
    """Half the width of circle, figure-eight and square [m]."""
    period_s: float
    """Time for one round of circle, figure-eight or square [s]."""
    altitude_m: float
    """Altitude of the shape in 3-D [m]."""
    points: str
    """Digest of the waypoints."""
    speed_mps: float
    loop: bool
    table: str
    """Digest of the content of the trajectory's CSV file."""
    separation_m: float = 0.5
    """Distance that vehicles of a mission keep [m]. Like the next two it is for the servers: two
    servers of one vehicle plan with the same."""
    height_m: float = 0.0
    """Distance that they keep above one another [m]; 0: `separation_m`."""
    tube_m: float = 0.15
    """Largest distance of a vehicle from its motion [m]."""

    @property
    def dt_s(self) -> float:
        return self.dt_ns / SECOND_NS

    @property
    def model(self) -> Model:
        return discretise(self.tau_s, self.dt_s, self.gain)

    @property
    def splines(self) -> bool:
        return self.scheme in ALONG_SPLINES

    @property
    def planned(self) -> int:
        """Number of a horizon's inputs after the committed ones: H, or 1 for a trajectory."""
        return 1 if self.splines else self.horizon

    @property
    def reach(self) -> int:
        """Steps after the committed ones for which a horizon can be used: H, or the age bound."""
        return self.age_max if self.splines else self.horizon

    @property
    def age_max(self) -> int:
        return seconds_to_ns(self.age_max_s) // self.dt_ns

    @property
    def join(self) -> int:
        return seconds_to_ns(self.join_s) // self.dt_ns

    @property
    def land_after(self) -> int:
        return seconds_to_ns(self.land_after_s) // self.dt_ns

    @property
    def brake(self) -> float:
        """Decrease of speed per step when braking [m/s]; 0 if the last input is held."""
        return self.brake_mps2 * self.dt_s if self.exhausted == "brake" else 0.0
