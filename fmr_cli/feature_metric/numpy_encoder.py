"""The encoder F without torch, for one cloud on the CPU: what ``encoder.Encoder`` computes, several times as fast.

``python -m benchmarks.speed --only ic`` measures it. What makes it fast: activations that stay in cache, points moved
and biases added by the weights, memory that is used again, the argmax in place of the maximum.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.feature_metric.inverse_compositional import chain, pose_jacobian
from fmr_cli.feature_metric.layers import Layers, hidden

CHUNK = 256  # points; their activation of CHUNK x K (1 MB at 1024 channels) stays in cache
ROUNDING = 1e-6  # of a feature: what float32 leaves between two ways to compute it

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
        with spread(threads) as run:
            feature, index = self.peaks(points.astype(np.float32), [self._unmoved], run)
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

    def peaks(self, points: np.ndarray, posed: list[Layers], run: Run) -> tuple[np.ndarray, np.ndarray]:
        """F of the points (N, 3) float32 by each of S ``posed`` layers, and its critical points: (S, K), (S, K)."""
        channels = np.arange(len(self.layers[-1][1]))

        def part(job: tuple[int, slice]) -> tuple[np.ndarray, np.ndarray]:
            values = self.values(points[job[1]], posed[job[0]])
            index = values.argmax(1)
            return values[channels, index], index + job[1].start

        parts = list(run(part, jobs(len(posed), len(points))))
        value, index = (np.array(x).reshape(len(posed), -1, len(channels)) for x in zip(*parts, strict=True))
        best = value.argmax(1)[:, None]
        value, index = (np.take_along_axis(x, best, 1)[:, 0] for x in (value, index))
        return value + np.array([layers[-1][1] for layers in posed]), index

    def contenders(
        self, points: np.ndarray, posed: Layers, floor: np.ndarray, run: Run
    ) -> tuple[np.ndarray, np.ndarray]:
        """F of the points (N, 3) float32 by ``posed`` layers, and the indices of those that reach ``floor`` (K,).

        One channel is enough; where the floor is F of some of the points, F depends on no others.
        """
        above, channels = (floor - posed[-1][1] - ROUNDING)[:, None], np.arange(len(floor))

        def part(job: tuple[int, slice]) -> tuple[np.ndarray, np.ndarray]:
            values = self.values(points[job[1]], posed)
            best = values[channels, values.argmax(1)]  # three times as fast as max
            reached = np.greater_equal(values, above, out=self._own.reached[: values.size].reshape(values.shape))
            return best, np.logical_or.reduce(reached, 0)

        best, reached = zip(*run(part, jobs(1, len(points))), strict=True)
        return np.max(best, 0) + posed[-1][1], np.concatenate(reached).nonzero()[0]

    def jacobian(self, points: np.ndarray, index: np.ndarray, g: np.ndarray | None = None) -> np.ndarray:
        """J of F(exp(-xi) P) at xi = 0, P the points (N, 3) moved by g (4, 4): index (K,) -> (K, 6) float32."""
        critical, back = np.unique(index, return_inverse=True)  # a point that sets many channels passes once
        p = points[critical] if g is None else transform_points(g, points[critical])
        on = [mask[back] for mask in hidden(self.layers, p.astype(np.float32))[1]]
        gradient = chain([W for W, _ in self.layers], on)
        return pose_jacobian(p[back].astype(np.float32), gradient)
