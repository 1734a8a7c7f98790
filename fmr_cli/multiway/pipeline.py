"""The way of many scans: read and describe each, look at pairs, register the promising, join, refine all at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from threadpoolctl import threadpool_limits

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.files import check_writable
from fmr_cli.multiway import pose_graph
from fmr_cli.multiway.adjustment import adjust
from fmr_cli.multiway.candidates import PORTIONS, look_at_pairs, look_by_planes, look_further
from fmr_cli.multiway.known import Known
from fmr_cli.multiway.network import Network
from fmr_cli.multiway.reading import prepare
from fmr_cli.multiway.registering import take_known_links
from fmr_cli.multiway.rounds import confirm, join_components, register_most_promising, try_dear_starts
from fmr_cli.multiway.scans import list_scans
from fmr_cli.multiway.survey import Progress, Survey
from fmr_cli.multiway.workers import Threads
from fmr_cli.registration import Options
from fmr_cli.workers import Workers

LONE = 3  # scans of a component, at most, that are first looked at by planes


def align_many(
    scans: Iterable[str | Path | PointCloud],
    options: Options = Options(),
    *,
    known: Known = Known(),
    out: Path | None = None,
    resume: bool = False,
    workers: int | Workers | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Network:
    """Finds a pose for each of many scans, in any order, and says which links between them hold.

    scans: files, folders, text files that list scans, or clouds in memory; one unit. options: how pairs are registered;
    ``max_shift``: how far a scan's centre may move against another one, from its file's or its known pose. out: folder
    of the journal, so that a killed run can go on with ``resume``; None keeps nothing on disk. workers: pairs at a
    time (default: the cores), or ``fmr_cli.workers.DaskWorkers``, entered, which register the pairs; the result does
    not depend on it.

    Raises FmrError where there are fewer than two scans, a name is unknown, or GTSAM is missing; a scan that cannot be
    read, or a pair that cannot be registered, is a row that says so.
    """
    pose_graph.check_installed("fmr multiway")
    survey = Survey(list_scans(scans, out), options, known, out, Threads(workers), progress)
    with at_work(survey, resume):
        prepare(survey)
        take_known_links(survey)
        look_at_pairs(survey)
        register_most_promising(survey)
        join_components(survey)
        confirm(survey)
        for _ in range(PORTIONS - 1):
            if len(survey.components) > 1 and look_further(survey):
                join_components(survey)
                confirm(survey)
        for most in (LONE, math.inf):  # lone scans are few, and often what joins the others
            if len(survey.components) > 1 and look_by_planes(survey, most):
                join_components(survey)
                confirm(survey)
        before = math.inf
        while (apart := len(survey.components)) < before and try_dear_starts(survey):  # as long as they join any
            before = apart
            join_components(survey)
            confirm(survey)
        return adjust(survey)


@contextmanager
def at_work(survey: Survey, resume: bool) -> Iterator[None]:
    """Opens the journal; ends the workers, and, once the work is done, removes the folder of spilled scans.

    Raises CloudFileError where the folder cannot be written to, holds another run, or one without ``resume``.
    """
    try:
        if survey.out is not None:
            open_journal(survey, survey.out, resume)
        with threadpool_limits(1):
            yield
    finally:
        survey.workers.close()
    survey.store.clear()


def open_journal(survey: Survey, out: Path, resume: bool) -> None:
    journal, path = survey.journal, out / "journal.jsonl"
    if not out.is_dir():
        check_writable(out)
        out.mkdir()
    if path.exists() and not resume:
        raise CloudFileError(f"{path}: is there already, add --resume to go on with it or give another --out")
    found = journal.read()
    if found is None:
        journal.begin()
    elif found != journal.settings:
        raise CloudFileError(f"{path}: was made from other scans or settings, give another --out")
