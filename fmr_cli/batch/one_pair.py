"""Pairs of a batch, as a worker does them: read, register, write their clouds; and what there is to say of each."""

from __future__ import annotations

import errno
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.batch.cache import CloudCache
from fmr_cli.batch.manifest import Pair
from fmr_cli.batch.results import COLUMNS
from fmr_cli.errors import CloudFileError, FmrError, ModelError
from fmr_cli.io import WRITABLE, open_cloud, write_cloud
from fmr_cli.io.addresses import located
from fmr_cli.io.files import reason
from fmr_cli.registration import Options, Registration, align
from fmr_cli.registration.export import aligned_cloud, merged_cloud, metrics
from fmr_cli.registration.options import read_init
from fmr_cli.workers.base import UnfitError, check_there, kept

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)  # of one machine's disk: another worker may have some


@dataclass(frozen=True)
class Block:
    """Pairs that one worker does one after the other, since they share files.

    spent: files that no later pair needs. there: files that a worker on another machine has to see as well.
    """

    pairs: tuple[Pair, ...]
    spent: frozenset[Path] = frozenset()
    there: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Done:
    """What a pair has given. T_target_source, metrics: None where it failed."""

    row: dict[str, Any]
    T_target_source: np.ndarray | None = None
    metrics: dict[str, Any] | None = None


@dataclass(frozen=True)
class PairRunner:
    """Registers pairs, in any process.

    folder: what the manifest's paths are relative to; out: the batch's folder; both absolute. aligned, merged: also
    write each pair's moved source, or both clouds in one. cached_points: of files that a process keeps. remote: whether
    another worker may have more room on its disk.
    """

    folder: Path
    out: Path
    options: Options
    aligned: bool
    merged: bool
    cached_points: int
    remote: bool = False

    def files(self, pair: Pair) -> tuple[Path, Path]:
        return located(self.folder, pair.source), located(self.folder, pair.target)

    def do(self, block: Block) -> list[Done]:
        """The block's pairs. Raises ModelError, and UnfitError where this machine lacks a file, or room for one."""
        check_there(block.there)
        cache = kept("batch", lambda: CloudCache(self.cached_points))
        done = [self.one(pair, cache) for pair in block.pairs]
        cache.let_go(block.spent)
        return done

    def one(self, pair: Pair, cache: CloudCache) -> Done:
        """One pair; its clouds are written. Raises ModelError, which is the same for every pair, and UnfitError."""
        start = time.perf_counter()
        try:
            done = self._registered(pair, cache)
        except (ModelError, UnfitError):
            raise
        except FmrError as error:
            done = failed(pair, " ".join(str(error).split()))
        except Exception as error:  # whatever one pair runs into, the others go on
            done = failed(pair, f"{type(error).__name__}: {reason(error)}")
        return replace(done, row=done.row | {"seconds": f"{time.perf_counter() - start:.3f}"})

    def _registered(self, pair: Pair, cache: CloudCache) -> Done:
        options = replace(self.options, init=read_init(pair.init, self.folder)) if pair.init else self.options
        source, target = (cache.get(path, seed=self.options.seed) for path in self.files(pair))
        found = align(source.prepared, target.prepared, options, threads=1)
        try:
            written = self._write_clouds(pair, found.T_target_source)
        except CloudFileError as error:
            if self.remote and getattr(error.__cause__, "errno", None) in NO_ROOM:
                raise UnfitError(str(error)) from error
            raise
        said = [*found.reasons, *found.warnings, *written]
        row = empty_row(pair) | described(found)
        row |= {"transform": f"transforms/{pair.name}.txt", "message": "; ".join(said)}
        return Done(row, found.T_target_source, metrics(source.said, target.said, found))

    def _write_clouds(self, pair: Pair, T_target_source: np.ndarray) -> list[str]:
        """Writes the clouds that are wanted; returns warnings about what a format cannot hold."""
        warnings: list[str] = []
        source, target = self.files(pair)
        if self.aligned:
            path = self.out / "aligned" / f"{pair.name}{suffix_for(source)}"
            warnings += write_cloud(
                path, aligned_cloud(open_cloud(source), open_cloud(target, attributes=False), T_target_source)
            )
        if self.merged:
            merged, said = merged_cloud(open_cloud(source), open_cloud(target), T_target_source)
            warnings += said + write_cloud(self.out / "merged" / f"{pair.name}{suffix_for(target)}", merged)
        return warnings


def empty_row(pair: Pair) -> dict[str, Any]:
    return dict.fromkeys(COLUMNS, "") | {"source": pair.source, "target": pair.target}


def failed(pair: Pair, message: str) -> Done:
    return Done(empty_row(pair) | {"status": "failed", "seconds": "0.000", "message": message})


def described(found: Registration) -> dict[str, str]:
    """A registration's part of a row."""
    return {
        "status": found.status,
        "overlap": f"{found.overlap:.6g}",
        "inlier_rmse": f"{found.inlier_rmse:.6g}",
        "feature_error": f"{found.feature_error_after:.6g}",
        "confidence": f"{found.confidence:.6g}",
    }


def suffix_for(path: Path) -> str:
    """The suffix of a cloud's file where that format can hold all attributes, or .ply."""
    suffix = path.suffix.lower()
    return suffix if suffix in WRITABLE and suffix not in (".bin", ".npy", ".pts") else ".ply"
