# SPDX-License-Identifier: Apache-2.0
"""Does the heading fit the motion? The accelerations, rotated by the estimate, must move the antenna as its fixes do.

The last 40 s are fitted, with horizontal vectors as complex numbers, east + i north:

    place(t) = a + b t + c t^2 + d t^3 + f ahead2(t) + g ahead3(t) + h ahead(t) + rho reckoned(t)

- place: of the antenna, by its fixes; it has a step where these jump.
- reckoned: place by dead reckoning: the specific force in axes propagated by the gyroscope, integrated twice, plus the
  lever arm.
- ahead: exp(i yaw). ahead2, ahead3: ahead integrated twice and three times.
- a, b: position and velocity. c, d: gravity, by a tilt that is wrong or changes.
- f, g: biases of the accelerometer and the gyroscope. Their priors are about 0, not about the estimated biases, which
  are wrong too where the heading is.
- h: by how much the antenna is off its mount; only while the heading is a guess, which bends the estimate of that.
- rho: 1 with the right heading; exp(-i e) with a heading that is off by e.

So a compass with a wrong mount or convention is told from a vessel that moves astern, sideways or with a current: there
the accelerations fit the motion. The course over ground cannot tell these apart.

Two other causes of a wrong rho are tried before anything is reported. A gyroscope bias of 0.02 rad/s about the vertical
turns `reckoned` by 0.8 rad in 40 s, so the fit is repeated with the estimated bias taken off. Late fixes turn `place`
while the vessel turns, so where their stamps may be off (`stamp_sigma_s`), the fit is repeated with a term in the
velocity of `reckoned`.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import gtsam
import numpy as np

from graphloc.frames import Array
from graphloc.judge.covariances import world_covariance
from graphloc.measurements import Measurement
from graphloc.online._lag import Lag
from graphloc.online._states import Newest
from graphloc.signals.position_jumps import position_jumps
from graphloc.time import stamps_of
from graphloc.trajectory import bounds_95

# Length of the data, and time between checks; choices. In 40 s most vessels turn or change their speed; over a longer
# time, biases bend the dead reckoning by more.
_WINDOW_S, _EVERY_S = 40.0, 5.0
_LONGEST_STEP_S = 1.0  # of the IMU; in a longer gap the accelerations are unknown
# An error is reported from this size on, where the 95 % bound is smaller
_TURNED_RAD, _KNOWN_DEG = np.radians(20.0), 20.0
_SIGMAS = 3.0  # sigmas of the check itself that a reported error must exceed, too
_SIZE, _SURE = (0.7, 1.4), 0.2  # range of |rho|, which is near 1 unless fixes jump; largest sigma of rho
# rho tells the heading if it is more sigmas than this from 0, and |rho| exceeds 1 by fewer (or by `_SIZE`)
_LIKELY = 2.5
_APART_S = 1.0  # correlation time of the errors of fixes, at least
_FEWEST = 15  # fixes, for up to 15 real unknowns of four terms, three biases, rho and a jump; a choice
_ENDS = slice(2, -2)  # fixes at which a jump would show
_IN_A_ROW = 2  # checks that must agree before the heading is called wrong, or right again
_LATE_S = 0.5  # 1 sigma of the delay of fixes whose stamps may be off: through a gateway they come a second late
_COMPLEX = np.array([1.0, 1j])  # makes a horizontal vector complex: east + i north
# 1 sigma of f, m/s^2, and of g, m/s^3: gravity times a gyroscope bias of 0.005 rad/s.
_BIASES = np.array([0.1, 9.8 * 0.005])


class _Step(NamedTuple):
    """The IMU integrated between two stamps, without gravity, in the body's axes at the first.

    Attributes:
        from_ns, until_ns: the stamps. dv, dp: (3,) change of velocity, m/s, and of position, m. dR: (3, 3) rotation.
    """

    from_ns: int
    until_ns: int
    dv: Array
    dp: Array
    dR: Array


class Fit(NamedTuple):
    """rho and its sigma."""

    rho: complex
    sigma: float


class _Fix(NamedTuple):
    """A fix: its sensor, place (2,) in world and its sigma, m."""

    stamp_ns: int
    sensor: str
    p_world_m: Array
    sigma_m: float


class HeadingCheck:
    """Compares the fixes of a receiver, of several that with the most, with the steps of the IMU.

    Attributes:
        said: what is wrong with the heading, in words; empty where nothing is known to be wrong.
        off_rad: error of the heading by the check; 0 while `said` is empty.
        looked_ns: stamp of the last check. within_rad: 1 sigma of the heading by that check alone, the error found
            included; infinite where the check told nothing.
    """

    def __init__(self) -> None:
        self.said, self.off_rad, self.within_rad = "", 0.0, np.inf
        self._steps: deque[_Step] = deque()
        self._fixes: dict[str, deque[_Fix]] = {}  # by receiver
        self.looked_ns, self._wrong, self._right, self._fits = 0, 0, 0, 0

    def begin(self) -> None:
        """Forget that earlier checks found the heading right: the estimate starts anew."""
        self._right = self._fits = 0
        self.within_rad = np.inf

    def put_right(self) -> None:
        """Forget that the heading was wrong: the estimate started anew with the one that the motion tells."""
        self.said, self.off_rad, self._wrong = "", 0.0, 0

    @property
    def doubtful(self) -> bool:
        """Whether the last check found the heading wrong."""
        return self._wrong > 0

    @property
    def confirmed(self) -> bool:
        """Whether the last checks found the heading right."""
        return self._fits >= _IN_A_ROW

    def note(self, m: Measurement, lag: Lag) -> None:
        """Take in a position, if it is of an absolute sensor without hypotheses (GNSS) that is not frozen."""
        stream = lag.problem.streams.get(m.sensor)
        if stream is None or not stream.row.absolute or stream.row.has_hypotheses or stream.frozen_detector.frozen:
            return
        hint = stream.row.hint(m, 0.0, lag.problem.datum)
        if np.isfinite(hint.p_world_m[:2]).all():
            fix = _Fix(m.stamp_ns, m.sensor, hint.p_world_m[:2], float(hint.p_sigma_m[:2].max()))
            noted = self._fixes.setdefault(lag.problem.config.receiver_of(m.sensor), deque())
            if not noted or m.stamp_ns > noted[-1].stamp_ns:  # a restart takes the last ones in again
                noted.append(fix)

    def look(self, lag: Lag, *, guessed: bool = False) -> bool:
        """Integrate the IMU to the newest state and check the heading; return whether it is newly found to be wrong.

        Args:
            guessed: whether the heading is a guess, which bends the window's estimate of where the antenna is.
        """
        newest = lag.newest
        self._carry_on(lag, newest)
        since_ns = newest.stamp_ns - self.looked_ns
        if not self._steps or 0 <= since_ns < _EVERY_S * 1e9:  # less than 0: the clock was set back
            return False
        self.looked_ns, self.within_rad = newest.stamp_ns, np.inf
        fixes = self._most_fixes(lag)
        if not fixes:
            return False
        # The estimated bias is not taken off: a wrong heading bends it until it fits.
        fit = self._fit(lag, newest, fixes, np.zeros(3), any_place=guessed)
        self.within_rad = _within_rad(fit)
        found = _off(fit, guessed=guessed)
        if found is None:
            self._wrong = 0
            return False
        self._fits = self._fits + 1 if abs(found[0]) <= _TURNED_RAD else 0
        if _turned(*found):
            up = newest.pose.rotation().matrix()[2]
            drift = up * float(up @ lag.problem.R_body_imu @ newest.bias.gyroscope())
            for by, late in (
                (drift, False),
                *(((np.zeros(3), True), (drift, True)) if _may_be_late(lag, fixes[-1].sensor) else ()),
            ):
                told = _off(self._fit(lag, newest, fixes, by, late=late), guessed=guessed)
                if told is not None and not _turned(*told):
                    found = told
                    break
        known = (
            float(
                bounds_95(world_covariance(newest.pose_cov, newest.pose.rotation().matrix(), np.zeros(3))[None])[0, 2]
            )
            < _KNOWN_DEG
        )
        if known and _turned(*found):
            self._wrong, self._right = self._wrong + 1, 0
        else:
            self._wrong, self._right = 0, self._right + 1
        was = self.said
        if self._wrong >= _IN_A_ROW:
            self.off_rad = found[0]
            self.said = was or (
                f"the heading is off by about {np.degrees(self.off_rad):.0f} deg, by the IMU's accelerations and the fixes of {fixes[-1].sensor}: "
                "check what measures the heading (convention, mount), if anything does, and the IMU's axes"
            )
        elif self._right >= _IN_A_ROW:
            self.said, self.off_rad = "", 0.0
        return self.said != "" and not was

    def _carry_on(self, lag: Lag, newest: Newest) -> None:
        """Add the IMU's step since the last one; begin again after a gap, or when the clock was set back."""
        until_ns = newest.stamp_ns
        from_ns = self._steps[-1].until_ns if self._steps else lag.first_ns
        if until_ns == from_ns:
            return
        if not 0 < until_ns - from_ns < _LONGEST_STEP_S * 1e9:
            self._steps.clear()
            self._fixes.clear()
            from_ns = max(lag.first_ns, until_ns - round(_LONGEST_STEP_S * 1e8))
            if from_ns >= until_ns:
                return
        pim = lag.problem.links.integrate(from_ns, until_ns, gtsam.imuBias.ConstantBias())
        self._steps.append(
            _Step(from_ns, until_ns, np.array(pim.deltaVij()), np.array(pim.deltaPij()), pim.deltaRij().matrix())
        )
        begin_ns = until_ns - round(_WINDOW_S * 1e9)
        while self._steps[0].from_ns < begin_ns:
            self._steps.popleft()
        for noted in self._fixes.values():
            while noted and noted[0].stamp_ns < begin_ns:
                noted.popleft()

    def _most_fixes(self, lag: Lag) -> list[_Fix]:
        """Return the fixes of the window, of the receiver that has the most."""
        for receiver, noted in self._fixes.items():
            # That a fix is a repetition may turn out only after it was noted.
            self._fixes[receiver] = deque(
                fix
                for fix in noted
                if fix.sensor in lag.problem.streams
                and not lag.problem.streams[fix.sensor].receiver.repeated_fix.is_old(fix.stamp_ns, fix.p_world_m)
            )
        return list(max(self._fixes.values(), key=len, default=()))

    def _fit(
        self,
        lag: Lag,
        newest: Newest,
        noted: list[_Fix],
        drift_radps: Array,
        *,
        any_place: bool = False,
        late: bool = False,
    ) -> Fit | None:
        """Return the fit of rho; None where there are too few fixes, or the data are too short.

        Args:
            noted: fixes of one receiver.
            drift_radps: (3,) gyroscope bias to take off, body axes. any_place: whether to fit where the antenna is
                about its mount (h).
            late: whether to fit a delay of the fixes.
        """
        # A sensor of whole poses has no antenna.
        sensor = noted[-1].sensor
        place_m = getattr(lag.problem.streams[sensor].config, "mount_sigma_m", 0.0) if any_place else 0.0
        at_s, regressors = self._reckoned(lag, newest, sensor, drift_radps, place_m)
        prior_sigmas = np.append(_BIASES, [place_m] if place_m else [])
        if late:
            regressors = np.vstack([regressors, np.gradient(regressors[0], at_s)])
            prior_sigmas = np.append(prior_sigmas, _LATE_S)
        fixes = [fix for fix in noted if self._steps[0].until_ns <= fix.stamp_ns <= newest.stamp_ns]
        if at_s[-1] - at_s[0] < 0.9 * _WINDOW_S or len(fixes) < _FEWEST:
            return None
        stamps_ns = stamps_of(fixes)
        places_m = np.array([fix.p_world_m for fix in fixes])
        fix_s, place = (stamps_ns - newest.stamp_ns) * 1e-9, places_m @ _COMPLEX
        at_fixes = [np.interp(fix_s, at_s, row.real) + 1j * np.interp(fix_s, at_s, row.imag) for row in regressors]
        jumps_ns, _ = position_jumps(stamps_ns, places_m, np.array([fix.sigma_m for fix in fixes]), allowed_m=0.0)
        after_jump = (stamps_ns[:, None] >= jumps_ns).astype(float)
        nuisance = np.hstack([np.vander(1.0 + 2.0 * fix_s / _WINDOW_S, 4), after_jump])
        basis, _ = np.linalg.qr(nuisance[_ENDS])
        columns = np.column_stack([place, *at_fixes])[_ENDS]
        columns = columns - basis @ (basis.T @ columns)  # what neither the cubic nor steps explain
        observed, design = columns[:, 0], columns[:, 1:]
        residual = observed - design @ np.linalg.lstsq(design, observed, rcond=None)[0]
        independent = min(_WINDOW_S / _APART_S, _independent(residual))  # fixes closer together share their errors
        sigma_m = float(np.sqrt(np.mean(np.abs(residual) ** 2) * len(observed) / independent))
        return first_of(design, observed, sigma_m, prior_sigmas)

    def _reckoned(
        self, lag: Lag, newest: Newest, sensor: str, drift_radps: Array, place_m: float
    ) -> tuple[Array, Array]:
        """Dead-reckon the antenna of a sensor by the steps of the IMU, from rest.

        Args:
            drift_radps: as in `_fit`. place_m: how far from its mount the antenna may be, 1 sigma; 0: take it where the
                window has it.

        Returns:
            Times (N,), s, relative to the newest state; and (3 or 4, N) complex: reckoned, ahead2, ahead3 and, where
            `place_m` is not 0, ahead, in axes of world by the newest state's attitude.
        """
        lever_m = _mount_m(lag, sensor) if place_m else _lever_m(lag, sensor)
        # In the body's axes at the first step ("start"), without gravity.
        R_start_body, v_mps, p_m = np.eye(3), np.zeros(3), np.zeros(3)
        antenna_m, bow = [], []
        for step in self._steps:
            dt_s = (step.until_ns - step.from_ns) * 1e-9
            p_m, v_mps = p_m + v_mps * dt_s + R_start_body @ step.dp, v_mps + R_start_body @ step.dv
            R_start_body = R_start_body @ step.dR @ gtsam.Rot3.Expmap(-drift_radps * dt_s).matrix()
            antenna_m.append(p_m + R_start_body @ lever_m)
            bow.append(R_start_body[:, 0])
        R_world_start = newest.pose.rotation().matrix() @ R_start_body.T
        reckoned, ahead = (np.array(vectors) @ R_world_start[:2].T @ _COMPLEX for vectors in (antenna_m, bow))
        step_s = np.array([step.until_ns - step.from_ns for step in self._steps]) * 1e-9
        ahead_twice = np.cumsum(np.cumsum(ahead * step_s) * step_s)
        ahead_thrice = np.cumsum(ahead_twice * step_s)
        at_s = (np.array([step.until_ns for step in self._steps]) - newest.stamp_ns) * 1e-9
        return at_s, np.array([reckoned, ahead_twice, ahead_thrice, *([ahead] if place_m else [])])


