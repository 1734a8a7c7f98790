"""Each scan on its own: read once, put on a grid that scans of like size share, described."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fmr_cli.errors import FmrError
from fmr_cli.io.files import reason
from fmr_cli.multiway import looks
from fmr_cli.multiway.survey import Survey

UNIT = 30.0  # times as far apart as other scans' points: metres and millimetres, feet and inches lie further apart


def prepare(survey: Survey) -> None:
    """Reads and describes every scan; what is wrong with one is a message. Raises FmrError where none can be used."""
    numbers = range(len(survey.scans))
    with survey.stage("read"):
        own = dict(zip(numbers, survey.each("reading", lambda n: own_edge(survey, n), numbers), strict=True))
        leave_out_twins(survey)
    usable = sorted(survey.frames)
    survey.failed = set(numbers) - set(usable)
    if not usable:
        raise FmrError(f"none of {len(own)} scans can be used; the first: {survey.messages[0]}")
    with survey.stage("describe"):
        size = survey.options.voxel_size
        shared = [size] * len(usable) if size else looks.shared_edges([own[n] or 0.0 for n in usable])
        survey.edges = survey.store.edges = dict(zip(usable, shared, strict=True))
        survey.each("describing", survey.description, usable)
    median = float(np.median([own[n] or 0.0 for n in usable]))
    for n in usable:
        ratio = (own[n] or 0.0) / median
        if not 1 / UNIT <= ratio <= UNIT:
            survey.note(n, f"its points lie {ratio:.3g} times as far apart as others': in another unit?")


def own_edge(survey: Survey, number: int) -> float | None:
    """The voxel edge that suits a scan, or None (and a message) where it cannot be used."""
    try:
        ready = survey.store.prepared(number)
    except FmrError as error:
        survey.messages[number] = " ".join(str(error).split())
        return None
    except Exception as error:  # whatever one scan runs into, the others go on
        survey.messages[number] = f"{type(error).__name__}: {reason(error)}"
        return None
    survey.frames[number] = ready.frame
    return ready.edge


def leave_out_twins(survey: Survey) -> None:
    """One file given twice stays in once; files whose points have the same mean are said to be the same scan."""
    paths: dict[Path, int] = {}
    means: dict[bytes, int] = {}
    for number in sorted(survey.frames):
        source = survey.scans[number].source
        path = source.resolve() if isinstance(source, Path) else None
        mean = survey.frames[number].origin.tobytes()
        if path in paths:
            survey.note(number, f"is the same file as {survey.scans[paths[path]].name}: left out")
            del survey.frames[number]
            survey.store.kept.pop(number, None)
            continue
        if mean in means:
            survey.note(number, f"holds the same points as {survey.scans[means[mean]].name}")
        if path:
            paths[path] = number
        means.setdefault(mean, number)
