"""Sensors of other packages: the worked example, installed and read from a bag, and packages that are broken."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from graphloc import factors
from graphloc.config import HeightConfig, VesselConfig, load_config, parse_config
from graphloc.errors import ConfigError, InputError
from graphloc.eval.simulate import Scenario
from graphloc.eval.simulate.bag import write_bag as write_simulated
from graphloc.extras import added
from graphloc.factors import KINDS
from graphloc.frontends import decode
from graphloc.frontends.bag import check_bag, read_recording
from graphloc.measurements import BodyVelocity
from tests.bagfactory import START_NS, Messages, still_run, write_bag
from tests.slowly import simulate_slowly

EXAMPLE = Path(__file__).parent.parent / "examples/range_beacon"
Points = dict[str, dict[str, str]]


def installed(site: Path, points: Points, *modules: Path) -> dict[str, str]:
    """What pip would do: modules on the path, and metadata that names entry points. Returns the environment."""
    info = site / "some_package-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: some-package\nVersion: 1\n")
    text = [f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in named.items()) for group, named in points.items()]
    (info / "entry_points.txt").write_text("\n".join(text))
    for module in modules:
        (site / module.name).write_text(module.read_text())
    return {**os.environ, "PYTHONPATH": str(site)}


def graphloc(env: dict[str, str], *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "graphloc", *map(str, arguments)]
    return subprocess.run(command, env=env, capture_output=True, text=True, check=False)


def test_the_example_is_read_from_a_bag_and_used(tmp_path: Path) -> None:
    """Ranges to two beacons, one of them in the wrong place by 20 m: it is found out by the rest of the run."""
    run = simulate_slowly(
        Scenario(duration_s=8.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0, noise="clean", false_fraction=0.0), 4
    )
    bag, config = write_simulated(run, tmp_path / "bag", ros=2)
    make, right, wrong = Messages(2), np.array([-70.0, 90.0, 5.0]), np.array([60.0, 80.0, 5.0])
    items: list[Any] = []
    for k in range(0, len(run.truth), 25):
        at_ns = int(run.truth.stamps_ns[k])
        for topic, place in (("/right", right), ("/wrong", wrong)):
            away_m = float(np.linalg.norm(run.truth.p_world_m[k] - place)) if k != 50 else 0.0
            msg = make.t["sensor_msgs/msg/Range"](
                header=make.header(at_ns),
                radiation_type=0,
                field_of_view=0.0,
                min_range=1.0,
                max_range=500.0,
                range=away_m,
            )
            items.append((topic, at_ns + 1000, msg))
    ranges = write_bag(tmp_path / "ranges", make, items, kind="mcap")
    raw = YAML(typ="safe", pure=True).load(config.read_text())
    for name, place in (("right", right), ("wrong", wrong - [20.0, 0.0, 0.0])):
        raw["sensors"][name] = {"kind": "range_beacon", "topic": f"/{name}", "beacon_m": [float(v) for v in place]}
    with config.open("w") as stream:
        YAML(typ="safe", pure=True).dump(raw, stream)

    points = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"]
    env = installed(tmp_path / "site", points, EXAMPLE / "graphloc_range_beacon.py")
    done = graphloc(env, "smooth", bag, ranges, "-c", config, "-o", tmp_path / "run", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout[: done.stdout.rindex("}") + 1])
    count = len(items) // 2
    assert said["ledger"]["right"] == {"malformed": 1, "used": count - 1}
    assert said["ledger"]["wrong"] == {"malformed": 1, "rejected": count - 1}
    assert said["Against truth"]["graphloc"]["position_rmse_m"] < 0.3
    assert "not within 1 to 500 m" in (tmp_path / "run/ledger.csv").read_text()

    with pytest.raises(ConfigError, match="unknown kind 'range_beacon'"):
        load_config(config, KINDS)  # here it is not installed


GOOD = "graphloc_range_beacon:ROW"


def test_a_broken_package_is_one_line(tmp_path: Path) -> None:
    points = {"graphloc.sensors": {"broken": "nowhere:ROW"}}
    done = graphloc(installed(tmp_path / "site", points), "sensors")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "'broken' of some-package: cannot be loaded" in done.stderr
    assert "uninstall" in done.stderr


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ({"graphloc.sensors": {"number": "math:pi"}}, "'number': is a float, no Sensor"),
        ({"graphloc.sensors": {"other": GOOD}}, "'other': its row is of kind 'range_beacon'"),
        (
            {"graphloc.sensors": {"range_beacon": "unlike:ROW"}},
            "'range_beacon': the configuration of its row is no SensorConfig",
        ),
    ],
)
def test_a_package_whose_entry_is_no_row_of_its_kind_is_refused(
    tmp_path: Path, points: Points, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the table of sensors is made; how the command line says it, the test above shows."""
    installed(tmp_path / "site", points, EXAMPLE / "graphloc_range_beacon.py")
    text = "from dataclasses import replace\nfrom graphloc_range_beacon import ROW\nROW = replace(ROW, config=dict)\n"
    (tmp_path / "site/unlike.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.setattr(factors, "added", added.__wrapped__)
    try:
        with pytest.raises(ConfigError) as caught:
            factors._theirs()  # noqa: SLF001
    finally:
        for module in ("graphloc_range_beacon", "unlike"):
            sys.modules.pop(module, None)
    assert said in str(caught.value)
    assert "uninstall" in str(caught.value)
    assert "\n" not in str(caught.value)


SPEED_LOG = """import numpy as np
from graphloc.measurements import BodyVelocity

def decode(msg, stamp_ns, seq, sensor, config):
    value = np.array([msg.range * 1852.0 / 3600.0])
    return BodyVelocity(stamp_ns=stamp_ns, sensor=sensor, seq=seq, axes=("x",), value=value, cov=np.eye(1) * 0.01)

DECODERS = {"sensor_msgs/msg/Range": decode}
LIST = [decode]
NONE = {"sensor_msgs/msg/Range": lambda *_: None}
"""
"""A speed log in knots in a message that graphloc does not take for one."""


def with_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, entry: str) -> tuple[Path, VesselConfig]:
    """A bag with an IMU, fixes and a log at 3.6 knots, read through a package that adds decoders of a kind."""
    make = Messages(2)
    log = {"radiation_type": 0, "field_of_view": 0.0, "min_range": 0.0, "max_range": 50.0, "range": 3.6}
    items = still_run(make)
    for k in range(20):
        at_ns = START_NS + k * 100_000_000
        items.append(("/log", at_ns, make.t["sensor_msgs/msg/Range"](header=make.header(at_ns), **log)))
    bag = write_bag(tmp_path / "bag", make, items, kind="mcap")
    installed(tmp_path / "site", {"graphloc.decoders": {kind: f"speed_log:{entry}"}})
    (tmp_path / "site/speed_log.py").write_text(SPEED_LOG)
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.setattr(decode, "added", added.__wrapped__)
    monkeypatch.delitem(sys.modules, "speed_log", raising=False)
    imu, gnss = {"kind": "imu", "topic": "/imu"}, {"kind": "gnss", "topic": "/fix"}
    raw = {"sensors": {"imu": imu, "gnss": gnss, "log": {"kind": "body_velocity", "topic": "/log"}}}
    return bag, parse_config(raw, KINDS, "vessel.yaml")


