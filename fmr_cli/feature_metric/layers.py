"""The layers of a network in numpy, as its file holds them."""

from __future__ import annotations

import numpy as np

Layers = list[tuple[np.ndarray, np.ndarray]]  # (W (out, in), b (out,)) float32 of each
