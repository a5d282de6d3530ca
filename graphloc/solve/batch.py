# SPDX-License-Identifier: Apache-2.0
"""The offline solver: align, grow, then decide over the whole run.

1. Align over a window; try each candidate heading on it and keep the cheapest (`alignment`, `_start`).
2. Grow the solved part by some seconds at a time. Each window is solved with a prior from earlier data; hypotheses that
   are new in it are judged by the prediction without them, with its covariance (`_grow`). Steps 1 and 2 use a thinned
   run (`graphloc.build.thinned`). Passes over all of it then remove the seams between windows, at a fifth of the cost.
3. Pass over the whole run, re-choosing modes and weights, until they no longer change (`_passes`).
4. Try other choices that may be more probable (`_choices`), and repeat 3 where one is. Repeat 1 to 4 with position
   jumps of the only position sensor, where the solution shows some (`_jumps`), and without the first fixes after an
   outage, where these bend the track (`_returns`). Repeat 3 with the IMU's mount turned, where it is clearly off
   (`imu_mount`).
5. Where receivers jump and no other sensor measures position, choose the most probable level (`_levels`).
6. Compute the covariances of every state from the last graph (`_marginals`).

Where no sensor measures position or velocity for a while, 3 to 6 include the motion model (`graphloc.motion_model`).
Where sensors scatter more than they state, 3 and 4 are repeated with the scatter as their noise. Where the IMU
contradicts the other sensors, or a sensor of heading or velocity disagrees for long, 1 to 4 are tried without such a
sensor, and repeated with all sensors from that solution. Where the IMU still contradicts the others, its noise is
scaled up, and 3 and 4 are repeated, beginning with gentle losses. If that explains little, the IMU is not to blame, and
its noise stays as configured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from graphloc.build import Problem, StartPrior, bridged, thinned, with_imu_scaled, with_noise_scale, with_sensor_noise
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.judge.bias_walk import BiasWanders, with_needed_walk
from graphloc.judge.decide import Stage, Verdicts
from graphloc.judge.imu_noise import CONTRADICTION, LEAST_TIMES, noise_step, scattered, with_needed_noise
from graphloc.judge.sensor_noise import scattering
from graphloc.recording import Progress, quiet
from graphloc.solve._final_passes import LAST_PASSES, MAX_SENSOR_ROUNDS, SolvedRun, as_they_scatter
from graphloc.solve._first_solution import first_solution
from graphloc.solve._jumps import jumps_in, with_jumps_of, with_jumps_off_track
from graphloc.solve._levels import at_usual_level
from graphloc.solve._marginals import marginals
from graphloc.solve._passes import cost_of_run, cost_without_outliers, rough_passes
from graphloc.solve._returns import doubtful_returns
from graphloc.solve._start import Begun
from graphloc.solve.imu_mount import MountError, with_mount_estimated

_MAX_NOISE_ROUNDS, _MAX_JUMP_ROUNDS, _MAX_WALK_ROUNDS = 4, 2, 3
# Nats by which each jump must make a run more probable. To say at which of a thousand fixes it is, and to which of a
# hundred places along each of two axes it leads, takes 16. In 25 of 27 runs with jumps each gave over 30; between high
# houses, where fixes wander, 15 to 20.
_OF_A_JUMP = 25.0
_OPEN_PASSES = 4  # most passes with each gentle loss, after the IMU's noise has changed
# More noise of the IMU explains a misfit if that falls below what counts as a contradiction, or by this factor.
_EXPLAINED = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchResult:
    """The solved graph, before it is turned into a `Solution`.

    Attributes:
        problem: with the noise that it was solved with. stated: with the noise as configured.
        values, verdicts: the solution. cov: of each key. graph: of the last step.
        passes, iterations: number of those that it took.
        cost: twice the graph's cost, without outliers: a chi-square where the model holds.
        converged: whether the last pass hardly changed the solution. noise_scale: factor on the IMU's configured noise.
        prior: on the first state.
        headings: number of candidate headings that explain the start about equally well; 0: nothing tells the heading
            there.
        heading_var: (N,) rad^2 to add to the heading of each state, as the motion does not exclude other headings (see
            `_start`).
        begun: last state of the first window: `heading_var` knows nothing of later data.
        levels_cov: (N, 3, 3) m^2 to add to the positions, as other levels may be the usual ones (see `_levels`).
        mount: how far the IMU is off its mount (see `imu_mount`); None: not estimated for this graph.
        notes: what the alignment at the start is based on.
    """

    problem: Problem
    stated: Problem
    values: gtsam.Values
    verdicts: Verdicts
    cov: dict[int, Array]
    graph: gtsam.NonlinearFactorGraph
    passes: int
    iterations: int
    cost: float
    converged: bool
    noise_scale: float
    prior: StartPrior
    headings: int
    heading_var: Array
    begun: int
    levels_cov: Array
    mount: MountError | None
    notes: tuple[str, ...]

    def lightened(self) -> BatchResult:
        """Return the result without the graph, which takes gigabytes on a run of hours."""
        return replace(self, graph=gtsam.NonlinearFactorGraph())


def solve_batch(
    problem: Problem,
    progress: Progress = quiet,
    *,
    newest: bool = False,
    doubt_imu: bool = False,
    near_rad: float | None = None,
    doubt_returns: bool = True,
) -> BatchResult:
    """Solve a whole run.

    Args:
        newest: whether only the last state is of interest, as for a start of the online mode: `heading_var` is then
            that of the last state, and jumps, returns after outages and the IMU's mount are not looked for.
        doubt_imu: whether to look for spans in which the IMU is wrong. doubt_returns: whether to look for fixes after
            outages that lead the track astray.
        near_rad: yaw at the start, rad: the only candidate where the motion alone tells the heading; None: all are
            tried.

    Raises:
        ImuWrong: there are spans in which the IMU is wrong.
        SolveError: the run could not be started, or the linear algebra failed.
    """
    run = _Underway(problem, progress, newest=newest, doubt_imu=doubt_imu, near_rad=near_rad)
    run.raise_bias_walk()
    run.raise_noise_of_sensors()
    if not newest:
        run.take_jumps()
        if doubt_returns:
            run.leave_out_returns()
        run.estimate_mount()
    noisier = run.raise_imu_noise()
    if noisier is not None:
        stated = run.stated
        del run  # and its graph, before the next one is made
        again = solve_batch(noisier, progress, newest=newest, doubt_returns=False)
        return replace(again, stated=with_jumps_of(again.stated, stated))
    return run.at_usual_level()


class _Underway:
    """A run on its way through the steps of `solve_batch`, each of which may replace the solution by a better one.

    Nothing else refers to the solution: the graph of a run of hours takes gigabytes, and must be freed before the next
    one is made.

    Attributes:
        begun: the start that the solution was grown from. solved: the solution.
        passes, iterations: number of those that it took.
        mount: how far the IMU is off its mount by the solution; None: not estimated for this one.
    """

    def __init__(
        self, problem: Problem, progress: Progress, *, newest: bool, doubt_imu: bool, near_rad: float | None
    ) -> None:
        self._configured, self._progress, self._newest = problem, progress, newest
        self._solve = partial(first_solution, progress=progress, newest=newest, doubt_imu=doubt_imu, near_rad=near_rad)
        self._solve_first(self._shaken(problem))

    def _shaken(self, problem: Problem) -> Problem:
        """Return the problem with the noise that an IMU needs whose samples scatter more than configured.

        With too little of it, estimates of the biases are too sure, so that they seem to wander, or the IMU seems wrong.
        """
        config = problem.config.sensors[problem.imu.sensor]
        if (
            self._newest
            or not config.adapt_noise
            or (scattered(problem.imu, config, problem.noise_scale) < LEAST_TIMES).all()
        ):
            return problem
        try:
            begun, (tried, settled) = self._solve(problem, doubt_imu=False)
        except SolveError:
            return problem
        noisier = with_needed_noise(tried, settled.values, settled.verdicts, begun.prior)
        return problem if noisier is None else replace(noisier, usual_motion=None)

    def _solve_first(self, problem: Problem) -> None:
        """Solve a problem from its start, with more walk of the IMU's biases where they go farther than configured."""
        for _ in range(_MAX_WALK_ROUNDS):
            try:
                self._hold(*self._solve(problem))
                break
            except BiasWanders as wanders:
                problem = with_imu_scaled(problem, wanders.times)
        else:
            self._hold(*self._solve(problem, doubt_imu=False))
        self._problem = problem

    def _hold(self, begun: Begun, solved: SolvedRun, mount: MountError | None = None) -> None:
        """Hold a solution that was found from a start, with the passes and iterations that it took."""
        self.begun, self.solved, self.mount = begun, solved, mount
        self.passes, self.iterations = solved.settled.passes, begun.iterations + solved.settled.iterations

    def _go_on_with(self, solved: SolvedRun) -> None:
        """Hold a solution that was found from the one before."""
        self.solved, self.mount = solved, None
        self._count(solved.settled.passes, solved.settled.iterations)

    def _count(self, passes: int, iterations: int) -> None:
        """Add passes and iterations to those that the solution took."""
        self.passes, self.iterations = self.passes + passes, self.iterations + iterations

    @property
    def stated(self) -> Problem:
        """The problem as configured, with the position jumps that were found."""
        return with_jumps_of(self._problem, self._configured)

    def raise_bias_walk(self) -> None:
        """Solve the run anew where the biases of the IMU go farther than configured.

        Else the track is bent, and right hypotheses seem false.
        """
        for _ in range(_MAX_WALK_ROUNDS):
            problem, settled = self.solved
            if not problem.config.sensors[problem.imu.sensor].adapt_noise:
                return
            wandering = with_needed_walk(problem, settled.values, settled.verdicts, self.begun.prior)
            del settled  # and its graph, before the next one is made
            if wandering is None or not self._solved_anew(replace(wandering, usual_motion=None)):
                return

    def raise_noise_of_sensors(self) -> None:
        """Solve the run anew where sensors that scatter more than stated may have misled a start by the motion alone.

        Such a start bends all states to fixes whose stated sigma is too small, and the IMU would be blamed for the
        misfit.
        """
        for _ in range(MAX_SENSOR_ROUNDS):
            if not self.begun.start.by_motion or self.solved.misfit() < CONTRADICTION:
                return
            problem = self.solved.problem
            times = scattering(problem, self.solved.settled.verdicts, denied=True)
            if not times or not self._solved_anew(replace(with_sensor_noise(problem, times), usual_motion=None)):
                return

    def take_jumps(self) -> None:
        """Solve the run anew with the position jumps that its solution shows, as long as that is clearly likelier."""
        for _ in range(_MAX_JUMP_ROUNDS):
            jumping = with_jumps_off_track(self._problem, self.solved.settled.verdicts)
            if jumping is None:
                return
            cost = self._cost(self._problem)
            if not self._solved_anew(jumping, cost - _OF_A_JUMP * (jumps_in(jumping) - jumps_in(self._problem))):
                return

    def leave_out_returns(self) -> None:
        """Solve the run anew without the first fixes after outages, if that is clearly more probable.

        A receiver that jumps keeps all its fixes.
        """
        # With the noise that the sensors were found to have: else leaving fixes out would save the cost of their
        # scatter.
        whole, misfit = replace(self.solved.problem, usual_motion=None), self.solved.misfit()
        doubted = doubtful_returns(whole, self.solved.choice(), misfit)
        if doubted is None:
            return
        cost, times, before = self._cost(whole), max(misfit, 1.0), self._problem
        # Without those fixes the IMU's drift shows, which is no reason to doubt the IMU.
        self._solve = partial(self._solve, doubt_imu=False)
        if not self._solved_anew(doubted.left_out_of(whole), cost - times * doubted.price(whole)):
            return
        off = doubted.still_off(whole, self.solved.choice(), self._cost(self._problem))
        if off.each and self._solved_anew(off.left_out_of(whole), cost - times * off.price(whole)):
            self._configured = off.left_out_of(self._configured)
        else:
            del self.solved  # and its graph, before the next one is made
            self._solve_first(before)

    def _cost(self, problem: Problem) -> float:
        """Return the cost (nats) of the solution in a problem that has its states."""
        return cost_of_run(problem, self.solved.settled.values, self.begun.prior)

    def _solved_anew(self, other: Problem, lowest: float = np.inf) -> bool:
        """Solve another problem from its start; return whether that succeeded and cost less than `lowest` (nats).

        If not, the solution stays.
        """
        problem, begun, before = self._problem, self.begun, self.solved.choice()
        del self.solved  # and its graph, before the next one is made
        try:
            self._solve_first(other)
            if lowest == np.inf or self._cost(other) < lowest:
                return True
        except SolveError:
            pass  # the other problem cannot be solved
        self._problem = problem
        self._hold(begun, before.settled_again(begun.prior, self._progress))
        return False

    def estimate_mount(self) -> None:
        """Estimate the mount of the IMU, and turn it where the other sensors show that it is off."""
        before = self.solved.settled
        problem, settled, prior, mount = with_mount_estimated(
            *self.solved, self.begun.prior, self._progress, LAST_PASSES
        )
        if settled is not before:
            passes, iterations = before.passes + settled.passes, before.iterations + settled.iterations
            settled = replace(settled, passes=passes, iterations=iterations)
        self._hold(self.begun._replace(prior=prior), SolvedRun(problem, settled), mount)

    def raise_imu_noise(self) -> Problem | None:
        """Raise the noise of the IMU where the run needs it, round by round.

        If that explains little, the noise stays as configured.

        Returns:
            A problem with more noise, to be solved from its start, where the motion alone tells the heading: the
                smaller noise may have excluded headings wrongly. Else None.
        """
        as_stated, misfit = self.solved.choice(), self.solved.misfit()
        left = misfit
        for _ in range(_MAX_NOISE_ROUNDS):
            contradicted = left >= CONTRADICTION
            noisier = self._with_noisier_imu(contradicted=contradicted)
            if noisier is None:
                break
            if self.begun.start.by_motion and not contradicted:
                return replace(noisier, usual_motion=None)
            self._settle_with(noisier, gently=contradicted)
            left = self.solved.misfit()
        scaled = self.solved.problem.noise_scale > as_stated.problem.noise_scale
        if scaled and CONTRADICTION <= left and misfit < _EXPLAINED * left:
            del self.solved  # and its graph, before the next one is made
            self._go_on_with(as_stated.settled_again(self.begun.prior, self._progress))
        return None

    def _with_noisier_imu(self, *, contradicted: bool) -> Problem | None:
        """Return the problem with more noise of the IMU, or None.

        None where it needs none, or where it is not to be adapted (`adapt_noise`).

        Args:
            contradicted: whether the IMU contradicts the other sensors: all its noise is then scaled by their misfit.
                If not, the gyroscopes' and the accelerometers' are raised to what their residuals need.
        """
        problem, settled = self.solved
        if not problem.config.sensors[problem.imu.sensor].adapt_noise:
            return None
        if contradicted:
            return with_noise_scale(problem, problem.noise_scale * noise_step(self.solved.misfit()))
        return with_needed_noise(problem, settled.values, settled.verdicts, self.begun.prior)

    def _settle_with(self, noisier: Problem, *, gently: bool) -> None:
        """Settle the solution with other noise of the IMU; `gently`: with gentle losses first."""
        estimate, prior = self.solved.settled.values, self.begun.prior
        problem = bridged(noisier, estimate)
        if gently:
            gentle = Stage.FAR, Stage.OPEN
            estimate, used, passed = rough_passes(problem, estimate, prior, self._progress, gentle, _OPEN_PASSES)
            self._count(passed, used)
        del self.solved  # and its graph, before the next one is made
        self._go_on_with(as_they_scatter(problem, thinned(problem), estimate, prior, self._progress))

    def at_usual_level(self) -> BatchResult:
        """Return the result, with the most probable level of receivers that jump as the usual one."""
        found = at_usual_level(*self.solved, self.begun.prior, self._progress, LAST_PASSES, newest=self._newest)
        self._count(found.passes, found.iterations)
        problem, settled, begun = found.problem, found.settled, self.begun
        return BatchResult(
            problem=problem,
            stated=self.stated,
            values=settled.values,
            verdicts=settled.verdicts,
            cov=marginals(settled.graph, settled.values).cov,
            graph=settled.graph,
            passes=self.passes,
            iterations=self.iterations,
            cost=cost_without_outliers(settled),
            converged=settled.converged,
            noise_scale=problem.noise_scale,
            prior=found.prior,
            heading_var=begun.heading_var,
            begun=begun.last,
            headings=begun.headings if begun.start.yaw_sigma_rad < np.pi else 0,
            levels_cov=found.others_cov,
            mount=self.mount if settled is self.solved.settled else None,
            notes=begun.start.notes,
        )
