# SPDX-License-Identifier: Apache-2.0
"""Matches of LiDAR scans to an aerial image: poses in the plane, with several modes, of the body itself."""

from dataclasses import replace

from graphloc.config import AerialConfig
from graphloc.factors import pose

ROW = replace(pose.ROW, kind="aerial", config=AerialConfig)
