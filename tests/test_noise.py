"""Noise models of factors: what they weigh, and that sharing them mixes nothing up."""

import gtsam
import numpy as np
import pytest

from graphloc.config import KernelConfig
from graphloc.factors._noise import noise_model, with_floors
from graphloc.frames import Array
from graphloc.graph import Decision

DIAGONAL = np.diag([0.04, 0.25, 1.0])
FULL = np.array([[0.5, 0.2, 0.0], [0.2, 0.3, 0.1], [0.0, 0.1, 0.8]])
ERROR = np.array([0.3, -0.4, 0.7])


@pytest.mark.parametrize("cov", [DIAGONAL, FULL], ids=["diagonal", "full"])
@pytest.mark.parametrize("weight", [1.0, 0.25])
def test_an_error_costs_its_mahalanobis_distance_times_the_weight(cov: Array, weight: float) -> None:
    model = noise_model(cov, Decision(weight=weight))
    assert model.squaredMahalanobisDistance(ERROR) == pytest.approx(weight * ERROR @ np.linalg.inv(cov) @ ERROR)
    assert isinstance(model, gtsam.noiseModel.Diagonal) == (cov is DIAGONAL)


def test_a_kernel_bends_at_its_scale_in_sigmas_of_the_weighted_noise() -> None:
    """Huber beyond c: c |u| - c^2 / 2."""
    model = noise_model(DIAGONAL, Decision(weight=0.25, kernel=KernelConfig(kind="huber", scale=1.5)))
    near, far = np.array([0.3, 0.0, 0.0]), np.array([4.0, 0.0, 0.0])  # 0.75 and 10 sigmas, of 0.2 / sqrt(0.25)
    for error, cost in ((near, 0.75**2 / 2.0), (far, 1.5 * 10.0 - 1.5**2 / 2.0)):
        assert model.loss(model.squaredMahalanobisDistance(error)) == pytest.approx(cost)
    plain = noise_model(DIAGONAL, Decision(weight=0.25, kernel=KernelConfig(kind="none")))
    assert not isinstance(plain, gtsam.noiseModel.Robust)


def test_factors_share_a_model_of_the_same_noise_and_no_other() -> None:
    cauchy = KernelConfig(kind="cauchy", scale=2.0)
    one = noise_model(FULL, Decision(weight=0.5, kernel=cauchy))
    assert noise_model(np.asfortranarray(FULL), Decision(weight=0.5, kernel=cauchy.model_copy())) is one
    others = [
        noise_model(FULL, Decision(weight=0.5)),
        noise_model(FULL, Decision(weight=0.25, kernel=cauchy)),
        noise_model(FULL, Decision(weight=0.5, kernel=KernelConfig(kind="cauchy", scale=3.0))),
        noise_model(FULL, Decision(weight=0.5, kernel=KernelConfig(kind="huber", scale=2.0))),
        noise_model(FULL + 1e-12 * np.eye(3), Decision(weight=0.5, kernel=cauchy)),
    ]
    assert len({id(model) for model in (one, *others)}) == 1 + len(others)


def test_a_shared_model_holds_its_own_numbers() -> None:
    cov = DIAGONAL.copy()
    model = noise_model(cov, Decision())
    cov[0, 0] = 9.0
    before = ERROR @ np.linalg.inv(DIAGONAL) @ ERROR
    assert model.squaredMahalanobisDistance(ERROR) == pytest.approx(before)
    assert noise_model(cov, Decision()).squaredMahalanobisDistance(ERROR) < before


def test_floors_lift_variances_alone_and_leave_what_was_given() -> None:
    given = FULL.copy()
    lifted = with_floors(given, np.array([0.6, 0.1, 0.8]))
    np.testing.assert_array_equal(np.diag(lifted), [0.6, 0.3, 0.8])
    np.testing.assert_array_equal(lifted - np.diag(np.diag(lifted)), FULL - np.diag(np.diag(FULL)))
    np.testing.assert_array_equal(given, FULL)
