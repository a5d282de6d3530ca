# SPDX-License-Identifier: Apache-2.0
"""A true track from a file of TUM's form, as evo reads and writes it: a pose per line."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.errors import InputError
from graphloc.frontends._standard import is_unit
from graphloc.frontends.decode import MOST_DISTANCE_M
from graphloc.frontends.source import LATEST_NS
from graphloc.time import NS_PER_S, seconds_since
from graphloc.trajectory import Trajectory

_MOST_BYTES = 1 << 28
_FORM = "stamp x y z qx qy qz qw (s since 1970; m; a unit quaternion)"


def read_tum(path: Path, offset_s: float = 0.0) -> Trajectory:
    """Return the poses of body in world of a file, with velocity, which is the derivative of the positions.

    Empty lines and lines that begin with # are skipped. A file whose quaternions are all 0 0 0 1 holds positions only.

    Args:
        path: of the file. offset_s: added to its stamps.

    Raises:
        InputError: it cannot be read, is not of that form, or holds fewer than two poses.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{path}: larger than {_MOST_BYTES >> 20} MiB")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); `truth_file` names it") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text; a truth_file holds lines of {_FORM}") from None
    stamps, rows = list[int](), list[list[float]]()
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        stamp, row = _pose_of(line.split(), f"{path}, line {number}")
        if stamps and stamp <= stamps[-1]:
            raise InputError(
                f"{path}, line {number}: its stamp is not later than that of the pose before it: sort the lines"
            )
        stamps.append(stamp)
        rows.append(row)
    if len(rows) < 2:
        raise InputError(f"{path}: holds {len(rows)} poses; a truth_file needs two or more lines of {_FORM}")
    at, poses = np.array(stamps, dtype=np.int64) + round(offset_s * NS_PER_S), np.array(rows)
    return Trajectory(
        stamps_ns=at,
        p_world_m=poses[:, :3],
        R_world_body=Rotation.from_quat(poses[:, 3:]).as_matrix(),
        headed=bool(poses[:, 3:6].any()),
        v_world_mps=np.gradient(poses[:, :3], seconds_since(int(at[0]), at), axis=0),
    )


def _pose_of(words: list[str], where: str) -> tuple[int, list[float]]:
    """Return the stamp, exact to a nanosecond, and the seven numbers of a pose."""
    try:
        stamp_s, row = Decimal(words[0]), [float(word) for word in words[1:]]
    except (InvalidOperation, ValueError):
        stamp_s, row = Decimal(0), []
    if len(row) != 7:
        raise InputError(f"{where}: not a pose: a truth_file holds lines of {_FORM}, without commas")
    if not (stamp_s.is_finite() and 0 < stamp_s <= Decimal(LATEST_NS) / NS_PER_S):
        raise InputError(f"{where}: its stamp is no time since 1970 in seconds")
    if not (np.abs(row[:3]) <= MOST_DISTANCE_M).all():
        raise InputError(f"{where}: its position is not in metres from the datum")
    if not is_unit(np.array(row[3:])):
        raise InputError(f"{where}: its quaternion has not length 1")
    return int((stamp_s * NS_PER_S).to_integral_value()), row
