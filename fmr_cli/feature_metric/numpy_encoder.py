"""The encoder F without torch, for one cloud on the CPU: what ``encoder.Encoder`` computes, several times as fast.

``python -m benchmarks.speed --only ic`` measures it. What makes it fast: activations that stay in cache, points moved
and biases added by the weights, memory that is used again, the argmax in place of the maximum; and of many points, only
those multiplied with a channel's weights that can win the channel, by a bound that is proven (``contest``).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.feature_metric.inverse_compositional import chain, pose_jacobian
from fmr_cli.feature_metric.layers import Layers, hidden
from fmr_cli.geometry.nearest import along_curve

CHUNK = 256  # points; their activation of CHUNK x K (1 MB at 1024 channels) stays in cache
MANY = 6144  # points: of fewer, it takes less time to multiply all with all weights
FEW = 512  # points, which are looked at first; 256 to 1,024 take the same time
# Of ``contest``'s bound. Fewer axes, or more points a block, cost less and leave more to multiply; with 24 axes, or 8
# points, it takes the same time (12,288 points of a room).
AXES, BLOCK = 16, 16
ROUNDING = 1e-6  # of a squared norm: what float32 leaves between two ways to compute it
CROWD = 32  # pairs a point of a part, at most: of copies of one point all would tie, in gigabytes
PAIRS = 512  # of a point and a channel, at once: the activations and weights of so many stay in cache

Run = Callable[[Callable[..., Any], Iterable[Any]], Iterable[Any]]


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


def spaced(count: int, few: int) -> np.ndarray:
    """About ``few`` of the numbers up to ``count``, evenly."""
    return np.arange(0, count, max(count // few, 1))


@dataclass
class Rivals:
    """The points that may win a channel, as T pairs of the two in order of the channels, at least one of each.

    index: (M,) of the points in their cloud; points: (M, 3) float32; point: (T,) of each pair, its place among these;
    channel: (T,) of each pair; first: (K,) pair of each channel; complete: whether none were too many to keep.
    """

    index: np.ndarray
    points: np.ndarray
    point: np.ndarray
    channel: np.ndarray
    first: np.ndarray
    complete: bool

    def winners(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the pairs' values (T,): each channel's largest (K,), and the index of its point in the cloud (K,)."""
        best = np.maximum.reduceat(value, self.first)
        pair = (value == best[self.channel]).nonzero()[0]
        pair = pair[np.searchsorted(self.channel[pair], np.arange(len(best)))]
        return best, self.index[self.point[pair]]


