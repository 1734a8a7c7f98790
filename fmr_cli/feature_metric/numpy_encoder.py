"""The encoder F without torch, for one cloud on the CPU: what ``encoder.Encoder`` computes, several times as fast.

``python -m benchmarks.speed --only ic`` measures it. What makes it fast: activations that stay in cache, points moved
and biases added by the weights, memory that is used again, the argmax in place of the maximum; and of many points, only
those multiplied with a channel's weights that can win the channel, by a bound that is proven (``contest``).
"""

from __future__ import annotations

import itertools
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
# Points of one of ``contest``'s jobs: their last hidden activation (0.5 MB) stays in cache. Threads wait for Python's
# lock between products: with four times as many of them, each shorter, two threads took longer than one.
PART = 1024
MANY = 6144  # points: of fewer, it takes less time to multiply all with all weights
FEW = 512  # points, which are looked at first; 256 to 1,024 take the same time
# Of ``contest``'s bound. Fewer axes, or more points a block, cost less and leave more to multiply: with 16 axes it
# takes 5 % longer, with 32, or 8 points, the same time (12,288 points of a room).
AXES, BLOCK = 24, 16
ROUNDING = 1e-6  # of a squared norm: what float32 leaves between two ways to compute it

Run = Callable[..., Iterable[Any]]  # as ``map``
Found = tuple[np.ndarray, np.ndarray, np.ndarray]  # channels (c,), the largest values in them, and of which points


@contextmanager
def spread(threads: int) -> Iterator[Run]:
    """A ``map`` over that many threads, the caller's among them: it need not wait for another to wake up."""
    if threads == 1:
        yield map
        return
    with ThreadPoolExecutor(threads - 1) as pool:

        def run(function: Callable[..., Any], *each: Iterable[Any]) -> list[Any]:
            todo, done = iter(list(enumerate(zip(*each, strict=False)))), {}

            def work() -> None:
                for number, arguments in todo:
                    done[number] = function(*arguments)

            others = [pool.submit(work) for _ in range(threads - 1)]
            work()
            for other in others:
                if not other.cancel():  # it never began, and nothing is left for it
                    other.result()
            return [done[number] for number in range(len(done))]

        yield run


def jobs(starts: int, count: int, size: int) -> list[tuple[int, slice]]:
    """(start, part of the points) for each start and each part, always the same whatever the number of threads."""
    return [(start, slice(i, i + size)) for start in range(starts) for i in range(0, count, size)]


