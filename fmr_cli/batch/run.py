"""Many pairs from a manifest: each file read and prepared once, a row a pair in the manifest's order, resumable."""

from __future__ import annotations

import csv
import json
import os
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

import fmr_cli
from fmr_cli.batch.manifest import Pair, read_manifest
from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError, FmrError, ModelError
from fmr_cli.io import WRITABLE, read_cloud, write_cloud, write_transform
from fmr_cli.io.files import check_writable, reason
from fmr_cli.io.outputs import write_json
from fmr_cli.registration.export import aligned_cloud, merged_cloud
from fmr_cli.registration.options import Options, read_init
from fmr_cli.registration.pipeline import align, prepare
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import plain

COLUMNS = (
    "source", "target", "status", "seconds", "transform", "overlap", "inlier_rmse", "feature_error", "confidence",
    "message",
)  # fmt: skip
CACHED_POINTS = 20_000_000  # of the files kept for later pairs; about 2 GB with what is prepared from them
AHEAD = 8  # pairs a worker may be ahead of the row that is written next


@dataclass
class Loaded:
    """A file made ready for registration; the cloud itself only where it is to be written again."""

    prepared: Prepared
    cloud: PointCloud | None


class Clouds:
    """Files read and prepared, each once even when several threads ask for it.

    A file is let go once no pair needs it any more, and the least recently used where many are kept.
    """

    def __init__(self, *, keep: bool, seed: int) -> None:
        self.keep, self.seed = keep, seed
        self.needed: Counter[Path] = Counter()  # how many pairs are still to come that need it
        self.files: OrderedDict[Path, Future[Loaded]] = OrderedDict()
        self.lock = threading.Lock()

    def get(self, path: Path) -> Loaded:
        """A file's cloud; where it could not be read, the same error each time."""
        with self.lock:
            known = self.files.get(path)
            future = self.files.setdefault(path, known or Future())
            self.files.move_to_end(path)
        if known is None:
            try:
                cloud = read_cloud(path, attributes=self.keep)
                future.set_result(Loaded(prepare(cloud, self.seed), cloud if self.keep else None))
            except BaseException as error:
                future.set_exception(error)
            self.let_go()
        return future.result()

    def done_with(self, *paths: Path) -> None:
        """A pair of these files is done."""
        with self.lock:
            self.needed.subtract(paths)
            for path in paths:
                if self.needed[path] <= 0:
                    self.files.pop(path, None)

    def let_go(self) -> None:
        with self.lock:
            read = {path: f.result().prepared.read for path, f in self.files.items() if f.done() and not f.exception()}
            held = sum(read.values())
            for path, points in read.items():
                if held > CACHED_POINTS:
                    held -= points
                    del self.files[path]


