"""The rule of flight: what a vehicle flies at a step with the horizon it holds, eq. (11).

    u*(k) = u(min(k, k_h + n - 1) | k_h)                    k_h: the step the horizon was made for
                                                            n: the inputs it has
                                                            k - k_h: the stage it is at
With feedback aboard the vehicle is led back to where the horizon leads, x̄:

    u*(k) = u(k | k_h) + K (x̄(k) - x(k)),     x̄(i+1) = A x̄(i) + B (u(i | k_h) + ŵ)

No input is flown for longer than `link.age_max_s` after the observation that it was planned from:
a horizon that reaches further ends there. After its last input it is held for ever, or braked
along. Without compensation all of its inputs until then are its first.

This is the one source of that rule. The client flies by it, number by number; the server's replay
compiles the very same functions into its kernels, and so knows what was flown. Each works on one
spatial axis; `speed` alone belongs to all of them.
"""


def lasting(length: int, made_for: int, observed: int, age_max: int) -> int:
    """Number of a horizon's inputs that are flown; none where it is less than 1.

    Args:
        length: number of inputs that it has.
        made_for: k_h, the step of the first.
        observed: step of the observation that they were planned from.
        age_max: largest age of that observation [steps].
    """
    return min(length, observed + age_max - made_for + 1)


def late_max(horizon: int) -> int:
    """Number of steps after its committed ones at which a horizon may still come into force.

    By then the vehicle has flown other inputs than its plan begins with; a few are made good with
    the next plan, many would make the server's estimate and its plans swing.
    """
    return max(2, horizon // 4)


def entry(stage: int, length: int) -> int:
    """Index of the input that counts at a stage of a horizon with so many inputs."""
    return min(max(stage, 0), length - 1)


def bounded(u: float, bound: float) -> float:
    """An input within the bound of eq. (6) [m/s]."""
    return min(max(u, -bound), bound)


def led_back(gain_p: float, gain_v: float, dp: float, dv: float) -> float:
    """Feedback aboard K (x̄ - x) [m/s].

    Args:
        gain_p, gain_v: K, on position [1/s] and velocity.
        dp, dv: x̄ - x, in position [m] and velocity [m/s].
    """
    return gain_p * dp + gain_v * dv


def flown(
    stage: int, length: int, told: float, back: float, speed: float, brake: float, bound: float
) -> float:
    """The input that is flown at a stage of a horizon [m/s].

    Args:
        stage: where in the horizon the step is; may lie before its first or after its last input.
        length: how many inputs the horizon has.
        told: its input at `entry(stage, length)`, within the bound [m/s].
        back: `led_back`, or 0 without feedback [m/s].
        speed: magnitude of its last input over all axes [m/s].
        brake: speed that braking takes away in a step [m/s]; 0 holds the last input for ever.
        bound: u_max [m/s].
    """
    if 0 <= stage < length:
        return min(max(told + back, -bound), bound)  # `bounded`, for numba sees no further
    if stage < 0 or brake == 0.0:
        return told
    return told * (max(0.0, speed - (stage - length + 1) * brake) / speed) if speed > 0.0 else 0.0
