"""Flights inside a fence of vehicles that differ from their models, in wind and with hostile
inputs.

`python tests/fenced_flights.py --count 10000` prints the largest distance beyond the fence.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from helpers import packaged
from skytether.client.fence import Fence
from skytether.client.navigation import Navigation
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.weather import Weather
from skytether.client.vehicle import Measurement
from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array
from skytether.shared.scenario.whole import Scenario

FLIGHT_S = 20.0
BOX_M = 6.0


def scenario(**sections: Any) -> Scenario:
    return packaged("demo", {"duration": 30.0}, sections)


class Gusts(Weather):
    """Wind that reverses at the worst times: towards the nearest bound, or away from it."""

    def __init__(self, flown: Scenario, rng: np.random.Generator, plant_x: Array) -> None:
        super().__init__(flown, rng)
        self._rng, self._wind = rng, flown.fence.wind_mps
        self.x = plant_x
        self._towards = 1.0

    def push(self) -> Array:
        """Disturbance that acts like an input, for each axis [m/s]."""
        if self._rng.random() < 0.05:
            self._towards = self._rng.choice([-1.0, 1.0, 1.0])
        return np.sign(self.x[:, 0]) * self._wind * self._towards / 2**0.5


def random_scenario(rng: np.random.Generator) -> Scenario:
    """Vehicle that differs from its model, in a box or a circle."""
    tau, late, u_max = rng.uniform(0.3, 1.0), rng.uniform(0.0, 0.4), rng.uniform(1.0, 5.0)
    truth = {
        "tau_s": [tau * rng.uniform(0.7, 1.3)],
        "gain": [rng.uniform(0.8, 1.2)],
        "dead_time_s": [max(0.0, late + rng.uniform(-0.1, 0.1))],
        "brake_mps2": rng.uniform(0.5, 3.0),
        "start_m": rng.uniform(-0.5, 0.5, 2).tolist(),
    }
    speed = rng.uniform(0.5, 8.0)
    wind = rng.uniform(0.0, 0.5) * min(2.0, u_max, speed)
    box = {"low_m": [-BOX_M, -BOX_M], "high_m": [BOX_M, BOX_M]}
    bounds = box if rng.random() < 0.5 else {"radius_m": BOX_M}
    return scenario(
        model={"tau_s": [tau], "u_max": [u_max], "gain": [1.0], "dead_time_s": [late]},
        control={"horizon": 110},
        reference={"shape": "hover", "points_m": [[0.0, 0.0]]},
        vehicle=truth,
        fence={**bounds, "wind_mps": wind, "speed_mps": speed},
    )


def furthest_m(seed: int, *, fences: type[Fence] = Fence) -> float:
    """Largest distance beyond the fence that hostile inputs reach [m]; negative inside."""
    flown = random_scenario(np.random.default_rng(seed))
    rng = np.random.default_rng(seed)
    plant = FirstOrderPlant(flown, Weather(flown, stream(1, "wind")))
    plant.weather = Gusts(flown, rng, plant.x)
    known, fence = Navigation(flown), fences(flown)
    u_max, home = flown.u_max.tolist(), plant.x[:, 0].copy()
    u, worst = np.zeros(2), -np.inf
    wanted = rng.uniform(-1.0, 1.0, 2) * flown.u_max
    for step in range(round(FLIGHT_S / flown.control.dt)):
        state = plant.x.T.tolist()
        now_ns = step * flown.dt_ns
        known.advance([Measurement(now_ns, *state)], u, now_ns=now_ns)
        if rng.random() < 0.03:
            far = rng.random() < 0.7
            wanted = (rng.choice([-1, 1], 2) if far else rng.uniform(-1, 1, 2)) * flown.u_max
        u = np.array(fence.limited(wanted.tolist(), known.predicted.tolist(), u_max))
        assert np.all(np.abs(u) <= flown.u_max + 1e-9)
        assert np.hypot(*u) <= flown.fence.speed_mps + 1e-9
        plant.advance(u)
        position = np.array(state[0])
        over = np.hypot(*(position - home)) - BOX_M
        if not flown.fence.radius_m:
            over = np.abs(position).max() - BOX_M
        worst = max(worst, float(over))
    return worst


def main() -> None:
    """Fly the requested number of flights, and print how far the worst left the fence."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.jobs) as pool:
        over = np.array(list(pool.map(furthest_m, range(options.count), chunksize=50)))
    told = f"worst {over.max():.3f} m (seed {over.argmax()}), median {np.median(over):.3f} m"
    print(f"{len(over)} flights, {(over > 0.0).sum()} over the fence: {told}")


if __name__ == "__main__":
    main()
