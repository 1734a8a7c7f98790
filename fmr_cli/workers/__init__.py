"""Who does the work when there is much of it: this process, processes beside it, or the workers of a Dask cluster.

All of them have one method, ``run``, whose answers come in the order of the tasks; see ``base.Workers``. The names
below are loaded on first use.
"""

from __future__ import annotations

from fmr_cli.lazy import lazy

_HOME = {
    "Workers": "fmr_cli.workers.base",
    "Here": "fmr_cli.workers.local",
    "Processes": "fmr_cli.workers.local",
    "DaskWorkers": "fmr_cli.workers.cluster",
}

__all__ = [*_HOME]

__getattr__ = lazy(__name__, _HOME)
