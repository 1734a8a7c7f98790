"""The encoder and the IC iteration without torch, for one cloud on the CPU: what ``encoder`` and ``solver`` compute.

Same equations, same schedule, same answer; arrays are numpy's.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.feature_metric.layers import Layers
from fmr_cli.geometry.motion import exp
from fmr_cli.io.weights import read_weights

MAX_STEP = 1.0  # rad, and units of the normalised cloud
SCALES = tuple(np.geomspace(6.0, 1.5, 10).tolist())  # of the robust regression, times the median |r - J dtheta|
STOP_STEP = 1e-7  # the float32 noise floor of a normalised cloud's feature
RANK_TOLERANCE = 1e-9  # of the largest eigenvalue of JᵀJ
CHUNK = 256  # points; their activation of CHUNK x K stays in cache
ROUNDING = 1e-6  # of a feature
# Of a large source, first a few points; then those that do better in some channel; at the end all.
LARGE, FEW = 4096, 1024
NEAR, CLOSE = 0.02, 1e-4  # rad, and units of the normalised cloud: steps that leave most channels, or all, as they are
LAST = 5  # iterations, at least, with all points that matter
MARGIN = 4e-4  # of a channel: points this near to winning it are evaluated too
STEEPEST = 2.0  # times the steepest critical point of a target: no channel changes faster with its point (measured)
MISSED = 1e-2  # of the mean |r|: what the channels may gain by points left out
MORE = 2  # iterations where they gain more

Run = Callable[[Callable, Iterable], Iterable]


@dataclass
class Template:
    """What the solver keeps of the target P. feature: (K,) float32; J: (K, 6) float64.

    seen: (6, 6) float64, the projector onto the directions that JᵀJ sees; no step leaves them.
    """

    feature: np.ndarray
    J: np.ndarray
    seen: np.ndarray

    @property
    def rank(self) -> int:
        """Of JᵀJ."""
        return round(float(np.trace(self.seen)))


@dataclass
class Solution:
    """g: (S, 4, 4) float64; errors: (iterations + 1, S) mean |r| before each iteration and after the last.

    A rank under 6 says that the target does not determine the pose (one point, a line): the undetermined directions
    are left where they were.
    """

    g: np.ndarray
    errors: np.ndarray
    rank: int

    @property
    def error(self) -> np.ndarray:
        """(S,) the last mean |r|."""
        return self.errors[-1]


@contextmanager
def spread(threads: int) -> Iterator[Run]:
    """A ``map`` over that many threads."""
    if threads == 1:
        yield map
        return
    with ThreadPoolExecutor(threads) as pool:
        yield pool.map


def jobs(starts: int, count: int) -> list[tuple[int, slice]]:
    """(start, part of the points) for each start and each part, always the same whatever the number of threads."""
    return [(start, slice(i, i + CHUNK)) for start in range(starts) for i in range(0, count, CHUNK)]


def few(points: np.ndarray) -> np.ndarray:
    """About FEW of the points, evenly from their order."""
    return points[:: max(len(points) // FEW, 1)]


class FastEncoder:
    """F and the solver on it, for one cloud on the CPU.

    threads: how many of Python's to spread the work over; it changes no bit of a result. BLAS is best kept to one.
    """

    def __init__(self, layers: Layers) -> None:
        self.layers = layers
        self._transposed = [np.ascontiguousarray(W.T) for W, _ in layers]
        self._own = threading.local()

    @classmethod
    def load(cls, path: Path | str) -> FastEncoder:
        """The encoder of a .safetensors file. Raises ModelError where it is missing or does not fit."""
        return cls(read_weights(path).layers)

    def __call__(self, points: np.ndarray, threads: int = 1) -> np.ndarray:
        """F: (N, 3) -> (K,)."""
        return self.encode(points, threads)[0]

    def encode(self, points: np.ndarray, threads: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """F and the critical points: (N, 3) -> feature (K,), index (K,) of the point that set each channel."""
        with spread(threads) as run:
            feature, index = self.peaks(points.astype(np.float32), np.eye(4)[None], run)
        return feature[0], index[0]

    def posed(self, g: np.ndarray) -> Layers:
        """The layers for points moved by g (4, 4), all but the last transposed, with biases that ``values`` adds late.

        relu(z + b) = max(z, -b) + b, and the b goes through the next layer's matrix into its bias: one pass over an
        activation in place of two, and none to move the points.
        """
        W, b = self.layers[0]
        shift = W @ g[:3, 3] + b
        layers = [((W @ g[:3, :3]).T.astype(np.float32), shift.astype(np.float32))]
        for (W, b), transposed in zip(self.layers[1:], self._transposed[1:], strict=True):
            shift = W @ shift + b
            layers.append((transposed, shift.astype(np.float32)))
        return [*layers[:-1], (self.layers[-1][0], layers[-1][1])]

    def values(self, points: np.ndarray, layers: Layers) -> np.ndarray:
        """f of every point but for the last bias: (n, 3) float32, n up to CHUNK, ``posed`` layers -> (K, n).

        In this thread's own memory, good until its next call: the pages of a fresh array cost as much as the product.
        """
        if not hasattr(self._own, "room"):
            self._own.room = [np.empty(CHUNK * len(b), np.float32) for _, b in self.layers]
            self._own.reached = np.empty(self._own.room[-1].shape, bool)
        *room, last = (
            x[: len(points) * len(b)].reshape(len(points), -1) for x, (_, b) in zip(self._own.room, layers, strict=True)
        )
        x = points
        for (W, b), out in zip(layers[:-1], room, strict=True):
            np.matmul(x, W, out=out)
            x = np.maximum(out, -b, out=out)
        return np.matmul(layers[-1][0], x.T, out=last.reshape(-1, len(points)))

    def peaks(self, points: np.ndarray, g: np.ndarray, run: Run) -> tuple[np.ndarray, np.ndarray]:
        """F of the points (N, 3) float32 moved by each g (S, 4, 4), and its critical points: (S, K), (S, K)."""
        posed = [self.posed(T) for T in g]
        channels = np.arange(len(self.layers[-1][1]))

        def part(job: tuple[int, slice]) -> tuple[np.ndarray, np.ndarray]:
            values = self.values(points[job[1]], posed[job[0]])
            index = values.argmax(1)
            return values[channels, index], index + job[1].start

        parts = list(run(part, jobs(len(g), len(points))))
        value, index = (np.array(x).reshape(len(g), -1, len(channels)) for x in zip(*parts, strict=True))
        best = value.argmax(1)[:, None]
        value, index = (np.take_along_axis(x, best, 1)[:, 0] for x in (value, index))
        return value + np.array([layers[-1][1] for layers in posed]), index

    def contenders(
        self, points: np.ndarray, g: np.ndarray, floor: np.ndarray, run: Run
    ) -> tuple[np.ndarray, np.ndarray]:
        """F of the points (N, 3) float32 moved by g (4, 4), and the indices of those that reach ``floor`` (K,).

        One channel is enough; where the floor is F of some of the points, F depends on no others.
        """
        layers = self.posed(g)
        above, channels = (floor - layers[-1][1] - ROUNDING)[:, None], np.arange(len(floor))

        def part(job: tuple[int, slice]) -> tuple[np.ndarray, np.ndarray]:
            values = self.values(points[job[1]], layers)
            best = values[channels, values.argmax(1)]  # three times as fast as max
            reached = np.greater_equal(values, above, out=self._own.reached[: values.size].reshape(values.shape))
            return best, np.logical_or.reduce(reached, 0)

        best, reached = zip(*run(part, jobs(1, len(points))), strict=True)
        return np.max(best, 0) + layers[-1][1], np.concatenate(reached).nonzero()[0]

    def template(self, target: np.ndarray, threads: int = 1) -> Template:
        """F(P) and its exact Jacobian, from the critical points: target (N, 3)."""
        feature, index = self.encode(target, threads)
        J = self.jacobian(target, index).astype(np.float64)
        eigenvalues, V = np.linalg.eigh(J.T @ J)
        V = V[:, eigenvalues > RANK_TOLERANCE * max(eigenvalues[-1], 1e-30)]
        return Template(feature, J, V @ V.T)

    def jacobian(self, points: np.ndarray, index: np.ndarray, g: np.ndarray | None = None) -> np.ndarray:
        """J of F(exp(-xi) P) at xi = 0, P the points (N, 3) moved by g (4, 4): index (K,) -> (K, 6) float32."""
        critical, back = np.unique(index, return_inverse=True)  # a point that sets many channels passes once
        p = points[critical] if g is None else transform_points(g, points[critical])
        x, on = p.astype(np.float32), []
        for W, b in self.layers[:-1]:
            x = x @ W.T + b
            on.append((x > 0)[back])
            x = np.maximum(x, 0)
        row = chain(self.layers, on)
        return -np.concatenate([np.cross(p[back].astype(np.float32), row), row], 1)

    def solve(
        self,
        template: Template,
        source: np.ndarray,
        g: np.ndarray,
        iterations: int = 10,
        robust: bool = True,
        basis: np.ndarray | None = None,
        threads: int = 1,
    ) -> Solution:
        """Iterate from each g (S, 4, 4) on source (N, 3).

        basis: (6, d) orthonormal twists that the motion may use; None for all six. Stops early once no step of any
        start exceeds ``STOP_STEP``. From one start, of a large source: see ``solve_large``.
        """
        source, g = source.astype(np.float32), g.astype(np.float64)
        with spread(threads) as run:
            if len(g) == 1 and len(source) >= LARGE:
                return self.solve_large(template, source, g, iterations, robust, basis, run)
            errors = []
            for _ in range(iterations):
                feature, index = self.peaks(source, g, run)
                r = feature - template.feature
                errors.append(np.abs(r).mean(-1))
                step = self.step(template, r, source, index, g, robust, basis)
                g = exp(step) @ g
                if np.abs(step).max() < STOP_STEP:
                    break
            errors.append(np.abs(self.peaks(source, g, run)[0] - template.feature).mean(-1))
        return Solution(g, np.array(errors), template.rank)

    def step(
        self,
        template: Template,
        r: np.ndarray,
        source: np.ndarray,
        index: np.ndarray,
        g: np.ndarray,
        robust: bool,
        basis: np.ndarray | None,
    ) -> np.ndarray:
        """dtheta (S, 6) at r (S, K); index (S, K): the critical points of the source (N, 3) moved by g (S, 4, 4)."""
        if not robust:
            return weighted_step(template.J[None], np.ones_like(r), r, basis)
        J_source = np.array([self.jacobian(source, i, T) for i, T in zip(index, g, strict=True)])
        J = (template.J + J_source @ template.seen) / 2
        return weighted_step(J, robust_weight(J, r, basis), r, basis)

    def solve_large(
        self,
        template: Template,
        source: np.ndarray,
        g: np.ndarray,
        iterations: int,
        robust: bool,
        basis: np.ndarray | None,
        run: Run,
    ) -> Solution:
        """``solve`` from one start, evaluating only points that can win a channel.

        At first these are few, spread over the source; once a step is small, those of all points that do better than
        the few in some channel; once it is very small, those within MARGIN of winning, which holds until the points
        have moved too far. Where it does not hold at the end, all points are looked at, and if some were missed, it
        goes on with them for at least MORE iterations. The last error is that of all points.
        """
        corners = np.array(list(itertools.product(*np.stack([source.min(0), source.max(0)], 1))))
        slope = STEEPEST * np.linalg.norm(template.J[:, 3:], axis=1).max()
        allowed = MARGIN / max(2 * slope, 1e-12)  # motion, before a point that was left out could win
        active, near, seen, missed = few(source), False, None, np.inf
        errors, iteration, end, size = [], 0, iterations, np.inf
        while True:
            feature, critical = (x[0] for x in self.peaks(active, g, run))
            finished = iteration >= end or size < STOP_STEP
            far = (
                np.inf
                if seen is None
                else np.linalg.norm(corners @ (g - seen)[0, :3, :3].T + (g - seen)[0, :3, 3], axis=1).max()
            )
            close = finished or (near and size < CLOSE)
            if (close and far > allowed) or (not near and (size < NEAR or iteration >= iterations - LAST)):
                whole, index = self.contenders(source, g[0], feature - MARGIN * close, run)
                missed = float(np.mean(whole - feature))
                active, feature, near, seen = source[index], whole, True, g if close else None
                if robust:  # whose step needs to know the points behind the feature
                    critical = self.peaks(active, g, run)[1][0]
            elif finished:
                missed = 0.0
            r = feature - template.feature
            errors.append(np.abs(r).mean())
            if finished:
                if missed <= MISSED * errors[-1] or end > iterations:
                    return Solution(g, np.array(errors)[:, None], template.rank)
                end = max(iterations, iteration + MORE)
            step = self.step(template, r[None], active, critical[None], g, robust, basis)
            g = exp(step) @ g
            iteration, size = iteration + 1, np.abs(step).max()


def chain(layers: Layers, on: list[np.ndarray]) -> np.ndarray:
    """Rows of the product W_n D_(n-1) W_(n-1) ... D_1 W_1, D the layers' 0/1 masks ``on`` (..., K, width): (..., K, 3).

    Row k of the last matrix goes with the masks of channel k's own point.
    """
    row = layers[-1][0]
    for (W, _), mask in zip(reversed(layers[:-1]), reversed(on), strict=True):
        row = (row * mask) @ W
    return row


def geman_mcclure(e: np.ndarray, factor: float) -> np.ndarray:
    """(s² / (s² + e²))² with s = factor times the median |e| of each row: (..., K) -> (..., K)."""
    middle = (e.shape[-1] - 1) // 2
    s2 = np.maximum((factor * np.partition(np.abs(e), middle)[..., middle, None]) ** 2, 1e-24)
    return (s2 / (s2 + e * e)) ** 2


def robust_weight(J: np.ndarray, r: np.ndarray, basis: np.ndarray | None) -> np.ndarray:
    """The channels' weights in the robust regression of r (S, K) on J (S, K, 6): (S, K).

    Of what a step leaves over, r - J dtheta, not of r: a channel that moves with the cloud is no outlier, however large
    its r. The scale falls (graduated non-convexity), so that the first step is nearly the least squares one.
    """
    weight = np.ones(r.shape)
    for factor in SCALES:
        dtheta = least_squares(J, weight, r, basis)
        weight = geman_mcclure(r - (J @ dtheta[..., None])[..., 0], factor)
    return weight


def least_squares(J: np.ndarray, weight: np.ndarray, r: np.ndarray, basis: np.ndarray | None) -> np.ndarray:
    """dtheta of (JᵀWJ) dtheta = JᵀW r: J (S or 1, K, 6) float64, weight and r (S, K) -> (S, 6) float64."""
    WJ = weight[..., None] * J
    A = np.swapaxes(WJ, -1, -2) @ J
    return constrained_step(A, (r[:, None].astype(np.float64) @ WJ)[:, 0], basis)


def weighted_step(J: np.ndarray, weight: np.ndarray, r: np.ndarray, basis: np.ndarray | None) -> np.ndarray:
    """``least_squares``, no longer than MAX_STEP."""
    return capped(least_squares(J, weight, r, basis), MAX_STEP)


def constrained_step(A: np.ndarray, b: np.ndarray, basis: np.ndarray | None) -> np.ndarray:
    """The step of A dtheta = b, (..., 6, 6) and (..., 6), within the span of basis (6, d).

    By eigenvectors: directions that A does not see get no step, rather than a huge one.
    """
    B = np.eye(6) if basis is None else basis
    eigenvalues, V = np.linalg.eigh(B.T @ A @ B)
    seen = eigenvalues > RANK_TOLERANCE * np.maximum(eigenvalues[..., -1:], 1e-30)
    inverse = np.where(seen, 1 / np.maximum(eigenvalues, 1e-30), 0.0)
    V = B @ V
    return (V @ (inverse[..., None] * (np.swapaxes(V, -1, -2) @ b[..., None])))[..., 0]


def capped(step: np.ndarray, size: float) -> np.ndarray:
    """The step (..., 6), shortened where its norm exceeds ``size``."""
    norm = np.linalg.norm(step, axis=-1, keepdims=True)
    return step * np.minimum(size / np.maximum(norm, 1e-30), 1.0)