class Batch:
    """The pairs of one manifest, and the folder that their results go to.

    aligned, merged: also write each pair's moved source, or both clouds in one.
    Raises CloudFileError where the manifest is not one.
    """

    def __init__(self, manifest: Path, out: Path, options: Options, *, aligned: bool, merged: bool) -> None:
        self.folder, self.out, self.options = manifest.parent, out, options
        self.pairs = read_manifest(manifest)
        self.aligned, self.merged = aligned, merged
        self.clouds = Clouds(keep=aligned or merged, seed=options.seed)

    def open(self, resume: bool) -> list[dict[str, str]]:
        """Makes the folder and its results.csv; with ``resume``, the rows that are there already.

        A last line that a kill has torn is cut off. Raises CloudFileError where results.csv is there without
        ``resume``, or was made from another manifest or with other settings.
        """
        results, settings = self.out / "results.csv", self.out / "settings.json"
        if not self.out.is_dir():
            check_writable(self.out)
        if results.exists() and not resume:
            raise CloudFileError(f"{results}: is there already, add --resume to go on with it or give another --out")
        for folder in ("transforms", *(["aligned"] if self.aligned else []), *(["merged"] if self.merged else [])):
            (self.out / folder).mkdir(parents=True, exist_ok=True)
        head = ",".join(COLUMNS).encode() + b"\n"
        whole = results.read_bytes() if results.exists() else b""
        whole = whole[: whole.rfind(b"\n") + 1]
        if not whole:
            write_json(settings, self.settings())
            results.write_bytes(head)
            return []
        if not settings.exists() or json.loads(settings.read_text("utf-8")) != self.settings():
            raise CloudFileError(f"{results}: was made with other settings (see {settings.name}), give another --out")
        rows = list(csv.DictReader(StringIO(whole.decode("utf-8"), newline="")))
        made_from = [(row.get("source"), row.get("target")) for row in rows]
        if not whole.startswith(head) or made_from != [(p.source, p.target) for p in self.pairs[: len(rows)]]:
            raise CloudFileError(f"{results}: was made from another manifest, give another --out")
        os.truncate(results, len(whole))
        return rows

    def settings(self) -> dict[str, Any]:
        """What all rows of one results.csv share."""
        return plain({"fmr": fmr_cli.__version__, "aligned": self.aligned, "merged": self.merged, **vars(self.options)})

    def run(self, first: int, workers: int) -> Iterator[dict[str, Any]]:
        """Registers the pairs from index ``first`` on; yields each row, in the manifest's order, once it is on disk."""
        with (self.out / "results.csv").open("a", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            self.clouds.needed.update(self.folder / name for p in self.pairs[first:] for name in (p.source, p.target))
            pool = ThreadPoolExecutor(workers)
            try:
                todo, waiting = iter(self.pairs[first:]), deque[Future[dict[str, Any]]]()
                while True:
                    waiting.extend(
                        pool.submit(self.register, pair) for pair in islice(todo, AHEAD * workers - len(waiting))
                    )
                    if not waiting:
                        return
                    row = waiting.popleft().result()
                    table.writerow(row)
                    file.flush()
                    os.fsync(file.fileno())
                    yield row
            finally:
                pool.shutdown(cancel_futures=True)

    def register(self, pair: Pair) -> dict[str, Any]:
        """One pair's row of results.csv; its transform and clouds are written before. Raises ModelError alone."""
        row = dict.fromkeys(COLUMNS, "") | {"source": pair.source, "target": pair.target}
        start = time.perf_counter()
        try:
            init = {"init": read_init(pair.init, self.folder)} if pair.init else {}
            source, target = self.clouds.get(self.folder / pair.source), self.clouds.get(self.folder / pair.target)
            found = align(source.prepared, target.prepared, replace(self.options, **init), threads=1)
            warnings = [*found.warnings, *self.write_clouds(pair, source.cloud, target.cloud, found.T_target_source)]
            write_transform(self.out / "transforms" / f"{pair.name}.txt", found.T_target_source)
            row |= {
                "status": found.status,
                "transform": f"transforms/{pair.name}.txt",
                "overlap": f"{found.overlap:.6g}",
                "inlier_rmse": f"{found.inlier_rmse:.6g}",
                "feature_error": f"{found.feature_error_after:.6g}",
                "confidence": f"{found.confidence:.6g}",
                "message": "; ".join(warnings),
            }
        except ModelError:  # the same for every pair
            raise
        except FmrError as error:
            row |= {"status": "failed", "message": " ".join(str(error).split())}
        except Exception as error:  # whatever one pair runs into, the others go on
            row |= {"status": "failed", "message": f"{type(error).__name__}: {reason(error)}"}
        finally:
            self.clouds.done_with(self.folder / pair.source, self.folder / pair.target)
        return row | {"seconds": f"{time.perf_counter() - start:.3f}"}

    def write_clouds(
        self, pair: Pair, source: PointCloud | None, target: PointCloud | None, T: np.ndarray
    ) -> list[str]:
        """Writes the clouds that are wanted; returns warnings about what a format cannot hold."""
        if source is None or target is None:
            return []
        warnings = []
        if self.aligned:
            path = self.out / "aligned" / f"{pair.name}{suffix_for(source)}"
            warnings += write_cloud(path, aligned_cloud(source, target, T))
        if self.merged:
            merged, said = merged_cloud(source, target, T)
            warnings += said + write_cloud(self.out / "merged" / f"{pair.name}{suffix_for(target)}", merged)
        return warnings


def suffix_for(cloud: PointCloud) -> str:
    """The suffix of the cloud's file where that format can hold more attributes, or .ply."""
    suffix = cloud.path.suffix.lower() if cloud.path else ""
    return suffix if suffix in WRITABLE and suffix != ".bin" else ".ply"
