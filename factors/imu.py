# SPDX-License-Identifier: Apache-2.0
"""IMU preintegration between states, with bias.

    R_j = R_i Exp(int (w - b_g)),  v_j = v_i + g dt + R_i int (f - b_a),  p_j = p_i + v_i dt + ...

Forster et al., TRO 2017, as in GTSAM's `PreintegratedImuMeasurements` and `ImuFactor`. The bias is a separate state at the slow
period, constant between its nodes, with a random walk from node to node (docs/decisions): over 1 s that walk is far below the
noise of a sample. Samples are interpolated at the ends of the interval and averaged between stamps (trapezoid). If the driver
removed gravity: the same integral with g = 0. The states are at the IMU (see `graphloc.build`), so there is no lever arm here:
`setBodyPSensor` would omit the Euler term (angular acceleration x lever), 0.07 m/s^2 in harbour waves at 1 m, which lost whole
runs. Not handled: coning faster than the sample rate.

**A gap in the data** of up to 2 s is interpolated linearly, with noise that covers what a vessel may do. In a longer one, and
after the end of the data, the motion of the last sample decays within a second to the mean of the seconds before,

    w(t) = w_m + (w_a - w_m) sinh((t_b - t) / tau) / sinh(T / tau) + (w_b - w_m) sinh((t - t_a) / tau) / sinh(T / tau)

the mean of an Ornstein-Uhlenbeck process between both ends. w_m goes linearly from the mean before the gap to that after it,
which preserves the bias and a steady turn. The specific force is treated likewise, less its own mean and with g = 0, since on
average it supports the vessel. (w_m - b_g) x v replaces the mean, v: velocity in body axes when the gap began, so the vessel
continues in the direction of its bow. Integrated with gravity, an unknown roll would become an acceleration (250 m after 13 s),
but vessels stay upright: over a gap, roll and pitch wander no more than in one second. Bias and velocity are the values known
when a link is made (`graphloc.inertial.GapMotion`) and are not estimated by it: preintegration needs its samples before the velocity
is known.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.config import ImuConfig
from graphloc.frames import Array
from graphloc.inertial import GAP_TOLD_S, GAP_TURN_RADPS, GapMotion
from graphloc.measurements import ImuSeries
from graphloc.signals.series import integral, interpolated
from graphloc.time import duration_ns

_UNKNOWN_MPS2 = 1.0  # white noise of unknown motion in a gap
_SHORT_S = 2.0  # longest gap that is interpolated linearly; none is so short in which an IMU is switched off and on
# Silences are kept for so long after the samples about them: it is asked how far a bias has gone since then (`judge.bias_walk`, by a
# quarter of an hour).
_SILENT_KEPT_S = 1000.0
_STALLS_S = 10.0  # longest pause of all sensors that is taken for a recorder's and not for a power cycle; a choice
_ANEW = 0.25  # of the turn-on bias, by which it differs from one time to the next; a choice
_FORGET_S = 1.0  # decay of the last sample in a gap
_LAID_MPS = 3.0  # 1 sigma, of a vessel whose velocity is not known yet
_ASKEW_RAD = 0.1  # 1 sigma, of the direction of a motion across a pause
_GAP_STEP_S = 0.1  # integration step across a gap
_ABOUT_NS = 100_000_000  # to either side of a stamp: shorter than waves, longer than vibration
_INTEGRATION_SIGMA = 1e-4  # m/s/sqrt(Hz)-like floor that keeps position covariance positive


class Links:
    """Preintegration of one IMU (see `graphloc.inertial.InertialLink`)."""

    def __init__(
        self, imu: ImuSeries, config: ImuConfig, R_body_imu: Array, gravity_mps2: float, noise_scale: float
    ) -> None:
        self._stamps = imu.stamps_ns
        self._samples = np.hstack([imu.accel_mps2, imu.gyro_radps])
        self._config = config
        self._R_body_imu = R_body_imu
        self._max_gap_ns = duration_ns(config.max_gap_s)
        self._noise_scale = noise_scale
        self._gravity_mps2 = gravity_mps2 if config.gravity != "removed" else 0.0
        gyro = config.gyro_noise_radps * noise_scale
        self._left_out: list[tuple[int, int]] = []
        self._pauses: list[tuple[int, int]] = []
        self._silent = self._silences(self._stamps)
        self._params = self._make_params(self._gravity_mps2, config.accel_noise_mps2 * noise_scale, np.full(3, gyro))

    def extend(self, stamps_ns: NDArray[np.int64], samples: Array) -> None:
        """Add samples (N, 6), specific force and rate, at new stamps, in any order."""
        stamps, rows = np.concatenate([self._stamps, stamps_ns]), np.concatenate([self._samples, samples])
        if (np.diff(stamps[-len(stamps_ns) - 1 :]) <= 0).any():
            order = np.argsort(stamps, kind="stable")
            stamps, rows = stamps[order], rows[order]
        self._stamps, self._samples = stamps, rows
        # A late sample may end a silence that was found before.
        again = stamps[max(int(np.searchsorted(stamps, stamps_ns.min())) - 1, 0) :]
        self._silent = np.vstack([self._silent[self._silent[:, 1] <= again[0]], self._silences(again)])

    def _silences(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return (S, 2) the stamps between which nothing came for longer than `_SHORT_S`."""
        wide = np.flatnonzero(np.diff(stamps_ns) > _SHORT_S * 1e9)
        return self._unexplained(np.column_stack([stamps_ns[wide], stamps_ns[wide + 1]]))

    def _unexplained(self, silent: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the silences (S, 2) without those that consist of samples which were left out."""
        silent_ns = silent[:, 1] - silent[:, 0]
        for after_ns, until_ns in self._left_out:
            silent_ns -= np.maximum(np.minimum(silent[:, 1], until_ns) - np.maximum(silent[:, 0], after_ns), 0)
        return np.asarray(silent[silent_ns > _SHORT_S * 1e9])

    def leave_out(self, after_ns: int, until_ns: int) -> None:
        """Drop the samples after one stamp until another, which is then a gap, however short. The very first sample is not among them."""
        kept = (self._stamps <= after_ns) | (self._stamps > until_ns)
        self._stamps, self._samples = self._stamps[kept], self._samples[kept]
        within = [gap for gap in self._left_out if after_ns <= gap[0] and gap[1] <= until_ns]
        self._left_out = [gap for gap in self._left_out if gap not in within] + [(after_ns, until_ns)]
        self._silent = self._unexplained(self._silent)

    def pause(self, after_ns: int, until_ns: int) -> None:
        """Add noise between two samples, as if less time or none had passed between them; that is then a gap, however short."""
        self._pauses.append((after_ns, until_ns))
        if until_ns - after_ns < _STALLS_S * 1e9:
            self._silent = self._silent[(self._silent != (after_ns, until_ns)).any(axis=1)]

    def forget(self, before_ns: int) -> None:
        """Drop the samples before a stamp, except the last of them and those that the bridge of a gap after it needs."""
        self._left_out = [gap for gap in self._left_out if gap[1] >= before_ns]
        self._silent = self._silent[self._silent[:, 1] >= before_ns - duration_ns(_SILENT_KEPT_S)]
        before_ns = min([before_ns, *(a - duration_ns(GAP_TOLD_S) for a, _ in self._left_out)])
        first = max(int(np.searchsorted(self._stamps, before_ns)) - 1, 0)
        self._stamps, self._samples = self._stamps[first:].copy(), self._samples[first:].copy()

    def _make_params(self, gravity_mps2: float, accel: float, gyro: Array) -> Any:
        """Return parameters with noise densities of the accelerometer and, about the axes of body, of the gyroscope (3,)."""
        # Every covariance of fresh params is 1.0: set them all.
        params = gtsam.PreintegrationParams.MakeSharedU(gravity_mps2)
        params.setAccelerometerCovariance(np.eye(3) * accel**2)
        params.setGyroscopeCovariance(self._R_body_imu.T @ np.diag(gyro**2) @ self._R_body_imu)
        params.setIntegrationCovariance(np.eye(3) * _INTEGRATION_SIGMA**2)
        params.setBodyPSensor(gtsam.Pose3(gtsam.Rot3(self._R_body_imu), np.zeros(3)))
        return params

    def integrate(self, start_ns: int, stop_ns: int, bias: Any, going: GapMotion | None = None) -> Any:
        """Return the preintegrated measurement over [start_ns, stop_ns], in at least two steps.

        Args:
            bias: `gtsam.imuBias.ConstantBias`. going: bias and velocity where a gap begins; None: `bias`, and at rest.
        """
        first = int(np.searchsorted(self._stamps, start_ns, side="right"))
        last = int(np.searchsorted(self._stamps, stop_ns, side="left"))
        edges = np.concatenate([[start_ns], self._stamps[first:last], [stop_ns]])
        gap = self._gap_of(start_ns, stop_ns)
        if gap is not None:
            a, b = max(start_ns, gap[0]), min(stop_ns, gap[1])
            steps = np.linspace(a, b, 3 + int((b - a) * 1e-9 / _GAP_STEP_S)).astype(np.int64)
            edges = np.unique(np.concatenate([edges, steps]))
        elif len(edges) < 3:
            edges = np.array([start_ns, (start_ns + stop_ns) // 2, stop_ns])
        dts = np.diff(edges) * 1e-9
        middles = (edges[:-1] + edges[1:]) // 2
        samples, params = self._at(middles), self._params
        if gap is not None and gap[1] - gap[0] <= _SHORT_S * 1e9 and gap[1] <= self._stamps[-1]:
            params = self._make_params(self._gravity_mps2, _UNKNOWN_MPS2, np.full(3, GAP_TURN_RADPS))
        elif gap is not None:
            going = going or GapMotion(bias, np.zeros(3))
            samples, bias = self._bridge(middles, samples, gap, going), going.bias
            params = self._gap_params(start_ns, stop_ns, gap)
        for pause in self._pauses:
            within_ns = min(stop_ns, pause[1]) - max(start_ns, pause[0])
            if within_ns > 0:
                params = self._paused(params, pause, within_ns / (stop_ns - start_ns), going)
        pim = gtsam.PreintegratedImuMeasurements(params, bias)
        for sample, dt in zip(samples, dts, strict=True):
            if dt > 0.0:
                pim.integrateMeasurement(sample[:3], sample[3:], dt)
        return pim

    def _at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return samples (M, 6) interpolated at stamps, constant beyond the ends."""
        # `np.clip` takes several times as long as its two halves on so few numbers, and every link comes here.
        right = np.minimum(np.maximum(np.searchsorted(self._stamps, stamps_ns), 1), len(self._stamps) - 1)
        a, b = self._stamps[right - 1], self._stamps[right]
        share = np.minimum(np.maximum((stamps_ns - a) / np.maximum(b - a, 1), 0.0), 1.0)[:, None]
        return np.asarray(self._samples[right - 1] * (1.0 - share) + self._samples[right] * share)

    def _gap_of(self, start_ns: int, stop_ns: int) -> tuple[int, int] | None:
        """Return the longest gap (start, stop) that overlaps an interval, or None. The time after the last sample is a gap, too."""
        for after_ns, until_ns in self._left_out:
            if after_ns < stop_ns and start_ns < until_ns:
                return self._around(after_ns, until_ns)
        left = max(int(np.searchsorted(self._stamps, start_ns, side="right")) - 1, 0)
        right = int(np.searchsorted(self._stamps, stop_ns, side="left"))
        stamps = self._stamps[left : right + 1]
        if right == len(self._stamps):
            stamps = np.append(stamps, stop_ns)
        steps = np.diff(stamps)
        if not len(steps):
            return None
        n = int(np.argmax(steps))
        if steps[n] <= self._max_gap_ns:
            return None
        return int(stamps[n]), int(stamps[n + 1])

    def _around(self, after_ns: int, until_ns: int) -> tuple[int, int]:
        """Return the stamps of the samples before and after an interval that has none; where none follows it, its end."""
        left, right = np.searchsorted(self._stamps, [after_ns, until_ns], side="right")
        before_ns = min(int(self._stamps[max(left - 1, 0)]), after_ns)
        return before_ns, int(self._stamps[right]) if right < len(self._stamps) else until_ns

    def _bridge(self, stamps_ns: NDArray[np.int64], samples: Array, gap: tuple[int, int], going: GapMotion) -> Array:
        """Return samples (M, 6), at stamps (M,), of an interval with a gap, to be integrated without gravity (see the module's docstring).

        Args:
            samples: (M, 6) those outside the gap. gap: its begin and end, stamps.
        """
        start_ns, stop_ns = gap
        mean_before, mean_after = self._means_around(start_ns, stop_ns)
        length, t = (stop_ns - start_ns) * 1e-9 / _FORGET_S, (stamps_ns - start_ns)[:, None] * 1e-9 / _FORGET_S
        inside = (t > 0.0) & (t < length)
        t = np.clip(t, 0.0, length)
        mean = mean_before + t / length * (mean_after - mean_before)
        before, after = self._at(np.array(gap)) - [mean_before, mean_after]
        if stop_ns > self._stamps[-1]:
            across = mean + np.exp(-t) * before
        else:
            across = mean + _sinh_share(length - t, length) * before + _sinh_share(t, length) * after
        samples = np.where(inside, across, samples)
        # The mean force has the bias in it, which GTSAM takes off once more. A velocity that turns with the vessel feels w x v.
        rates = (mean[:, 3:] - going.bias.gyroscope()) @ self._R_body_imu.T
        samples[:, :3] += (
            going.bias.accelerometer() - mean[:, :3] + np.cross(rates, going.v_body_mps) @ self._R_body_imu
        )
        return samples

    def _gap_params(self, start_ns: int, stop_ns: int, gap: tuple[int, int]) -> Any:
        """Return the parameters of an interval with a gap.

        An interval gets its share of the tilt of the whole gap: by time, or, if the end of the gap is not known yet, by the decay.
        """
        begin, end = ((np.clip(at_ns, *gap) - gap[0]) * 1e-9 / _FORGET_S for at_ns in (start_ns, stop_ns))
        if gap[1] > self._stamps[-1]:
            share = np.exp(-begin) - np.exp(-end)
        else:
            share = (end - begin) * _FORGET_S * 1e9 / (gap[1] - gap[0])
        white = self._config.gyro_noise_radps * self._noise_scale
        tilt = np.hypot(white, GAP_TURN_RADPS * np.sqrt(share / ((stop_ns - start_ns) * 1e-9)))
        return self._make_params(0.0, _UNKNOWN_MPS2, np.array([tilt, tilt, GAP_TURN_RADPS]))

    def _paused(self, params: Any, pause: tuple[int, int], share: float, going: GapMotion | None) -> Any:
        """Return the parameters of an interval, a share of which lies in a pause, in which perhaps no time passed and nothing moved.

        The motion over a whole pause of length g is then wrong by v g, w g and (f - f_m) g, which is taken as 1 sigma; f_m: the mean
        specific force around the pause, which is mostly gravity.
        """
        moved = _squared(going.v_body_mps) if going else _LAID_MPS**2 * np.eye(3)
        bias = going.bias if going else gtsam.imuBias.ConstantBias()
        sample = self._at(np.array(pause)).mean(axis=0)
        force = sample[:3] - np.mean(self._means_around(*pause), axis=0)[:3]
        spread = share * (pause[1] - pause[0]) * 1e-9
        paused = deepcopy(params)
        paused.setIntegrationCovariance(params.getIntegrationCovariance() + spread * moved)
        paused.setGyroscopeCovariance(
            params.getGyroscopeCovariance() + spread * _squared(sample[3:] - bias.gyroscope())
        )
        paused.setAccelerometerCovariance(params.getAccelerometerCovariance() + spread * _squared(force))
        return paused

    def _means_around(self, start_ns: int, stop_ns: int) -> tuple[Array, Array]:
        """Return the means (6,) of the seconds before and after a gap; a side with too few samples takes the mean of the other."""
        around_ns = duration_ns(GAP_TOLD_S)
        first, start, stop, last = np.searchsorted(
            self._stamps, [start_ns - around_ns, start_ns + 1, stop_ns, stop_ns + around_ns]
        )
        sides = [(first, start), (stop, last)]
        means = [self._samples[a:b].mean(axis=0) for a, b in sides if self._covered_ns(a, b) > around_ns // 2]
        if not means:
            means = [self._samples[first:last].mean(axis=0)]
        return means[0], means[-1]

    def _covered_ns(self, a: int, b: int) -> int:
        """Return the time that samples a to b cover, without gaps."""
        steps = np.diff(self._stamps[a:b])
        return int(steps[steps <= self._max_gap_ns].sum())

    def factor(self, k: int, j: int, preintegrated: Any) -> Any:
        """Return the factor between states k and k + 1 with the bias of slow node j."""
        return gtsam.ImuFactor(
            keys.pose(k), keys.velocity(k), keys.pose(k + 1), keys.velocity(k + 1), keys.bias(j), preintegrated
        )

    def gyro_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return the raw rates (M, 3), rad/s, in body axes."""
        return np.asarray(self._at(stamps_ns)[:, 3:] @ self._R_body_imu.T)

    def gyro_variance_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return the variances (M,), each axis, rad^2/s^2, of `gyro_at`: white noise of one sample; of unknown motion where there is none."""
        steps = np.diff(self._stamps)
        steps = steps[steps <= self._max_gap_ns]
        variance = np.full(len(stamps_ns), GAP_TURN_RADPS**2 / _FORGET_S)
        if len(steps):
            sampled = np.ones(len(stamps_ns), dtype=bool)
            for after_ns, until_ns in self.gaps():
                sampled &= (stamps_ns <= after_ns) | (stamps_ns >= until_ns)
            sampled &= stamps_ns <= self._stamps[-1] + self._max_gap_ns
            variance[sampled] = (self._config.gyro_noise_radps * self._noise_scale) ** 2 / (np.median(steps) * 1e-9)
        return variance

    def felt_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return the raw specific force, m/s^2, and the change of the rate, rad/s^2 (M, 6), in body axes, each by means over 0.2 s."""
        stamps = self._stamps
        wide = np.flatnonzero(np.diff(stamps) > self._max_gap_ns)
        starts, stops = stamps[np.append(0, wide + 1)], stamps[np.append(wide, len(stamps) - 1)]
        near = np.searchsorted((stops[:-1] + starts[1:]) // 2, stamps_ns)  # samples without gaps
        start, stop = starts[near], stops[near]
        begin, end = (np.clip(stamps_ns + side, start, stop) for side in (-_ABOUT_NS, _ABOUT_NS))
        beyond = begin == end
        # At the ends half of that at least: of a few samples that vibrate, the change of the rate is off by rad/s^2.
        begin, end = (
            np.maximum(np.minimum(begin, end - _ABOUT_NS), start),
            np.minimum(np.maximum(end, begin + _ABOUT_NS), stop),
        )
        first = max(int(np.searchsorted(stamps, begin.min(), side="right")) - 1, 0)
        last = int(np.searchsorted(stamps, end.max(), side="left")) + 1
        t = (stamps[first:last] - stamps[first]) * 1e-9
        sums = integral(t, self._samples[first:last])
        edges = [(at - stamps[first]) * 1e-9 for at in (begin, (begin + end) // 2, end)]
        before, middle, after = (interpolated(edge, t, sums) for edge in edges)
        span = np.maximum(edges[2] - edges[0], 1e-9)[:, None]
        felt = np.hstack([(after - before)[:, :3] / span, (after - 2.0 * middle + before)[:, 3:] * (2.0 / span) ** 2])
        felt[beyond, 3:] = 0.0
        lone = begin == end  # of a single sample
        felt[lone, :3] = self._at(stamps_ns[lone])[:, :3]
        return np.asarray((felt.reshape(-1, 2, 3) @ self._R_body_imu.T).reshape(-1, 6))

    @property
    def gravity_mps2(self) -> Array:
        """Gravity (3,) in world where it is felt."""
        return np.array([0.0, 0.0, -self._gravity_mps2])

    def bias_steps(self, from_ns: int, to_ns: int) -> Array:
        """Return the sigmas (6,) of how far the bias goes from one stamp to another: m/s^2, rad/s.

        By its random walk. Where nothing came for longer than `_SHORT_S` the IMU may have been off, or its driver may have started it
        anew: its turn-on bias is then another one. Not where samples came and were left out, nor in a pause of all sensors of some
        seconds, in which the recorder was slow.
        """
        c = self._config
        sigmas = np.array([c.accel_bias_walk_mps2] * 3 + [c.gyro_bias_walk_radps] * 3)
        walk = sigmas**2 * (to_ns - from_ns) * 1e-9 * self._noise_scale**2
        start, stop = self._silent.T
        share = float((np.maximum(np.minimum(to_ns, stop) - np.maximum(from_ns, start), 0) / (stop - start)).sum())
        return np.sqrt(walk + share * (_ANEW * self.bias_sigmas()) ** 2)

    def bias_sigmas(self) -> Array:
        """Return the turn-on sigmas (6,) of the bias: m/s^2, rad/s."""
        c = self._config
        return np.array([c.accel_bias_sigma_mps2] * 3 + [c.gyro_bias_sigma_radps] * 3)

    def gaps(self) -> list[tuple[int, int]]:
        """Return the gaps in the data, (start, stop) in ns."""
        wide = np.flatnonzero(np.diff(self._stamps) > self._max_gap_ns)
        found = {(int(self._stamps[i]), int(self._stamps[i + 1])) for i in wide}
        return sorted(found | {self._around(*gap) for gap in self._left_out} | set(self._pauses))


def _squared(v: Array) -> Array:
    """Return the covariance (3, 3) of an error that is v (3,) or zero, where the direction of v is known to `_ASKEW_RAD`."""
    return np.asarray(np.outer(v, v) + _ASKEW_RAD**2 * float(v @ v) * np.eye(3))


def _sinh_share(t: Array, length: float) -> Array:
    """Return sinh(t) / sinh(length) for 0 <= t <= length, without overflow."""
    return np.asarray((np.exp(t - length) - np.exp(-t - length)) / (1.0 - np.exp(-2.0 * length)))


class ImuRow:
    """Row of the inertial sensor."""

    kind = "imu"
    config = ImuConfig

    def link(
        self, imu: ImuSeries, config: ImuConfig, R_body_imu: Array, gravity_mps2: float, noise_scale: float = 1.0
    ) -> Links:
        """Return the links of one IMU."""
        return Links(imu, config, R_body_imu, gravity_mps2, noise_scale)


ROW = ImuRow()
