"""One pair of clouds: options, the prepared cloud, hypotheses, refinement, confidence, the result.

``pipeline.align`` is the whole way of a pair. The names below are loaded on first use.
"""

from __future__ import annotations

from fmr_cli.lazy import lazy

_HOME = {
    "align": "fmr_cli.registration.pipeline",
    "prepare": "fmr_cli.registration.pipeline",
    "Options": "fmr_cli.registration.options",
    "Prepared": "fmr_cli.registration.prepared",
    "Registration": "fmr_cli.registration.result",
}

__all__ = [*_HOME]

__getattr__ = lazy(__name__, _HOME)
