"""The terms of a flight: what server and client must agree on before it.

Whatever both ends predict with is a term, and both build it from the terms alone, so that what is
left out here cannot be used. The keys of a scenario that are no terms belong to one end, which may
set them as it likes; `FREE` says whose they are. There is no third kind.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from shared.endpoint import SECOND_NS, seconds_to_ns
from shared.events import Difference
from shared.model import Model, discretise


class Terms(NamedTuple):
    """What both ends must agree on before a flight, in plain numbers and texts."""

    dt_ns: int
    """Length of a step [ns]."""
    horizon: int
    """Steps planned ahead, H."""
    axes: int
    """Spatial axes, 2 or 3."""
    tau_s: tuple[float, ...]
    """Time constant of the model (2)-(3) of each axis [s]."""
    u_max: tuple[float, ...]
    """Bound (6) of the input on each axis [m/s]."""
    scheme: str
    """Delay compensation at both ends, as in `control.scheme`."""
    feedback: bool
    """Whether horizons bring feedback."""
    exhausted: str
    """What the vehicle does after a horizon's last input, "hold" or "brake"."""
    brake_mps2: float
    """How fast braking takes the desired velocity to zero [m/s²]."""
    heartbeat_s: float
    """Longest silence of the server [s]."""
    age_max_s: float
    """Largest age of the observation behind an input [s]."""
    shape: str
    """Shape of the desired trajectory."""
    radius_m: float
    """Half the width of circle, figure-eight and square [m]."""
    period_s: float
    """Time for one round of them [s]."""
    altitude_m: float
    """Their height in 3-D [m]."""
    points: str
    """Digest of the waypoints."""
    speed_mps: float
    """Speed between waypoints [m/s]."""
    loop: bool
    """Whether the waypoints are flown round and round."""
    table: str
    """Digest of what stands in the trajectory's CSV file, wherever the file lies."""

    @property
    def dt_s(self) -> float:
        """Length of a step [s]."""
        return self.dt_ns / SECOND_NS

    @property
    def model(self) -> Model:
        """The UAV as both ends know it."""
        return discretise(self.tau_s, self.dt_s)

    @property
    def indexed(self) -> bool:
        """Whether the vehicle reads a horizon by the step it is at, and not always its first."""
        return self.scheme not in ("dead_reckoning", "none")

    @property
    def commits(self) -> bool:
        """Whether horizons begin with committed inputs."""
        return self.scheme == "committed"

    @property
    def reckons(self) -> bool:
        """Whether horizons bring no plan, but the state that the vehicle goes on from."""
        return self.scheme == "dead_reckoning"

    @property
    def planned(self) -> int:
        """Number of a horizon's inputs behind the committed ones: H, or 1 without a plan."""
        return 1 if self.reckons else self.horizon

    @property
    def reach(self) -> int:
        """Steps behind the committed ones for which a horizon is good: H, or the age bound."""
        return self.age_max if self.reckons else self.horizon

    @property
    def age_max(self) -> int:
        """Largest age of the observation behind an input [steps]."""
        return seconds_to_ns(self.age_max_s) // self.dt_ns

    @property
    def brake(self) -> float:
        """Speed that braking takes away in a step [m/s]; 0 where the last input is held."""
        return self.brake_mps2 * self.dt_s if self.exhausted == "brake" else 0.0

    def differences(self, other: "Terms") -> tuple[Difference, ...]:
        """Every term on which another end's terms differ from these."""
        return tuple(
            Difference(KEYS[name], _text(name, here), _text(name, there))
            for name, here, there in zip(self._fields, self, other, strict=True)
            if here != there
        )


KEYS: Mapping[str, str] = MappingProxyType(
    {
        "dt_ns": "control.dt",
        "horizon": "control.horizon",
        "axes": "model.axes",
        "tau_s": "model.tau_s",
        "u_max": "model.u_max",
        "scheme": "control.scheme",
        "feedback": "control.feedback",
        "exhausted": "vehicle.exhausted",
        "brake_mps2": "vehicle.brake_mps2",
        "heartbeat_s": "link.heartbeat_s",
        "age_max_s": "link.age_max_s",
        "shape": "reference.shape",
        "radius_m": "reference.radius_m",
        "period_s": "reference.period_s",
        "altitude_m": "reference.altitude_m",
        "points": "reference.points_m",
        "speed_mps": "reference.speed_mps",
        "loop": "reference.loop",
        "table": "reference.file",
    }
)
"""Key of the scenario that each term comes from."""

_OWNERS = {
    "a word for people": "title",
    "the vehicle's: how long it flies": "duration",
    "the vehicle's: whether it flies plans": "armed",
    "the vehicle's: what its summary leaves out": "settle",
    "of chance, at each end its own": "seed",
    "the server's: where it plans from": "control.delay_bound",
    "the server's: how it estimates": "control.observer_s",
    "the server's: when it sends": """
        control.trigger control.period control.epsilon control.decay_rate control.cost_gap
        control.deviation_m control.tolerance_m
    """,
    "the server's: what only it knows": """
        reference.preview reference.agility reference.turn_every_s reference.velocity_mps
    """,
    "the server's: how it plans": """
        model.dead_time_s control.solver control.state_weight control.terminal_weight
        control.input_weight control.change_weight control.input_reference
    """,
    "the vehicle's: what it truly is": """
        vehicle.tau_s vehicle.gain vehicle.dead_time_s
    """,
    "the vehicle's: what it lets pass, and when it lands": """
        vehicle.slew_mps2 vehicle.land_after_s
    """,
    "the vehicle's: where it starts": "vehicle.start_m",
    "the vehicle's: what it measures": """
        sensor.filter sensor.position_noise_m sensor.velocity_noise_mps sensor.position_bias_m
        sensor.velocity_bias_mps sensor.position_every_s sensor.velocity_every_s sensor.delay_s
        sensor.process_noise
    """,
    "the vehicle's: the air it flies in": """
        vehicle.wind vehicle.steady_wind_mps vehicle.gust_mps2 vehicle.gust_every_s
        vehicle.gust_s
    """,
    "netem's": """
        network.uplink.delay network.uplink.minimum_s network.uplink.slot_s
        network.uplink.slots_mean network.uplink.loss network.uplink.burst_s network.downlink.delay
        network.downlink.minimum_s network.downlink.slot_s network.downlink.slots_mean
        network.downlink.loss network.downlink.burst_s network.mtu
    """,
    "each end's own: when it takes the other for silent": "link.timeout_s",
    "the vehicle's: when it gives up": "link.connect_s",
    "of virtual time": """
        simulation.compute_s simulation.clock_offset_s simulation.clock_drift_ppm
    """,
}
FREE: Mapping[str, str] = MappingProxyType(
    {key: whose for whose, keys in _OWNERS.items() for key in keys.split()}
)
"""Keys of the scenario that may differ, and whose they are."""


def keys_of(whose: str) -> frozenset[str]:
    """Keys of the scenario that may differ, of those with these words in `FREE`."""
    return frozenset(_OWNERS[whose].split())


def _text(name: str, value: object) -> str:
    """A term as the scenario writes it."""
    if name == "dt_ns" and isinstance(value, int):
        return f"{value / SECOND_NS:g}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(str, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)
