"""Quadrotors in hover and in steps of velocity, as a table and a picture.

`python -m skytether.lab.benchmarks.quadrotor docs/quadrotor.png` draws the picture of
docs/vehicles.md and prints its tables.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from skytether.figures.flights import save
from skytether.lab.benchmarks.harness import TextTable
from skytether.quadrotor.frames import CRAZYFLIE, KG15, SIH, Frame
from skytether.quadrotor.loops import ARDUPILOT, PX4, Gains
from skytether.quadrotor.loops import CRAZYFLIE as FIRMWARE
from skytether.quadrotor.quadrotor import Quadrotor
from skytether.shared.law.model import Array

FLOWN: dict[str, tuple[Frame, Gains]] = {
    "1.5kg, ArduCopter's loops": (KG15, ARDUPILOT),
    "sih, PX4's loops": (SIH, PX4),
    "crazyflie, its firmware's loops": (CRAZYFLIE, FIRMWARE),
}
"""Frames, each with the control loops that fly it."""
SIZES = (0.3, 1.0, 2.0, 4.0)
"""Sizes of the steps [m/s]."""
MEASURED = {0.30: 0.1, 0.60: 0.5, 0.72: 0.63, 1.32: 0.9}
"""Share of a step of 1 m/s that ArduCopter 4.5.6 had reached by time [s], as measured."""
STEP_MS = 10
SECONDS = 3.0
"""Length of a step that is drawn and fitted [s]."""


class StepFit(NamedTuple):
    """First order with dead time, fitted to a step, and its residual."""

    gain: float
    tau_s: float
    dead_s: float
    rms_mps: float
    """Root mean square of the residual [m/s]."""


def step(frame: Frame, gains: Gains, velocity: Array) -> Array:
    """Velocities every STEP_MS after a step from hover; shape (n, 3)."""
    flown = Quadrotor(frame, gains, np.random.default_rng(0), position=np.array([0.0, 0.0, 5.0]))
    flown.advance(np.zeros(3), 2_000_000_000)
    rows = [flown.velocity()]
    for _ in range(round(SECONDS * 1000 / STEP_MS)):
        flown.advance(velocity, STEP_MS * 1_000_000)
        rows.append(flown.velocity())
    return np.array(rows)


def fitted(values: Array, size: float) -> StepFit:
    """First-order model with dead time that fits velocities best."""
    times = np.arange(len(values)) * STEP_MS / 1000.0

    def residual(p: Array) -> Array:
        rest: Array = p[0] * (1.0 - np.exp(-np.maximum(times - p[2], 0.0) / p[1])) - values / size
        return rest

    found = least_squares(residual, [1.0, 0.4, 0.1], bounds=([0.0, 0.01, 0.0], np.inf))
    gain, tau_s, dead_s = found.x.tolist()
    return StepFit(gain, tau_s, dead_s, size * float(np.sqrt(np.mean(found.fun**2))))


def table(axis: int, sizes: tuple[float, ...]) -> TextTable:
    """Fits of steps along an axis."""
    rows = []
    for name, (frame, gains) in FLOWN.items():
        for size in sizes:
            values = step(frame, gains, size * np.eye(3)[axis])[:, axis]
            fit = fitted(values, size)
            over = max(0.0, values.max() / size - 1.0)
            cells = (fit.gain, fit.tau_s, fit.dead_s, fit.rms_mps)
            rows.append(
                [name, f"{size:g}", *(f"{cell:.3f}" for cell in cells), f"{100 * over:.1f}"]
            )
    heading = ["frame", "step [m/s]", "gain", "tau [s]", "dead [s]", "rms [m/s]", "over [%]"]
    return TextTable(heading, rows)


def draw(path: Path) -> None:
    """Draw steps of 1 m/s, and ArduCopter's measured response."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.subplots()
    times = np.arange(round(SECONDS * 1000 / STEP_MS) + 1) * STEP_MS / 1000.0
    for name, (frame, gains) in FLOWN.items():
        axes.plot(times, step(frame, gains, np.array([1.0, 0.0, 0.0]))[:, 0], label=name)
    axes.plot(*zip(*MEASURED.items(), strict=True), "ko", label="ArduCopter 4.5.6, measured")
    axes.axhline(1.0, color="0.7", linewidth=0.8)
    axes.set(xlabel="time [s]", ylabel="velocity [m/s]", xlim=(0.0, SECONDS))
    axes.legend(frameon=False)
    save(figure, path, dpi=110)


def main() -> int:
    """Print the tables, and draw the picture if a file is given."""
    print(table(0, SIZES).markdown(), table(2, (0.5,)).markdown(), sep="\n")
    for path in sys.argv[1:]:
        draw(Path(path))
    return 0


if __name__ == "__main__":
    sys.exit(main())
