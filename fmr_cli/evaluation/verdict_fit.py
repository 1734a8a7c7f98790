"""The verdict's weights from evidence: what ``models/verdict.json`` holds, and how true they are on other pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import minimize

from fmr_cli.evaluation.verdict_evidence import Judged
from fmr_cli.registration.confidence import MISSING, QUALITY, confidences, products, sigmoid, standing, told
from fmr_cli.registration.verdict_weights import Weights

RIDGE = 2e-3  # on the standardised weights of support and fit: next to nothing where the evidence decides
PRODUCT_RIDGE = 3.0  # on those of the verdict, of as many observations: of 3, 10 and 30 the best on other pairs
TINY = 1e-9  # a probability below it is a rounding error
STARTS = (0.3, 1.0)  # all weights, where the fit begins
FOLDS = 5


def fit(evidence: Sequence[Judged]) -> Weights:
    """The weights by which the right pose of each pair, or "none of them", is most likely.

    Support and fit first, together; then the verdict on what stands first by them. No kind of evidence of the former
    may count against its own sense: what one happens to say about another in these scans need not hold elsewhere.
    """
    support, quality = fit_support(evidence)
    none = np.zeros(0)
    standings = [standing(j.x, Weights(support, quality, none, none, none)) for j in evidence]
    x = np.array([s for _, s in standings])
    best = [int(weigh.argmax()) for weigh, _ in standings]
    right = np.array([j.right[i] for j, i in zip(evidence, best, strict=True)])
    known = Weights(support, quality, x.mean(0), x.std(0) + 1e-6, none)
    return Weights(support, quality, known.mean, known.std, logistic(products(x, known), right))


def fit_support(evidence: Sequence[Judged]) -> tuple[np.ndarray, np.ndarray]:
    """(d,) and (q,): support s and fit f, under which pose i is right with s_i times its share of all s_j exp(f_j).

    What is missing has no part in the support: it tells a pose from its like. By itself it says most in these scans,
    but nothing where points are too sparse to lie together, as a LiDAR's far off; contradiction holds there too.
    """
    x = np.concatenate([j.x for j in evidence])
    right = np.concatenate([j.right for j in evidence])
    pair = np.repeat(np.arange(len(evidence)), [len(j.x) for j in evidence])
    spread, none = np.append(1.0, x[:, 1:].std(0) + TINY), np.bincount(pair, right) == 0
    kinds = x.shape[1]

    def loss(w: np.ndarray) -> float:
        s = sigmoid(x @ (w[:kinds] / spread))
        f = x[:, QUALITY] @ (w[kinds:] / spread[QUALITY])
        highest = np.full(len(evidence), -np.inf)
        np.maximum.at(highest, pair, f)
        weigh = s * np.exp(np.clip(f - highest[pair], -50, 0))
        p = s * weigh / np.maximum(np.bincount(pair, weigh)[pair], 1e-300)
        each, hit = np.bincount(pair, p), np.bincount(pair, p * right)
        return float(-np.log(np.maximum(np.where(none, 1 - each, hit), TINY)).mean() + RIDGE * (w[1:] ** 2).mean())

    free = kinds - 1 + QUALITY.stop - QUALITY.start
    bounds: list[tuple[float | None, float | None]] = [(None, None)] + [(0, None)] * free
    bounds[MISSING] = (0, 0)
    found = [minimize(loss, np.append(0.0, np.full(free, s)), method="L-BFGS-B", bounds=bounds) for s in STARTS]
    best = min(found, key=lambda m: m.fun).x
    return best[:kinds] / spread, best[kinds:] / spread[QUALITY]


def logistic(x: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Weights (k,) of x (n, k), its first column 1, by which right (n,) is most likely; a ridge on the others."""

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        z, ridge = x @ w, np.append(0.0, w[1:]) * PRODUCT_RIDGE
        value = np.logaddexp(0, np.where(right, -z, z)).sum() + w @ ridge / 2
        return float(value), x.T @ (1 / (1 + np.exp(-z)) - right) + ridge

    return minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B", options={"maxiter": 1000}).x


def judge(evidence: Sequence[Judged], weights: Weights) -> tuple[np.ndarray, np.ndarray]:
    """What ``align`` would say of each look: the confidence of its best pose (n,), and which one that is (n,)."""
    said = []
    for j in evidence:
        shares, weigh = confidences(j.x, j.largest, weights)
        best = int(weigh.argmax())
        p = float(shares[best])
        said.append((told(p, j.x[best]) if j.told[best] else p, best))
    confidence, which = zip(*said, strict=True)
    return np.array(confidence), np.array(which)


def are_right(evidence: Sequence[Judged], best: np.ndarray) -> np.ndarray:
    """(n,) bool: whether the best pose of each look (n,) is right."""
    return np.array([j.right[i] for j, i in zip(evidence, best, strict=True)])


def cross_validated(
    evidence: Sequence[Judged], fit: Callable[[Sequence[Judged]], Weights] = fit
) -> tuple[np.ndarray, np.ndarray]:
    """``judge`` of each look by weights that were fitted on other pairs, one of FOLDS at a time."""
    confidence, best = np.zeros(len(evidence)), np.zeros(len(evidence), int)
    for fold in range(FOLDS):
        here = [i for i, j in enumerate(evidence) if j.number % FOLDS == fold]
        if here:
            weights = fit([j for j in evidence if j.number % FOLDS != fold])
            confidence[here], best[here] = judge([evidence[i] for i in here], weights)
    return confidence, best
