"""Many scans in any order: which pairs to try, their links, the network of poses, the joint refinement.

``pipeline.align_many`` is the whole way. The names below are loaded on first use.
"""

from __future__ import annotations

from fmr_cli.lazy import lazy

_HOME = {
    "align_many": "fmr_cli.multiway.pipeline",
    "Network": "fmr_cli.multiway.network",
    "Known": "fmr_cli.multiway.known",
}

__all__ = [*_HOME]

__getattr__ = lazy(__name__, _HOME)
