"""Many scans, in order: odometry against a local map, loops, a trajectory and a map.

``pipeline.align_sequence`` is the whole way of a sequence. The names below are loaded on first use.
"""

from __future__ import annotations

from fmr_cli.lazy import lazy

_HOME = {
    "align_sequence": "fmr_cli.sequence.pipeline",
    "SequenceOptions": "fmr_cli.sequence.options",
    "SequenceResult": "fmr_cli.sequence.result",
    "Scans": "fmr_cli.sequence.scans",
    "find_scans": "fmr_cli.sequence.scans",
}

__all__ = [*_HOME]

__getattr__ = lazy(__name__, _HOME)
