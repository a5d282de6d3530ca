# SPDX-License-Identifier: Apache-2.0
"""Sizes of tags against how far apart the survey has them: what is refused, and that right surveys never are."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc.frontends.tags.sizes import size_factors
from graphloc.gather._gathering import Gathering
from graphloc.gather._sightings import _take_sized
from graphloc.measurements import TagSighting
from graphloc.survey import Survey, TagConfig
from tests import tagfactory
from tests.test_tag_runs import off, sized, voyage

Change = Callable[[TagConfig], TagConfig]
TRUE_M = tagfactory.SIZE_M


def seen(
    kind: str, seed: int, change: Change | None = None, *, only: tuple[int, ...] = (), noise_px: float = 0.15
) -> tuple[list[TagSighting], Survey]:
    """Sightings of an approach, and their survey, each tag changed."""
    run = voyage(kind, seed)
    survey = tagfactory.survey_of(run)
    if change is not None:
        survey = survey.model_copy(update={"tags": tuple(change(tag) for tag in survey.tags)})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tagfactory, "survey_of", lambda _: survey)
        found = tagfactory.sighted(run, rate_hz=0.5, only=only, noise_px=noise_px)[1]
    return [m for m, _ in found], survey


def surveyed_to(sigma_m: float, sigma_deg: float, seed: int) -> Change:
    """Each tag with errors as its survey says."""
    rng = np.random.default_rng(seed)

    def worse(tag: TagConfig) -> TagConfig:
        turned = tag.R_frame_tag @ Rotation.from_rotvec(np.radians(rng.normal(0.0, sigma_deg, 3))).as_matrix()
        place = np.array(tag.xyz_m) + rng.normal(0.0, sigma_m, 3)
        rpy = Rotation.from_matrix(turned).as_euler("xyz", degrees=True)
        changed = {"xyz_m": tuple(map(float, place)), "rpy_deg": tuple(map(float, rpy)), "facing_deg": None}
        sigmas = {
            "sigma_m": float(np.hypot(sigma_m, tag.sigma_m)),
            "sigma_deg": float(np.hypot(sigma_deg, tag.sigma_deg)),
        }
        return tag.model_copy(update=changed | sigmas)

    return worse


@cache
def all_sized(kind: str, share: float) -> tuple[list[TagSighting], Survey]:
    """Sightings of tags that are all given as so many times as large, and their survey."""
    return seen(kind, 1, sized(share * TRUE_M))


@pytest.mark.parametrize(("kind", "share"), [("fixed", 0.8), ("fixed", 1.06), ("floating", 1.25), ("floating", 0.393)])
def test_sizes_that_are_all_wrong(kind: str, share: float) -> None:
    """The white margin measured, too (10 cells for 8); a border left out; the size of a well-known example; scaled by a printer."""
    sightings, survey = all_sized(kind, share)
    frame = "world" if kind == "fixed" else "north_dock"
    assert size_factors(sightings, survey) == {frame: pytest.approx(1.0 / share, rel=0.02)}


@pytest.mark.parametrize(("share", "refused"), [(1.0, None), (1.06, False), (0.94, False), (1.25, True)])
def test_sizes_that_are_slightly_wrong_are_said_and_used(share: float, refused: bool | None) -> None:
    """A print scaled by some per cent: the run by itself blames places and attitudes of single tags."""
    sightings, survey = all_sized("fixed", share)
    gathered = Gathering(voyage("fixed", 1).recording)
    _take_sized(gathered, "tags", sightings, survey)
    said = [line for line in gathered.said if "sizes in tags.yaml disagree with the spacing" in line]
    assert len(said) == (0 if refused is None else 1)
    used = sum(isinstance(m, TagSighting) for m in gathered.recording().measurements)
    assert used == (0 if refused else len(sightings))
    if refused is not None:
        (factor,) = re.findall(r"size_m times (\d\.\d\d) would agree", said[0])
        assert float(factor) == pytest.approx(1.0 / share, abs=0.015)
        assert ("no sighting of these tags is used" in said[0]) == refused


def test_two_tags_are_enough() -> None:
    sightings, survey = seen("fixed", 2, sized(1.25 * TRUE_M), only=(226, 227))
    assert size_factors(sightings, survey) == {"world": pytest.approx(0.8, rel=0.05)}


@pytest.mark.parametrize(("kind", "seed"), [("fixed", 1), ("floating", 2), ("floating", 3), ("fixed", 4)])
@pytest.mark.parametrize("sigmas", [(0.0, 0.0), (0.1, 3.0), (0.3, 5.0)])
def test_right_surveys_are_never_refused(kind: str, seed: int, sigmas: tuple[float, float]) -> None:
    only = (226, 227, 230, 231) if seed % 2 else ()
    sightings, survey = seen(kind, seed, surveyed_to(*sigmas, seed), only=only, noise_px=0.15 if seed < 3 else 0.8)
    assert len(sightings) >= 8
    assert size_factors(sightings, survey) == {}


@pytest.mark.parametrize(
    "change", [off(227, (0.5, 0.0, 0.0)), off(226, (0.0, 0.5, 0.0)), sized(0.162, 227), sized(1.25 * TRUE_M, 226)]
)
def test_one_tag_that_is_wrong_is_no_matter_of_all_sizes(change: Change) -> None:
    sightings, survey = seen("fixed", 1, change)
    assert size_factors(sightings, survey) == {}
