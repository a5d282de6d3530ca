"""Squares and densities of small residuals against their definitions."""

import numpy as np
import pytest

from graphloc import gauss


@pytest.mark.parametrize("k", [1, 2, 3, 6])
def test_square_and_density_are_those_of_the_definition(k: int) -> None:
    rng = np.random.default_rng(k)
    for _ in range(20):
        root, raw = rng.normal(size=(k, k)), rng.normal(size=k)
        cov = root @ root.T + 1e-3 * np.eye(k)
        before = cov.copy(), raw.copy()
        square = float(raw @ np.linalg.inv(cov) @ raw)
        assert gauss.square(raw, cov) == pytest.approx(square, rel=1e-6)
        log_density = -0.5 * (square + np.log(np.linalg.det(2.0 * np.pi * cov)))
        assert gauss.log_density(raw, cov) == pytest.approx(float(log_density), rel=1e-6)
        white = gauss.whitening(cov)
        np.testing.assert_allclose(white @ cov @ white.T, np.eye(k), atol=1e-8)
        np.testing.assert_array_equal(white, np.tril(white))
        np.testing.assert_array_equal(cov, before[0])
        np.testing.assert_array_equal(raw, before[1])


def test_what_is_not_positive_definite_is_solved_all_the_same() -> None:
    """Sums and differences of covariances may be so to rounding: no weight of a run may become NaN for it."""
    cov, raw = np.diag([1.0, -1e-9]), np.array([1.0, 0.0])
    assert gauss.square(raw, cov) == pytest.approx(1.0)
    assert np.isfinite(gauss.log_density(raw, cov))


def test_what_is_not_positive_definite_has_no_root() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        gauss.whitening(np.diag([1.0, -1e-9]))
