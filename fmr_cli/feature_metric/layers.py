"""The layers of a network in numpy."""

from __future__ import annotations

import numpy as np

Layers = list[tuple[np.ndarray, np.ndarray]]  # (W (out, in), b (out,)) float32 of each


def hidden(layers: Layers, x: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Points (..., 3) through all layers but the last: (..., width), and which units of each were on."""
    on = []
    for W, b in layers[:-1]:
        x = x @ W.T + b
        on.append(x > 0)
        x = np.maximum(x, 0)
    return x, on
