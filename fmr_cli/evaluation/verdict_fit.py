"""The verdict's weights from evidence: logistic regression over the poses of a pair, of which at most one is right."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from fmr_cli.evaluation.verdict_evidence import LOOKS, EvidenceTable

RIDGE = 3e-3  # on the standardised weights: next to nothing where the evidence decides, finite where it separates
LARGEST_EXPONENT = 50.0  # of e: beyond it, odds are certain, and further from overflow than 600


def fit(evidence: EvidenceTable) -> np.ndarray:
    """Weights (k,) by which the right pose of each pair, or "none of them", is most likely; a small ridge.

    No kind of evidence may count against its own sense: what one kind happens to say about another in these scans need
    not hold elsewhere.
    """
    x, y, pair = evidence.x, evidence.right, evidence.pair
    spread = np.append(1.0, x[:, 1:].std(0))
    some = np.bincount(pair) > 0
    none = np.bincount(pair, y)[some] == 0

    def loss(w: np.ndarray) -> float:
        odds = np.exp(np.clip((x / spread) @ w, -LARGEST_EXPONENT, LARGEST_EXPONENT))
        each, right = (np.bincount(pair, o)[some] for o in (odds, odds * y))
        return float(np.mean(np.log1p(each) - np.log(np.where(none, 1, right))) + RIDGE * (w[1:] ** 2).mean())

    bounds = [(None, None)] + [(0, None)] * (x.shape[1] - 1)
    return minimize(loss, np.zeros(x.shape[1]), method="L-BFGS-B", bounds=bounds).x / spread


def judge(evidence: EvidenceTable, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What ``align`` would say of each pair: the confidence of its best pose (pairs,), and whether that is right."""
    groups = [np.flatnonzero(evidence.pair == i) for i in np.unique(evidence.pair)]
    odds = np.exp(np.clip(evidence.x @ weights, -LARGEST_EXPONENT, LARGEST_EXPONENT))
    first = [here[odds[here].argmax()] for here in groups]
    confidence = [odds[i] / (1 + odds[here].sum()) for i, here in zip(first, groups, strict=True)]
    return np.array(confidence), evidence.right[first]


def fitted_half(evidence: EvidenceTable) -> np.ndarray:
    """(n,) which poses belong to the half of the pairs that is fitted, half of each of the LOOKS; the rest judges."""
    return evidence.pair % (2 * len(LOOKS)) < len(LOOKS)
