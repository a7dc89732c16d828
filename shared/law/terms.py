"""Terms of a flight: the values on which server and client must agree before the flight.

Server and client compute predictions from terms only, so that both predict the same. A key of a
scenario that is not a term belongs to one end, which may set it freely;
`shared/scenario/schema.py` names the owner of each key.
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
"""Modes in which a vehicle flies the server's messages, named after the built-in schemes."""
INDEXED = ("committed", "predictive")
"""Modes that use the input of the present stage, not always the first input."""
COMMITTING = ("committed",)
"""Modes with horizons that begin with committed inputs."""
ALONG_SPLINES = ("trajectory",)
"""Modes in which the server sends splines instead of inputs."""


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
    """Mode in which the vehicle flies the server's messages, one of FLOWN_AS."""
    feedback: bool
    exhausted: str
    """Behaviour after a horizon's last input: "hold" or "brake"."""
    brake_mps2: float
    """Deceleration of the desired velocity when braking [m/s²]."""
    age_max_s: float
    join_s: float
    """Time after its first knot for which a trajectory is still accepted [s]; 0: any time."""
    land_after_s: float
    """Time of hovering without packets of the server until the vehicle lands [s]; 0: never."""
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
    """Smallest distance between vehicles of a mission [m]. A standby server must have the same
    value of this field and of the next two fields."""
    height_m: float = 0.0
    """Smallest vertical distance between vehicles of a mission [m]; 0: `separation_m`."""
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
        """Number of a horizon's inputs after the committed inputs: H, or 1 for a trajectory."""
        return 1 if self.splines else self.horizon

    @property
    def reach(self) -> int:
        """Steps after the committed inputs for which a plan can be used: H, or the age bound."""
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