def test_a_package_may_add_a_message_of_its_own_to_a_kind_of_graphloc(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """3.6 knots are 1.852 m/s."""
    bag, config = with_a_log(tmp_path, monkeypatch, "body_velocity", "DECODERS")
    told = [m.value for m in read_recording((bag,), config).measurements if isinstance(m, BodyVelocity)]
    np.testing.assert_allclose(told, np.full((20, 1), 1.852), rtol=1e-6)


def test_a_decoder_that_returns_no_measurement_is_said_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was said that its messages tell nothing of the axes that are asked for."""
    bag, config = with_a_log(tmp_path, monkeypatch, "body_velocity", "NONE")
    rows = [row for row in read_recording((bag,), config).rows if row.sensor == "log"]
    assert sum(row.count for row in rows) == 20
    assert all("its decoder returned NoneType, no measurement" in row.reason for row in rows)


def test_decoders_that_are_no_table_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag, config = with_a_log(tmp_path, monkeypatch, "body_velocity", "LIST")
    with pytest.raises(
        ConfigError, match=r"graphloc.decoders: 'body_velocity': is a list, no dict .*: mend or uninstall"
    ):
        check_bag((bag,), config)


def test_a_topic_of_a_kind_without_decoders_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A misnamed entry point of decoders: the topic would not be read, and nothing would say so."""
    bag, config = with_a_log(tmp_path, monkeypatch, "body_velocety", "DECODERS")
    sensors = {**config.sensors, "log": HeightConfig(topic="/log")}
    with pytest.raises(
        InputError, match=r"sensors.log.topic '/log': nothing reads a topic for kind 'height'.* graphloc.decoders"
    ):
        check_bag((bag,), config.model_copy(update={"sensors": sensors}))
    off = {**sensors, "log": HeightConfig(topic="/log", enabled=False)}
    check_bag((bag,), config.model_copy(update={"sensors": off}))
