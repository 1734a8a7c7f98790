"""One source for numpy and torch: equations are written with the names of the Python array API standard.

Torch is not imported here: whoever passes a tensor has done so.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import array_api_compat
import array_api_compat.numpy
import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

Array = TypeVar("Array", np.ndarray, "Tensor")  # one kind within a call


def namespace(x: Array) -> Any:
    """The array API's functions for arrays like x. Numpy by a shortcut: the general way takes 5 us a call."""
    return array_api_compat.numpy if isinstance(x, np.ndarray) else array_api_compat.array_namespace(x)


def median_magnitude(e: Array) -> Array:
    """The median of |e| along the last axis, the lower one of an even number: (..., K) -> (..., 1).

    The array API has no median, and sorting for it takes several times as long as either library's own way.
    """
    if isinstance(e, np.ndarray):
        middle = (e.shape[-1] - 1) // 2
        return np.partition(np.abs(e), middle)[..., middle, None]
    return e.abs().median(-1, keepdim=True).values
