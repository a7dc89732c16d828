"""Leaps: changes of state that no vehicle can make in the given time.

The vehicle compares its successive measurements with these functions, and the server compares
observations with the same functions, compiled into its kernel.
"""

ACCELERATION_MPS2 = 50.0
NOISE_M, NOISE_MPS = 1.0, 2.0
"""Largest change of a measured position [m] and velocity [m/s] by noise."""


def velocity_leaps(v: float, after_v: float, time: float, noise: float) -> bool:
    """Whether a change of velocity is larger than any vehicle can make.

    Args:
        v, after_v: velocity on one axis before and after [m/s].
        time: time between the two [s].
        noise: change that noise may cause [m/s].
    """
    return abs(after_v - v) > noise + ACCELERATION_MPS2 * time


def displacement(p: float, v: float, after_p: float, after_v: float, time: float) -> float:
    """Distance of a position from its prediction by the mean velocity [m].

    Args:
        p, v: position [m] and velocity [m/s] on one axis before.
        after_p, after_v: position [m] and velocity [m/s] after.
        time: time between the two [s].
    """
    # After prediction by the mean velocity, only the effect of acceleration remains.
    return after_p - p - 0.5 * (v + after_v) * time


def position_leaps(
    p: float, v: float, after_p: float, after_v: float, time: float, noise: float
) -> bool:
    """Whether a change of position is larger than any vehicle can make; for the arguments see
    `displacement`.

    `noise` is the change of position that noise may cause [m].
    """
    return abs(displacement(p, v, after_p, after_v, time)) > most_m(time, noise)


def most_m(time: float, noise: float) -> float:
    """Largest `displacement` that acceleration and noise explain [m]; `time` in s, `noise` in m."""
    return noise + 0.5 * ACCELERATION_MPS2 * time * time
