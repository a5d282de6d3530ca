# SPDX-License-Identifier: Apache-2.0
"""What may stand in the block of an aerial sensor."""

from __future__ import annotations

from typing import Any

import pytest

from graphloc.config import parse_config
from graphloc.errors import ConfigError
from graphloc.factors import SENSORS

KINDS = {row.kind: row.config for row in SENSORS}
LIDARS = {"bow": {"topic": "/a"}, "mast": {"topic": "/b"}}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"reach_m": 301}, r"sensors.aerial.reach_m: .*less than or equal to 300"),
        ({"window_m": 51}, r"sensors.aerial.window_m: .*less than or equal to 50"),
        ({"window_deg": 31}, r"sensors.aerial.window_deg: .*less than or equal to 30"),
        ({"lidars": {**LIDARS, "aft": {"topic": "/a"}}}, "lidars: bow and aft have the same topic, /a"),
        ({"hull_m": [[5, 0]]}, "hull_m: an outline has three corners or more"),
        ({"hull_m": [[5, 1], [5, -1]]}, "hull_m: an outline has three corners or more"),
        ({"hull_m": [[5, 1], [-5, -1], [5, -1], [-5, 1]]}, "hull_m: .* make no outline: Self-intersection"),
        ({"hull_m": [[5, 1], [4, 1], [3, 1]]}, "hull_m: .* make no outline"),
        ({"mount": {"xyz_m": [1, 0, 0]}}, "mount: not used here.*set it for each of `lidars`"),
        ({"mount": {"tf_frame": "lidar"}}, "mount: not used here"),
        ({"topic": "/points"}, "topic: not used here"),
    ],
)
def test_an_aerial_block_that_cannot_be_meant_is_one_line(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=why) as said:
        parse_config({"sensors": {"aerial": {"lidars": LIDARS, **changes}}}, KINDS, "vessel.yaml")
    assert "\n" not in str(said.value)
    assert "sensors.aerial." in str(said.value)


def test_an_aerial_block_at_its_bounds_is_read() -> None:
    block = {"reach_m": 300, "window_m": 50, "window_deg": 30, "topic": "", "mount": {}, "lidars": LIDARS}
    for hull in ([], [[5, 1], [-5, 1], [0, 0], [-5, -1], [5, -1]], [[5, 1], [-5, 1], [5, -1], [5, 1]]):
        config = parse_config({"sensors": {"aerial": {**block, "hull_m": hull}}}, KINDS, "vessel.yaml")
        assert len(config.sensors["aerial"].hull_m) == len(hull)


@pytest.mark.parametrize("shared", ["image", "vector"])
def test_two_aerial_sensors_of_one_image_are_refused(shared: str) -> None:
    own = {"image": "map.tif", "vector": "quays.geojson"}
    other = {"image": "other.tif", "vector": "other.geojson", shared: own[shared], "lidars": {"aft": {"topic": "/c"}}}
    sensors: dict[str, dict[str, Any]] = {
        "fore": {"kind": "aerial", **own, "lidars": LIDARS},
        "rear": {"kind": "aerial", **other},
    }
    with pytest.raises(
        ConfigError, match=f"fore and rear are both matched to {own[shared]}.*move the lidars of rear to fore"
    ):
        parse_config({"sensors": sensors}, KINDS, "vessel.yaml")
    sensors["rear"]["enabled"] = False
    assert parse_config({"sensors": sensors}, KINDS, "vessel.yaml").of_kind("aerial").keys() == {"fore"}