def _independent(residual: Array) -> float:
    """Return how many of the residuals (N,), complex, count as independent, as of a first-order process.

    By a receiver that drifts, or an IMU that vibrates, whose noise is integrated twice, they last for seconds.
    """
    alike = float(np.real(residual[:-1].conj() @ residual[1:])) / max(float(np.sum(np.abs(residual) ** 2)), 1e-12)
    alike = min(max(alike, 0.0), 1.0 - 1.0 / len(residual))
    return len(residual) * (1.0 - alike) / (1.0 + alike)


def first_of(design: Array, observed: Array, sigma: float, prior_sigmas: Array) -> Fit | None:
    """Return the first of some unknowns by least squares; None if nothing shows it.

    By QR: on a vessel at rest the normal equations are so ill-conditioned that a variance can come out negative.

    Args:
        design, observed: (M, N), (M,) complex. sigma: of each row.
        prior_sigmas: (N - 1,) of the other unknowns, about zero; the first has no prior.
    """
    others = np.diag(1.0 / prior_sigmas).astype(complex)
    rows = np.vstack([design[:, 1:], sigma * others])
    q, r = np.linalg.qr(np.column_stack([rows, np.append(design[:, 0], np.zeros(len(others)))]))
    shown = abs(r[-1, -1])
    if not shown > 0.0:
        return None
    return Fit(complex(q[: len(observed), -1].conj() @ observed / r[-1, -1]), sigma / float(shown))


