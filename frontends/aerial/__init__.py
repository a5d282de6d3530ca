# SPDX-License-Identifier: Apache-2.0
"""LiDAR scans matched to an aerial image: `Matcher` turns a levelled cloud and a prior into a `PoseFix` with modes."""

from graphloc.frontends.aerial.matcher import Match, Matcher, Prior
from graphloc.frontends.aerial.scans import check_scans, match_bag

__all__ = ["Match", "Matcher", "Prior", "check_scans", "match_bag"]
