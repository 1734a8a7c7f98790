"""Feature-metric point cloud registration.

    from fmr_cli import align, read_cloud, write_cloud

Names are loaded on first use, so that ``import fmr_cli`` and ``fmr --help`` start at once.
"""

from __future__ import annotations

from fmr_cli.lazy import lazy

__version__ = "0.1.0"

_HOME = {
    "PointCloud": "fmr_cli.cloud",
    "FmrError": "fmr_cli.errors",
    "read_cloud": "fmr_cli.io",
    "write_cloud": "fmr_cli.io",
    "read_transform": "fmr_cli.io",
    "write_transform": "fmr_cli.io",
    "align": "fmr_cli.registration",
    "Registration": "fmr_cli.registration",
    "Options": "fmr_cli.registration",
    "align_batch": "fmr_cli.batch",
    "align_sequence": "fmr_cli.sequence",
    "SequenceOptions": "fmr_cli.sequence",
    "align_many": "fmr_cli.multiway",
    "Network": "fmr_cli.multiway",
}

__all__ = ["__version__", *_HOME]

__getattr__ = lazy(__name__, _HOME)
