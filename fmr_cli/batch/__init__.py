"""Many pairs from a manifest: each file read and prepared once, a row a pair, resumable.

``pipeline.align_batch`` is the whole way of a batch. The names below are loaded on first use.
"""

from __future__ import annotations

from fmr_cli.lazy import lazy

_HOME = {
    "align_batch": "fmr_cli.batch.pipeline",
    "read_manifest": "fmr_cli.batch.manifest",
}

__all__ = [*_HOME]

__getattr__ = lazy(__name__, _HOME)
