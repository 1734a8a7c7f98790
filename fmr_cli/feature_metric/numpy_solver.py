"""The IC solver without torch, for one pair on the CPU: ``inverse_compositional`` on ``numpy_encoder``.

Same equations, same answer as ``solver``. Of a large source it looks at few points only, which takes a loop of its own,
``solve_large``. That is what it is for: of 12,288 points and 10 of the paper's steps, the torch solver on two threads
took 0.26 s, ``iterate`` on this encoder 0.41 s on one, ``solve_large`` 0.11 s; by ``python -m benchmarks.speed --only
ic``.
"""

from __future__ import annotations

import itertools

import numpy as np

from fmr_cli.feature_metric.inverse_compositional import STOP_STEP, Solution, Template, iterate, make_template, step
from fmr_cli.feature_metric.numpy_encoder import FEW, NumpyEncoder, Run, spaced, spread
from fmr_cli.geometry.nearest import along_curve
from fmr_cli.geometry.se3 import exp

# Of a large source, at first a few points; then those that do better than a few in some channel; then all that may win.
LARGE = 4096  # points
NEAR, CLOSE = 0.02, 2e-3  # rad, and units of the normalised cloud: steps that leave most channels, or nearly all
LAST = 5  # iterations, at least, with all points that matter
# Of a channel: points this near to winning it are evaluated too. Of 32 solves of rooms and shapes, of 6,144 and 12,288
# points, four took a third look at all points; with 2e-3 five, with 4e-3 three, but then the last iterations take
# longer. With half of CLOSE two did, but all took a quarter of an iteration more: 4 % slower.
MARGIN = 3e-3
STEEPEST = 2.0  # times the steepest critical point of a target: no channel changes faster with its point (measured)
MISSED = 1e-2  # of the mean |r|: what the channels may gain by points left out
MORE = 2  # iterations where they gain more


class NumpySolver(NumpyEncoder):
    """The encoder, and the solver on it; a ``search.Solver``. threads: as for the encoder."""

    def template(self, target: np.ndarray, threads: int = 1) -> Template[np.ndarray]:
        """F(P) and its exact Jacobian, from the critical points: target (N, 3)."""
        feature, index = self.encode(target, threads)
        return make_template(feature, self.jacobian(target, index))

    def solve(
        self,
        template: Template[np.ndarray],
        source: np.ndarray,
        g: np.ndarray,
        iterations: int = 10,
        robust: bool = True,
        basis: np.ndarray | None = None,
        threads: int = 1,
    ) -> Solution[np.ndarray]:
        """Iterate from each g (S, 4, 4) on source (N, 3), see ``iterate``; of a large source from one start, see below.

        basis: (6, d) orthonormal twists that the motion may use; None for all six.
        """
        source, g = source.astype(np.float32), g.astype(np.float64)
        with spread(threads) as run:
            if len(g) == 1 and len(source) >= LARGE:
                return self.solve_large(template, source, g, iterations, robust, basis, run)

            return self.solve_all(template, source, g, iterations, robust, basis, run)

    def solve_all(
        self,
        template: Template[np.ndarray],
        source: np.ndarray,
        g: np.ndarray,
        iterations: int,
        robust: bool,
        basis: np.ndarray | None,
        run: Run,
    ) -> Solution[np.ndarray]:
        """``solve`` with all points in every iteration: source float32, g float64."""

        def look(g: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
            feature, index = self.peaks(source, [self.posed(T) for T in g], run)
            return feature, self.jacobians(source, index, g) if derivative else None

        return iterate(look, template, g, iterations, robust, basis)

    def jacobians(self, source: np.ndarray, index: np.ndarray, g: np.ndarray) -> np.ndarray:
        """J_gQ (S, K, 6) of the critical points index (S, K) of the source (N, 3) moved by each g (S, 4, 4)."""
        return np.array([self.jacobian(source, i, T) for i, T in zip(index, g, strict=True)])

    def solve_large(
        self,
        template: Template[np.ndarray],
        source: np.ndarray,
        g: np.ndarray,
        iterations: int,
        robust: bool,
        basis: np.ndarray | None,
        run: Run,
    ) -> Solution[np.ndarray]:
        """``solve`` from one start, evaluating only points that can win a channel.

        At first these are few, spread over the source; once a step is small, those of all points that do better than a
        few in some channel; once it is very small, those within MARGIN of winning, which holds until the points have
        moved too far. Where it does not hold at the end, all points are looked at, and if some were missed, it goes on
        with them for at least MORE iterations. The last error is that of all points.
        """
        source = source[along_curve(source)]
        corners = np.array(list(itertools.product(*np.stack([source.min(0), source.max(0)], 1), [1.0])))
        slope = STEEPEST * np.linalg.norm(template.J[:, 3:], axis=1).max()
        allowed = MARGIN / max(2 * slope, 1e-12)  # motion, before a point that was left out could win
        few = spaced(len(source), FEW)
        rivals, seen, missed = None, None, 0.0
        errors, iteration, end, size = [], 0, iterations, np.inf
        while True:
            posed = self.posed(g[0])
            finished = iteration >= end or size < STOP_STEP
            if rivals is not None:
                feature, critical = self.among(rivals, posed, run)
                missed = 0.0
                far = np.inf if seen is None else np.linalg.norm(corners @ (g - seen)[0, :3].T, axis=1).max()
                if far > allowed and (finished or size < CLOSE):
                    some = feature
                    feature, critical, rivals = self.contest(source, posed, some, critical, MARGIN, run)
                    seen = g
                    missed = float(np.mean(feature - some))
            elif finished or size < NEAR or iteration >= iterations - LAST:
                feature, critical, rivals = self.whole(source, posed, run)
            else:
                feature, critical = (x[0] for x in self.peaks(source[few], [posed], run))
                critical = few[critical]
            r = feature - template.feature
            errors.append(np.abs(r).mean())
            if finished:
                if missed <= MISSED * errors[-1] or end > iterations:
                    return Solution(g, np.array(errors)[:, None], template.rank)
                end = max(iterations, iteration + MORE)
            J_source = self.jacobians(source, critical[None], g) if robust else None
            dtheta = step(template, r[None], J_source, basis)
            g = exp(dtheta) @ g
            iteration, size = iteration + 1, np.abs(dtheta).max()