def _may_be_late(lag: Lag, sensor: str) -> bool:
    """Return whether the stamps of the fixes may be off; a sensor of whole poses has no such setting."""
    return float(getattr(lag.problem.streams[sensor].config, "stamp_sigma_s", 0.0)) > 0.0


def _mount_m(lag: Lag, receiver: str) -> Array:
    """Return where an antenna's mount is from the IMU (3,), m, body axes."""
    return np.asarray(lag.problem.streams[receiver].mount.translation())


def _lever_m(lag: Lag, receiver: str) -> Array:
    """Return where an antenna is from the IMU (3,), m, body axes, as the window estimates it."""
    return _mount_m(lag, receiver) + lag.antennas_off_m().get(receiver, np.zeros(3))


def _off(fit: Fit | None, *, guessed: bool) -> tuple[float, float] | None:
    """Return the error of the heading and its sigma (rad); None where the motion does not show it well.

    Args:
        guessed: whether the heading is a guess: then what tells more than the guess is enough.
    """
    if fit is None or not _SIZE[0] < abs(fit.rho) < _SIZE[1]:
        return None
    if fit.sigma > (abs(fit.rho) / _LIKELY if guessed else _SURE):
        return None
    return -float(np.angle(fit.rho)), fit.sigma / abs(fit.rho) if guessed else fit.sigma


def _within_rad(fit: Fit | None) -> float:
    """Return 1 sigma of the heading by a fit alone, the error found included; infinite where the fit tells nothing."""
    if fit is None or not _LIKELY * fit.sigma < abs(fit.rho) < 1.0 + max(_SIZE[1] - 1.0, _LIKELY * fit.sigma):
        return np.inf
    return float(np.hypot(np.angle(fit.rho), fit.sigma / abs(fit.rho)))


def _turned(off_rad: float, sigma_rad: float) -> bool:
    """Return whether an error of the heading is large, and larger than noise."""
    return bool(abs(off_rad) > max(_TURNED_RAD, _SIGMAS * sigma_rad))
