"""What is needed to go on after a kill: a file beside the poses, a header and then a line a frame, in JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from fmr_cli.errors import FmrError
from fmr_cli.io.files import atomic_write, check_readable, reason
from fmr_cli.sequence.azimuth import Revolution
from fmr_cli.sequence.voxel_frame import VoxelFrame


@dataclass(frozen=True)
class Beginning:
    """What a run decides once, before its first frame.

    frame: the coordinates that the odometry works in. T_first_second: (4, 4), file units, the second frame to the first
    as far as it is known before the run, for deskewing these two. deskewed: whether the motion within scans is undone;
    revolution: where points' times follow from their azimuth.
    """

    frame: VoxelFrame
    T_first_second: np.ndarray
    deskewed: bool = False
    revolution: Revolution | None = None

    def to_json(self) -> dict[str, Any]:
        return {
            "frame": self.frame.to_json(), "T_first_second": self.T_first_second.tolist(), "deskewed": self.deskewed,
            "revolution": asdict(self.revolution) if self.revolution else None,
        }  # fmt: skip

    @classmethod
    def from_json(cls, said: dict[str, Any]) -> Beginning:
        revolution = Revolution(**said["revolution"]) if said["revolution"] else None
        frame = VoxelFrame.from_json(said["frame"])
        return cls(frame, np.array(said["T_first_second"]), said["deskewed"], revolution)


class Journal:
    """The journal of the run whose poses go to ``out``; of no run at all where that is None.

    settings: what must be the same in the run that is resumed; JSON types.
    """

    def __init__(self, out: Path | None, settings: dict[str, Any]) -> None:
        self.path = out.with_name(out.name + ".journal") if out else None
        self.settings = settings
        self.file: TextIO | None = None

    def read(self) -> tuple[Beginning, list[dict[str, Any]]] | None:
        """How an earlier run began, and its lines; None where there is none.

        Raises FmrError where its settings differ, or the file is damaged.
        """
        if self.path is None or not self.path.exists():
            return None
        check_readable(self.path)
        records = []
        for line in self.path.read_bytes().split(b"\n")[:-1]:  # what follows the last newline was cut off
            try:
                records.append(json.loads(line))
            except ValueError as error:
                raise FmrError(f"{self.path}: is damaged ({reason(error)}), leave out --resume") from None
        if not records:
            return None
        header, *lines = records
        changed = [name for name, value in self.settings.items() if header.get(name) != value]
        if changed:
            raise FmrError(
                f"{self.path}: was begun with other settings ({', '.join(changed)}), use those or leave out --resume"
            )
        if "beginning" not in header or any("within" not in line for line in lines):
            raise FmrError(f"{self.path}: was begun by another version of fmr, leave out --resume")
        return Beginning.from_json(header["beginning"]), lines

    def begin(self, beginning: Beginning, lines: list[dict[str, Any]]) -> None:
        """Write the header, and the lines of an earlier run again; opened for more."""
        if self.path is None:
            return
        header = self.settings | {"beginning": beginning.to_json()}
        with atomic_write(self.path) as part:
            part.write_text("".join(json.dumps(record) + "\n" for record in [header, *lines]), "utf-8")
        self.file = self.path.open("a", encoding="utf-8")

    def add(self, record: dict[str, Any]) -> None:
        """A line, on disk before anything else is done with the frame."""
        if self.file:
            self.file.write(json.dumps(record) + "\n")
            self.file.flush()

    def close(self) -> None:
        if self.file:
            self.file.close()

    def remove(self) -> None:
        """The run is complete: nothing is left to go on with."""
        self.close()
        if self.path:
            self.path.unlink(missing_ok=True)
