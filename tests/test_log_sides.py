# SPDX-License-Identifier: Apache-2.0
"""To which side y of a log looks, by what the IMU feels there: no tf, name or type tells it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends.inspect import draft_config, inspect_bag, render
from tests.bagfactory import START_NS, Item, Messages, S, write_bag

IMU_HZ, LOG_HZ, LASTS_S = 50.0, 5.0, 120.0
DATUM = Datum(Geodetic(57.7, 11.9, 40.0))
STARBOARD = np.diag([1.0, -1.0, -1.0])
DOWN_M = np.array(
    [1.5, 0.0, -4.0]
)  # of the log, from the IMU: as it rolls, it goes the other way than what is felt above


def sailed(
    tmp_path: Path,
    axes: Array,
    *,
    sways_mps: float = 0.3,
    turned_deg: float = 0.0,
    side: bool = True,
    lost: bool = False,
) -> tuple[str, str]:
    """What `inspect` says of, and drafts for, a log of a boat that turns, sways and rolls.

    Args:
        axes: (3, 3), from the body to those of the log. sways_mps: RMS. turned_deg: yaw of the IMU. side: whether it tells its speed there.
        lost: whether it hears no echo for a quarter of the time.
    """
    rng, t = np.random.default_rng(3), np.arange(0.0, LASTS_S, 1.0 / IMU_HZ)

    def slow(rms: float, lasts_s: float) -> Array:
        wave = gaussian_filter1d(rng.normal(size=len(t)), lasts_s * IMU_HZ)
        return np.asarray(rms * wave / np.sqrt((wave**2).mean()))

    yaw, roll = np.cumsum(slow(np.radians(4.0), 4.0)) / IMU_HZ, slow(np.radians(4.0), 0.7)
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, np.zeros(len(t)), roll]))
    ahead, aside = 3.0 + slow(0.5, 4.0), slow(sways_mps, 0.8)
    v = np.column_stack([ahead * np.cos(yaw) - aside * np.sin(yaw), ahead * np.sin(yaw) + aside * np.cos(yaw), 0.0 * t])
    place = np.cumsum(v, axis=0) / IMU_HZ
    rate = (R[:-1].inv() * R[1:]).as_rotvec() * IMU_HZ
    rate = np.vstack([rate, rate[-1:]])
    accel = R.inv().apply(np.gradient(v, t, axis=0) + np.array([0.0, 0.0, 9.81]))
    own = Rotation.from_euler("z", turned_deg, degrees=True).inv()
    accel = own.apply(accel) + 0.05 * rng.normal(size=(len(t), 3))
    gyro = own.apply(rate) + 0.002 * rng.normal(size=(len(t), 3))
    said = (R.inv().apply(v) + np.cross(rate, DOWN_M)) @ axes.T + 0.03 * rng.normal(size=(len(t), 3))
    said[:, 1:] *= side
    if lost:
        said[np.arange(len(t)) % round(20.0 * IMU_HZ) < round(5.0 * IMU_HZ)] = -32.768
    messages, items = Messages(2), list[Item]()
    for k, at in enumerate((START_NS + np.round(t * S).astype(np.int64)).tolist()):
        items.append(("/imu", at, messages.imu(at, accel[k], gyro[k])))
        if k % round(IMU_HZ / LOG_HZ) == 0:
            items.append(("/log", at, messages.twist(at, said[k])))
        if k % round(IMU_HZ) == 0:
            lat, lon, height = DATUM.geodetic_from_enu(place[[k]] + 0.1 * rng.normal(size=(1, 3)))[0]
            items.append(("/fix", at, messages.fix(at, lat, lon, height)))
    found = inspect_bag(write_bag(tmp_path / "bag", messages, items))
    drafted = draft_config(found)
    return render(found), drafted[drafted.index("kind: body_velocity") :]


@pytest.mark.parametrize(
    ("axes", "side", "mount"), [(np.eye(3), "port", ""), (STARBOARD, "starboard", ", rpy_deg: [180.0, 0.0, 0.0]")]
)
def test_the_imu_tells_to_which_side_a_log_looks(tmp_path: Path, axes: Array, side: str, mount: str) -> None:
    """Drafted with x alone, an AUV that dived for three minutes was twice as far off as with all three, and called lost."""
    said, drafted = sailed(tmp_path, axes)
    assert f"y looks to {side}" in said
    assert "axes: [x, y, z]" in drafted
    assert f"mount: {{xyz_m: [0.0, 0.0, 0.0]{mount}}}" in drafted


@pytest.mark.parametrize(
    ("sways_mps", "turned_deg", "side"),
    [(0.0, 0.0, True), (0.3, 180.0, True), (0.3, 0.0, False)],
    ids=["it rolls only", "the IMU sits astern", "it tells none"],
)
def test_what_shows_no_side_is_read_ahead_only(
    tmp_path: Path, sways_mps: float, turned_deg: float, *, side: bool
) -> None:
    """Rolling alone moves a log below the IMU the other way than what is felt."""
    said, drafted = sailed(tmp_path, np.eye(3), sways_mps=sways_mps, turned_deg=turned_deg, side=side)
    assert "y looks to starboard" not in said
    if not side:
        assert "axes: [x" not in drafted


def test_a_log_that_at_times_hears_no_echo_is_one_nevertheless(tmp_path: Path) -> None:
    """It was left out: at -32.768 m/s it differed from the fixes by 15 m/s (RMS)."""
    assert sailed(tmp_path, STARBOARD, lost=True)[1].startswith(sailed(tmp_path / "all", STARBOARD)[1].split("#")[0])
