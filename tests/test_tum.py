# SPDX-License-Identifier: Apache-2.0
"""A truth from a file of TUM's form: read exactly, compared with, and refused in one line where it is none."""

from pathlib import Path

import numpy as np
import pytest

from graphloc import app
from graphloc.app import _estimate
from graphloc.config import VesselConfig
from graphloc.errors import InputError
from graphloc.frontends.part import BagPart
from graphloc.frontends.tum import read_tum
from tests.bagfactory import START_NS, Messages, still_run, write_bag

HALF = float(np.sqrt(0.5))


def written(folder: Path, *lines: str) -> Path:
    path = folder / "truth.tum"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_poses_are_read_exactly(tmp_path: Path) -> None:
    """A double resolves such a stamp only to 240 ns. Half a second for 1 m east, 2 m north: 2 and 4 m/s."""
    path = written(
        tmp_path,
        "# stamp x y z qx qy qz qw",
        "1720000000.123456789 1.0 2.0 3.0 0 0 0 1",
        "",
        f"1720000000.623456789  2.0\t4.0 3.0 0 0 {HALF} {HALF}",
    )
    truth = read_tum(path)
    assert truth.stamps_ns.tolist() == [1720000000123456789, 1720000000623456789]
    np.testing.assert_allclose(truth.p_world_m, [[1, 2, 3], [2, 4, 3]])
    np.testing.assert_allclose(truth.yaw_rad, [0.0, np.pi / 2], atol=1e-9)
    assert truth.v_world_mps is not None
    np.testing.assert_allclose(truth.v_world_mps, [[2, 4, 0], [2, 4, 0]])
    assert (truth.stamps_ns - read_tum(path, -18.5).stamps_ns).tolist() == [18_500_000_000] * 2


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("1720000001 1 2 3 0 0 0", "line 2: not a pose"),
        ("1720000001,1,2,3,0,0,0,1", "line 2: not a pose"),
        ("1720000001 a b c 0 0 0 1", "line 2: not a pose"),
        ("1720000001 1 2 3 0 0 0 0", "line 2: its quaternion has not length 1"),
        ("1720000001 nan 2 3 0 0 0 1", "line 2: its position is not in metres"),
        ("1720000001 1e300 2 3 0 0 0 1", "line 2: its position is not in metres"),
        ("nan 1 2 3 0 0 0 1", "line 2: its stamp is no time since 1970"),
        ("1e999999999 1 2 3 0 0 0 1", "line 2: its stamp is no time since 1970"),
        ("1720000001000000000 1 2 3 0 0 0 1", "line 2: its stamp is no time since 1970 in seconds"),
        ("1720000000 1 2 3 0 0 0 1", "line 2: its stamp is not later than that of the pose before it"),
        ("", "holds 1 poses"),
    ],
)
def test_what_is_no_pose_is_one_line(line: str, said: str, tmp_path: Path) -> None:
    path = written(tmp_path, "1720000000 1 2 3 0 0 0 1", line)
    with pytest.raises(InputError) as caught:
        read_tum(path)
    assert str(caught.value).startswith(str(path))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_text_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "truth.tum").write_bytes(b"\xff\xfe\x00")
    for path, said in (
        (tmp_path / "truth.tum", "not a text"),
        (tmp_path / "none.tum", "cannot be read"),
        (tmp_path, "cannot be read"),
    ):
        with pytest.raises(InputError, match=said):
            read_tum(path)


@pytest.mark.parametrize(("start_s", "first_s"), [(0.0, -2.0), (1.0, 1.0)])
def test_it_is_the_truth_of_a_run(
    tmp_path: Path, start_s: float, first_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a part of the bag, what lies within, here without the minute beside it; relative to vessel.yaml. It lasts 20 s, the bag 4 s."""
    monkeypatch.setattr(_estimate, "_TRUTH_BEYOND_S", 0.0)
    lines = (f"{START_NS // 10**9 + k - 2} {k} 0 0 0 0 0 1" for k in range(20))
    written(tmp_path, *lines)
    bag = write_bag(tmp_path / "run", make := Messages(2), sorted(still_run(make), key=lambda i: i[1]))
    (tmp_path / "vessel.yaml").write_text(
        "datum: {latitude_deg: 57.7, longitude_deg: 11.7}\ntruth_file: truth.tum\n"
        "sensors: {imu: {topic: /imu}, gnss: {topic: /fix}}\n"
    )
    recording, config = app.load(BagPart((bag,), start_s), tmp_path / "vessel.yaml")
    assert config.truth == "truth.tum"
    assert recording.truth is not None
    assert (recording.truth.stamps_ns[0] - START_NS) / 1e9 == pytest.approx(first_s, abs=1.0)
    assert len(recording.truth) == (20 if start_s == 0.0 else 3)
    (tmp_path / "vessel.yaml").write_text("truth_file: truth.tum\nsensors: {imu: {topic: /imu}, gnss: {topic: /fix}}\n")
    with pytest.raises(InputError, match=r"truth_file: positions in the world frame.*set datum"):
        app.load((bag,), tmp_path / "vessel.yaml")


def test_there_is_one_truth() -> None:
    with pytest.raises(ValueError, match="truth_topic and truth_file: there can be only one truth"):
        VesselConfig(truth_topic="/truth", truth_file="truth.tum")
