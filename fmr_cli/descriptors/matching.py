"""Which local features of two clouds look alike."""

from __future__ import annotations

import numpy as np


def match(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Pairs (C, 2) of descriptor rows, each the other side's nearest or nearest one way: (S, d), (T, d) -> (C, 2)."""
    similarity = source @ target.T
    forth = np.arange(len(source)) * len(target) + similarity.argmax(1)
    back = similarity.argmax(0) * len(target) + np.arange(len(target))
    return np.stack(np.divmod(np.union1d(forth, back), len(target)), 1)