def tops(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest of each row, and its place in it: (c, n) -> (c,), (c,)."""
    index = values.argmax(1)
    return values[np.arange(len(values)), index], index


def winners(found: list[Found], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Of ``count`` = K channels, the largest value that was found (K,), and the index of its point (K,)."""
    value, index = np.full((len(found), count), -np.inf, np.float32), np.zeros((len(found), count), np.intp)
    for row, (channels, top, point) in enumerate(found):
        value[row, channels], index[row, channels] = top, point
    best = value.argmax(0), np.arange(count)
    return value[best], index[best]


def left_over(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """How long, rounded up, what orthonormal axes leave of each x: (n, width), z (n, AXES) along them -> (n, 1)."""
    square, along = (np.einsum("ij,ij->i", y, y) for y in (x, z))
    return np.sqrt(np.maximum(square - along, 0) + ROUNDING * square)[:, None]


def spaced(count: int, few: int) -> np.ndarray:
    """About ``few`` of the numbers up to ``count``, evenly."""
    return np.arange(0, count, max(count // few, 1))


@dataclass
class Rivals:
    """Of a part of a cloud: the points that may win a channel, and the channels that one of them may win.

    index: (n,) of the points in the cloud; points: (n, 3) float32; channels: (c,).
    """

    index: np.ndarray
    points: np.ndarray
    channels: np.ndarray


class NumpyEncoder:
    """F for one cloud on the CPU.

    threads: how many of Python's to spread the work on MANY points over; it changes no bit of a result, and on fewer
    costs more than it saves. BLAS is best kept to one.
    """

    def __init__(self, layers: Layers) -> None:
        self.layers = layers
        self._transposed = [np.ascontiguousarray(W.T) for W, _ in layers]
        self._own = threading.local()
        self._exact = [(W.astype(float), b.astype(float)) for W, b in layers]  # a product of both types converts W
        self._unmoved = self.posed(np.eye(4))

    def __call__(self, points: np.ndarray, threads: int = 1) -> np.ndarray:
        """F: (N, 3) -> (K,)."""
        return self.encode(points, threads)[0]

    def encode(self, points: np.ndarray, threads: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """F and the critical points: (N, 3) -> feature (K,), index (K,) of the point that set each channel."""
        points = points.astype(np.float32)
        if len(points) < MANY:
            return tuple(x[0] for x in self.peaks(points, [self._unmoved], map))
        order = along_curve(points)
        with spread(threads) as run:
            feature, index, _ = self.whole(points[order], self._unmoved, run)
        return feature, order[index]

    def posed(self, g: np.ndarray) -> Layers:
        """The layers for points moved by g (4, 4), all but the last transposed, with biases that ``values`` adds late.

        relu(z + b) = max(z, -b) + b, and the b goes through the next layer's matrix into its bias: one pass over an
        activation in place of two, and none to move the points.
        """
        W, b = self._exact[0]
        shift = W @ g[:3, 3] + b
        layers = [((W @ g[:3, :3]).T.astype(np.float32), shift.astype(np.float32))]
        for (W, b), transposed in zip(self._exact[1:], self._transposed[1:], strict=True):
            shift = W @ shift + b
            layers.append((transposed, shift.astype(np.float32)))
        return [*layers[:-1], (self.layers[-1][0], layers[-1][1])]

    def last_hidden(self, points: np.ndarray, layers: Layers) -> np.ndarray:
        """What feeds the last layer, but for a constant: (n, 3) float32, n up to PART, ``posed`` layers -> (n, width).

        In this thread's own memory, good until its next call: the pages of a fresh array cost as much as the product.
        """
        if not hasattr(self._own, "room"):
            self._own.room = [np.empty(PART * len(b), np.float32) for _, b in self.layers]
        x = points
        for (W, b), room in zip(layers[:-1], self._own.room, strict=False):
            out = np.matmul(x, W, out=room[: len(points) * len(b)].reshape(len(points), -1))
            x = np.maximum(out, -b, out=out)
        return x

    def product(self, A: np.ndarray, B: np.ndarray) -> np.ndarray:
        """A B, of at most K x PART numbers, in this thread's own memory as ``last_hidden``, which it runs after."""
        shape = len(A), B.shape[1]
        return np.matmul(A, B, out=self._own.room[-1][: shape[0] * shape[1]].reshape(shape))

    def peaks(self, points: np.ndarray, posed: list[Layers], run: Run) -> tuple[np.ndarray, np.ndarray]:
        """F of the points (N, 3) float32 by each of S ``posed`` layers, and its critical points: (S, K), (S, K)."""

        def part(job: tuple[int, slice]) -> tuple[np.ndarray, np.ndarray]:
            layers = posed[job[0]]
            value, index = tops(self.product(layers[-1][0], self.last_hidden(points[job[1]], layers).T))
            return value, index + job[1].start

        parts = list(run(part, jobs(len(posed), len(points), CHUNK)))
        value, index = (np.array(x).reshape(len(posed), -1, x[0].size) for x in zip(*parts, strict=True))
        best = value.argmax(1)[:, None]
        value, index = (np.take_along_axis(x, best, 1)[:, 0] for x in (value, index))
        return value + np.array([layers[-1][1] for layers in posed]), index

    def whole(self, points: np.ndarray, posed: Layers, run: Run) -> tuple[np.ndarray, np.ndarray, list[Rivals]]:
        """``contest`` of all points with FEW of them, spread evenly over their order."""
        few = spaced(len(points), FEW)
        feature, index = (x[0] for x in self.peaks(points[few], [posed], run))
        return self.contest(points, posed, feature, few[index], 0.0, run)

    def contest(
        self, points: np.ndarray, posed: Layers, feature: np.ndarray, index: np.ndarray, margin: float, run: Run
    ) -> tuple[np.ndarray, np.ndarray, list[Rivals]]:
        """F (K,) of all points (N, 3) float32 by ``posed`` layers, its critical points (K,), and their rivals.

        feature, index: (K,) each, the same of some of the points. Rivals are these, and all that exceed their feature
        less the margin. A chunk of the points is multiplied with a channel's weights w only if it can hold one, by a
        bound on its blocks, which are small where the points are in ``along_curve``'s order: with x = A z + e what
        feeds the last layer, A a few orthonormal axes and e across them, and a = Aᵀw split by the sign of its parts,

            w · x = a · z + (w - Aa) · e ≤ max(a, 0) · max(z) + max(-a, 0) · max(-z) + ‖w - Aa‖ max ‖e‖
        """
        W, b = posed[-1]
        x = self.last_hidden(points[spaced(len(points), 2 * AXES)], posed)
        axes = np.linalg.svd(x, full_matrices=False)[2][:AXES].T
        along = W @ axes
        bounds = np.concatenate([np.maximum(along, 0), np.maximum(-along, 0), left_over(W, along)], 1).T.copy()
        above = feature - b - np.float32(margin)

        def part(job: tuple[int, slice]) -> tuple[Rivals, list[Found]]:
            first, own = job[1].start, points[job[1]]
            x = self.last_hidden(own, posed)
            z = x @ axes
            most = np.concatenate([z, -z, left_over(x, z)], 1)
            if len(most) % BLOCK:
                most = np.pad(most, ((0, -len(most) % BLOCK), (0, 0)), "edge")
            bound = self.product(most.reshape(-1, BLOCK, most.shape[1]).max(1), bounds)
            able = [bound[i : i + CHUNK // BLOCK].max(0) > above for i in range(0, len(bound), CHUNK // BLOCK)]

            channel, point, found = (index >= first) & (index < job[1].stop), np.zeros(len(x), bool), []
            point[index[channel] - first] = True
            for start, may in zip(range(0, len(x), CHUNK), able, strict=True):
                channels, chunk = may.nonzero()[0], slice(start, start + CHUNK)
                values = self.product(W[channels], x[chunk].T)
                top, which = tops(values)
                over = (top > above[channels]).nonzero()[0]
                channels = channels[over]
                point[chunk] |= (values[over] > above[channels, None]).any(0)
                channel[channels] = True
                found.append((channels, top[over], first + start + which[over]))
            return Rivals(first + point.nonzero()[0], own[point], channel.nonzero()[0]), found

        rivals, found = zip(*run(part, jobs(1, len(points), PART)), strict=True)
        some = (np.arange(len(b)), feature - b, index)
        best, critical = winners([some, *itertools.chain.from_iterable(found)], len(b))
        return best + b, critical, [part for part in rivals if len(part.index)]

    def among(self, rivals: list[Rivals], posed: Layers, run: Run) -> tuple[np.ndarray, np.ndarray]:
        """F of the rivals alone by ``posed`` layers, each in its own channels, and its critical points: (K,), (K,)."""
        W, b = posed[-1]

        def part(some: Rivals) -> Found:
            top, which = tops(self.product(W[some.channels], self.last_hidden(some.points, posed).T))
            return some.channels, top, some.index[which]

        best, critical = winners(list(run(part, rivals)), len(b))
        return best + b, critical

    def jacobian(self, points: np.ndarray, index: np.ndarray, g: np.ndarray | None = None) -> np.ndarray:
        """J of F(exp(-xi) P) at xi = 0, P the points (N, 3) moved by g (4, 4): index (K,) -> (K, 6) float32."""
        critical, back = np.unique(index, return_inverse=True)  # a point that sets many channels passes once
        p = points[critical] if g is None else transform_points(g, points[critical])
        on = [mask[back] for mask in hidden(self.layers, p.astype(np.float32))[1]]
        gradient = chain([W for W, _ in self.layers], on)
        return pose_jacobian(p[back].astype(np.float32), gradient)