class NumpyEncoder:
    """F for one cloud on the CPU.

    threads: how many of Python's to spread the work over; it changes no bit of a result. BLAS is best kept to one.
    """

    def __init__(self, layers: Layers) -> None:
        self.layers = layers
        self._transposed = [np.ascontiguousarray(W.T) for W, _ in layers]
        self._own = threading.local()
        self._unmoved = self.posed(np.eye(4))

    def __call__(self, points: np.ndarray, threads: int = 1) -> np.ndarray:
        """F: (N, 3) -> (K,)."""
        return self.encode(points, threads)[0]

    def encode(self, points: np.ndarray, threads: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """F and the critical points: (N, 3) -> feature (K,), index (K,) of the point that set each channel."""
        points = points.astype(np.float32)
        with spread(threads) as run:
            if len(points) < MANY:
                return tuple(x[0] for x in self.peaks(points, [self._unmoved], run))

            order = along_curve(points)
            feature, index, _ = self.whole(points[order], self._unmoved, run)
        return feature, order[index]

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

    def last_hidden(self, points: np.ndarray, layers: Layers) -> np.ndarray:
        """What feeds the last layer, but for a constant: (n, 3) float32, n up to CHUNK, ``posed`` layers -> (n, width).

        In this thread's own memory, good until its next call: the pages of a fresh array cost as much as the product.
        """
        if not hasattr(self._own, "room"):
            self._own.room = [np.empty(CHUNK * len(b), np.float32) for _, b in self.layers]
        x = points
        for (W, b), room in zip(layers[:-1], self._own.room, strict=False):
            out = np.matmul(x, W, out=room[: len(points) * len(b)].reshape(len(points), -1))
            x = np.maximum(out, -b, out=out)
        return x

    def product(self, A: np.ndarray, B: np.ndarray) -> np.ndarray:
        """A B, of at most K x CHUNK numbers, in this thread's own memory as ``last_hidden``, which it runs after."""
        shape = len(A), B.shape[1]
        return np.matmul(A, B, out=self._own.room[-1][: shape[0] * shape[1]].reshape(shape))

    def peaks(self, points: np.ndarray, posed: list[Layers], run: Run) -> tuple[np.ndarray, np.ndarray]:
        """F of the points (N, 3) float32 by each of S ``posed`` layers, and its critical points: (S, K), (S, K)."""
        channels = np.arange(len(self.layers[-1][1]))

        def part(job: tuple[int, slice]) -> tuple[np.ndarray, np.ndarray]:
            layers = posed[job[0]]
            values = self.product(layers[-1][0], self.last_hidden(points[job[1]], layers).T)
            index = values.argmax(1)
            return values[channels, index], index + job[1].start

        parts = list(run(part, jobs(len(posed), len(points))))
        value, index = (np.array(x).reshape(len(posed), -1, len(channels)) for x in zip(*parts, strict=True))
        best = value.argmax(1)[:, None]
        value, index = (np.take_along_axis(x, best, 1)[:, 0] for x in (value, index))
        return value + np.array([layers[-1][1] for layers in posed]), index

    def whole(self, points: np.ndarray, posed: Layers, run: Run) -> tuple[np.ndarray, np.ndarray, Rivals]:
        """``contest`` of all points with FEW of them, spread evenly over their order."""
        few = spaced(len(points), FEW)
        feature, index = (x[0] for x in self.peaks(points[few], [posed], run))
        return self.contest(points, posed, feature, few[index], 0.0, run)

    def contest(
        self, points: np.ndarray, posed: Layers, feature: np.ndarray, index: np.ndarray, margin: float, run: Run
    ) -> tuple[np.ndarray, np.ndarray, Rivals]:
        """F (K,) of all points (N, 3) float32 by ``posed`` layers, its critical points (K,), and their rivals.

        feature, index: (K,) each, the same of some of the points. Rivals are these, and all that exceed their feature
        less the margin; where those crowd (one stray point makes the rest of a cloud small), the best of each part. A
        part of the points is multiplied with a channel's weights w only if it can hold one, by a bound on its blocks,
        which are small where the points are in ``along_curve``'s order: with x = A z + e what feeds the last layer, A
        a few orthonormal axes, e across them, and z within c ± h,

            w · x = (Aᵀw) · z + (w - AAᵀw) · e ≤ (Aᵀw) · c + |Aᵀw| · h + ‖w - AAᵀw‖ max ‖e‖
        """
        W, b = posed[-1]
        some = self.last_hidden(points[spaced(len(points), 2 * AXES)], posed)
        axes = np.linalg.svd(some, full_matrices=False)[2][:AXES].T
        along = W @ axes
        across = np.linalg.norm(W - along @ axes.T, axis=1, keepdims=True)
        bounds = np.concatenate([along, np.abs(along), across], 1).T.copy()
        above, channels = feature - b - np.float32(margin), np.arange(len(b))

        def part(job: tuple[int, slice]) -> tuple[np.ndarray, ...]:
            x = self.last_hidden(points[job[1]], posed)
            z, square, blocks = x @ axes, np.einsum("ij,ij->i", x, x), np.arange(0, len(x), BLOCK)
            e = np.sqrt(np.maximum(square - np.einsum("ij,ij->i", z, z), 0) + ROUNDING * square)
            low, high, e = (f.reduceat(y, blocks) for f, y in ((np.minimum, z), (np.maximum, z), (np.maximum, e)))
            bound = self.product(np.concatenate([(low + high) / 2, (high - low) / 2, e[:, None]], 1), bounds)
            able = (bound.max(0) > above).nonzero()[0]
            values = self.product(W[able], x.T)
            reached = values > above[able, None]
            crowded = np.count_nonzero(reached) > CROWD * len(x)
            pair = np.arange(0, values.size, len(x)) + values.argmax(1) if crowded else np.flatnonzero(reached)
            which, point = np.divmod(pair, len(x))
            return point + job[1].start, able[which], values.reshape(-1)[pair], np.array([crowded])

        parts = [(index, channels, feature - b, np.array([False])), *run(part, jobs(1, len(points)))]
        point, channel, value, crowded = (np.concatenate(x) for x in zip(*parts, strict=True))
        order = np.argsort(channel, kind="stable")
        seen, point = np.unique(point[order], return_inverse=True)
        first = np.searchsorted(channel[order], channels)
        rivals = Rivals(seen, points[seen], point, channel[order], first, not crowded.any())
        best, critical = rivals.winners(value[order])
        return best + b, critical, rivals

    def among(self, rivals: Rivals, posed: Layers, run: Run) -> tuple[np.ndarray, np.ndarray]:
        """F of the rivals alone by ``posed`` layers, each in its own channels, and its critical points: (K,), (K,)."""
        W, b = posed[-1]

        def hidden_part(job: tuple[int, slice]) -> np.ndarray:
            return self.last_hidden(rivals.points[job[1]], posed).copy()

        def part(start: int) -> np.ndarray:
            pairs = slice(start, start + PAIRS)
            return np.einsum("ij,ij->i", x[rivals.point[pairs]], W[rivals.channel[pairs]])

        x = np.concatenate(list(run(hidden_part, jobs(1, len(rivals.points)))))
        best, critical = rivals.winners(np.concatenate(list(run(part, range(0, len(rivals.point), PAIRS)))))
        return best + b, critical

    def jacobian(self, points: np.ndarray, index: np.ndarray, g: np.ndarray | None = None) -> np.ndarray:
        """J of F(exp(-xi) P) at xi = 0, P the points (N, 3) moved by g (4, 4): index (K,) -> (K, 6) float32."""
        critical, back = np.unique(index, return_inverse=True)  # a point that sets many channels passes once
        p = points[critical] if g is None else transform_points(g, points[critical])
        on = [mask[back] for mask in hidden(self.layers, p.astype(np.float32))[1]]
        gradient = chain([W for W, _ in self.layers], on)
        return pose_jacobian(p[back].astype(np.float32), gradient)
