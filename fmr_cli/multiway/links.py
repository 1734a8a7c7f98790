"""A link: what registering two scans of a network has given, with every pose that may be right; and its journal."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fmr_cli.errors import CloudFileError
from fmr_cli.io.files import reason
from fmr_cli.multiway.visibility import Seen
from fmr_cli.registration import Options

Status = Literal["aligned", "uncertain", "failed", "rejected"]


@dataclass
class Hypothesis:
    """A pose that may be right: T_target_source (4, 4) between the centred frames; confidence: that it is.

    aligned: ``align`` has called it so, or it was given. firm: it has left no direction open. seen: what the scans'
    views say of it, None until it is known.
    """

    T_target_source: np.ndarray
    confidence: float
    aligned: bool = False
    firm: bool = False
    seen: Seen | None = None


@dataclass
class Link:
    """Two scans, by number, and what registering them has given.

    status: as ``align`` says, "failed" where it could not, "rejected" where the network has thrown it out.
    start: "look" (from a look's pose), "auto", "pose" (from where the network had it), "known" (given, not registered).
    hypotheses: best first. information: (6, 6) of a twist (rotation, translation) in the target's centred frame.
    chosen: the hypothesis that agrees with the network, or None.
    """

    source: int
    target: int
    status: Status
    start: str
    hypotheses: list[Hypothesis] = field(default_factory=list)
    information: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    overlap: float = 0.0
    inlier_rmse: float = 0.0
    edge: float = 0.0
    message: str = ""
    chosen: int | None = None
    residual_rot_deg: float = float("nan")
    residual_shift: float = float("nan")

    @property
    def ends(self) -> tuple[int, int]:
        return self.source, self.target

    @property
    def confidence(self) -> float:
        return self.hypotheses[0].confidence if self.hypotheses else 0.0

    @property
    def T_target_source(self) -> np.ndarray:  # noqa: N802 (the field's name for it)
        """The pose that the network has chosen, or the most confident one."""
        return self.hypotheses[self.chosen or 0].T_target_source


def best_of(first: Link | None, second: Link, worth: Callable[[Link], float]) -> Link:
    """One link of two attempts at a pair: the one that is worth more, with the poses that only the other one has."""
    if first is None:
        return second
    a, b = (first, second) if worth(first) >= worth(second) else (second, first)
    more = [h for h in b.hypotheses if all(apart(h, k, a.edge or b.edge) for k in a.hypotheses)]
    return replace(a, hypotheses=[*a.hypotheses, *more])


def apart(a: Hypothesis, b: Hypothesis, edge: float) -> bool:
    """Whether two poses are two: ten degrees or four voxel edges, as ``align`` tells its candidates apart."""
    A, B = a.T_target_source, b.T_target_source
    cosine = (np.trace(A[:3, :3].T @ B[:3, :3]) - 1) / 2
    return bool(cosine < np.cos(np.radians(10)) or np.linalg.norm(A[:3, 3] - B[:3, 3]) > 4 * edge)


class Journal:
    """What registering has given so far, a line an attempt, so that a kill loses none; path: None keeps it in memory.

    settings: what all attempts share; a journal made with others is refused by its caller.
    """

    def __init__(self, path: Path | None, settings: dict[str, Any]) -> None:
        self.path, self.settings = path, settings
        self.known: dict[str, dict[str, Any]] = {}

    def read(self) -> dict[str, Any] | None:
        """Reads what is there, without a last line that a kill has torn; returns its settings, or None."""
        if self.path is None or not self.path.exists():
            return None
        whole = self.path.read_bytes()
        whole = whole[: whole.rfind(b"\n") + 1]
        os.truncate(self.path, len(whole))
        lines = whole.decode("utf-8").splitlines()
        if not lines:
            return None
        for line in lines[1:]:
            entry = json.loads(line)
            self.known[entry.pop("key")] = entry
        return json.loads(lines[0])

    def begin(self) -> None:
        """Writes the settings as the first line of a new journal. Raises CloudFileError."""
        self.append(self.settings)

    def recall(self, key: str) -> Link | None:
        entry = self.known.get(key)
        if entry is None:
            return None
        sure, firm = entry["status"] == "aligned", not entry["message"]
        poses = [
            Hypothesis(np.array(T), c, sure and n == 0, firm and n == 0) for n, (T, c) in enumerate(entry["hypotheses"])
        ]
        return Link(**{**entry, "hypotheses": poses, "information": np.array(entry["information"])})

    def keep(self, key: str, link: Link) -> Link:
        """Puts an attempt on disk, and returns it. Raises CloudFileError."""
        names = ("source", "target", "status", "start", "overlap", "inlier_rmse", "edge", "message")
        entry = {name: getattr(link, name) for name in names}
        entry |= {"hypotheses": [(h.T_target_source.tolist(), h.confidence) for h in link.hypotheses]}
        self.append({"key": key, **entry, "information": link.information.tolist()})
        return link

    def append(self, entry: dict[str, Any]) -> None:
        if self.path is None:
            return
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise CloudFileError(
                f"{self.path}: cannot be written ({reason(error)}); make room, then go on with --resume"
            ) from None


def key_of(source: int, target: int, start: str, options: Options) -> str:
    """What names an attempt: the scans, the kind of start and, for a given pose, its bits."""
    init = options.init
    digest = "" if isinstance(init, str) else hashlib.sha256(np.asarray(init, float).tobytes()).hexdigest()[:16]
    return f"{source} {target} {start} {digest}"
