"""`reference.noise_m`: the server estimates a target from noisy positions."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from helpers import packaged
from skytether.shared.base.chance import stream
from skytether.shared.scenario import reading
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.targets import Measured
from skytether.sim.flight import fly

DT_S, STEPS = 0.05, 1200


def constant(velocity: float) -> Reference:
    def sample(t: np.ndarray) -> np.ndarray:
        states = np.zeros((*np.shape(t), 2, 2))
        states[..., 0, 0], states[..., 0, 1] = velocity * t, velocity
        return states

    return sample


def measured(target: Reference, noise_m: float = 0.2, agility: float = 0.3) -> Measured:
    rng = stream(1, "noise")
    return Measured(target, rng, dt_s=DT_S, noise_m=noise_m, agility=agility)


def test_filter_has_a_smaller_error_than_the_measurement() -> None:
    scenario = reading.load("target")
    target, times = scenario.make_reference(), np.arange(STEPS) * DT_S
    error_m = (measured(target)(times) - target(times))[200:, :, 0]
    assert 0.05 < np.sqrt((error_m**2).mean()) < 0.12


def test_estimate_at_a_step_depends_on_no_later_measurement() -> None:
    ahead, behind = measured(constant(1.0)), measured(constant(1.0))
    ahead(np.array([50.0]))
    early = np.arange(100) * DT_S
    assert_array_equal(ahead(early), behind(early))
    turned = measured(lambda t: constant(1.0)(np.minimum(t, 5.0)))
    assert_array_equal(ahead(early), turned(early))


def test_between_steps_the_estimate_moves_at_its_velocity() -> None:
    target = measured(constant(1.0))
    at, later = target(np.array([3.0, 3.0 + 0.4 * DT_S]))
    assert later[:, 1] == pytest.approx(at[:, 1])
    assert later[:, 0] == pytest.approx(at[:, 0] + 0.4 * DT_S * at[:, 1])


def test_target_without_agility_is_followed_along_a_straight_line() -> None:
    times = np.arange(STEPS) * DT_S
    states = measured(constant(0.0), agility=1e-6)(times)
    assert np.abs(states[..., 0]).max() < 1e-3


def test_each_vehicle_has_its_own_noise() -> None:
    scenario = packaged("target", reference={"noise_m": 0.2})
    times = np.arange(100) * DT_S
    one, two = (
        scenario.measured_reference(n)(times) - scenario.make_reference(n)(times) for n in (1, 2)
    )
    assert not np.allclose(one, two)


def test_noise_costs_accuracy_and_is_flown() -> None:
    scenario = packaged("target", duration=20.0, settle=5.0)
    noisy = packaged("target", duration=20.0, settle=5.0, reference={"noise_m": 0.5})
    errors = []
    for each in (scenario, noisy):
        client = fly(each).client
        truth = each.make_reference()(client["step"] * DT_S)[..., 0]
        late = client["step"] > 200
        errors.append(np.sqrt(((client["state"][..., 0] - truth)[late] ** 2).mean()))
    assert errors[1] > 1.3 * errors[0]
