"""One pair of a batch: read, register, write its transform and clouds; its row, whatever happens."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.batch.cache import CloudCache
from fmr_cli.batch.manifest import Pair
from fmr_cli.batch.results import COLUMNS
from fmr_cli.errors import FmrError, ModelError
from fmr_cli.io import WRITABLE, open_cloud, write_cloud, write_transform
from fmr_cli.io.files import reason
from fmr_cli.registration import Options, Registration, align
from fmr_cli.registration.export import aligned_cloud, merged_cloud
from fmr_cli.registration.options import read_init


@dataclass(frozen=True)
class PairRunner:
    """Registers pairs, in any thread.

    folder: what the manifest's paths are relative to. out: the batch's folder. aligned, merged: also write each pair's
    moved source, or both clouds in one.
    """

    folder: Path
    out: Path
    options: Options
    cache: CloudCache
    aligned: bool
    merged: bool

    def files(self, pair: Pair) -> tuple[Path, Path]:
        return self.folder / pair.source, self.folder / pair.target

    def row(self, pair: Pair) -> dict[str, Any]:
        """One pair's row of results.csv; its transform and clouds are written before. Raises ModelError alone."""
        row = dict.fromkeys(COLUMNS, "") | {"source": pair.source, "target": pair.target}
        start = time.perf_counter()
        try:
            row |= self._registered(pair)
        except ModelError:  # the same for every pair
            raise
        except FmrError as error:
            row |= {"status": "failed", "message": " ".join(str(error).split())}
        except Exception as error:  # whatever one pair runs into, the others go on
            row |= {"status": "failed", "message": f"{type(error).__name__}: {reason(error)}"}
        finally:
            self.cache.done_with(*self.files(pair))
        return row | {"seconds": f"{time.perf_counter() - start:.3f}"}

    def _registered(self, pair: Pair) -> dict[str, Any]:
        options = replace(self.options, init=read_init(pair.init, self.folder)) if pair.init else self.options
        source, target = (self.cache.get(path, seed=self.options.seed) for path in self.files(pair))
        found = align(source, target, options, threads=1)
        warnings = [*found.reasons, *found.warnings, *self._write_clouds(pair, found.T_target_source)]
        transform = f"transforms/{pair.name}.txt"
        write_transform(self.out / transform, found.T_target_source)
        return described(found) | {"transform": transform, "message": "; ".join(warnings)}

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
