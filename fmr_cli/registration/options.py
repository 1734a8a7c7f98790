"""How to register: the one list of options. The command line, its help and the documentation are made from it."""

# ruff: noqa: RUF009 (`option` makes a field, no shared default)
# No `from __future__ import annotations` here: the command line and the checks read the fields' types.
import math
import operator
from dataclasses import Field, dataclass, field, fields
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from fmr_cli.errors import FmrError, OptionsError
from fmr_cli.geometry.dof import Dof

if TYPE_CHECKING:
    import numpy as np

Init = Literal["auto", "search", "features", "centroid", "identity"]
STARTS: tuple[str, ...] = get_args(Init)
Matrix = tuple[tuple[float, ...], ...]


def option(default: Any, help: str, *, least: float | None = None, above: float | None = None) -> Any:
    """A field with what is said about it: for people, and the bound of a number (at least, or above)."""
    return field(default=default, metadata={"help": help, "least": least, "above": above})


@dataclass(frozen=True, kw_only=True)
class Options:
    """How to register a pair. Lengths are in the clouds' own unit. Every field's ``metadata["help"]`` says what it is.

    init may also be a 4x4 T_target_source, a rigid motion (with ``scale``, a similarity); it is kept as a tuple of
    rows, so that options can be compared and hashed.
    Raises OptionsError, whose one line names the option and what it may be.
    """

    init: "Init | Matrix | np.ndarray" = option(
        "auto",
        "where to start: auto (what is cheap first, more while the verdict is not sure), search (all rotations, by the "
        "global feature), features (matched local patches), centroid, identity, or a transform file",
    )
    voxel_size: float | None = option(None, "the working voxel edge; from the data if not given", above=0)
    normalize: bool = option(True, "scale the clouds to the encoder's unit box")
    points: int = option(1024, "how many points of each cloud the global encoder sees, 10 at least", least=10)
    dof: Dof = option(
        "rigid",
        "what may move: rigid, yaw (a rotation about --up, any shift), translation, planar (yaw, no shift along --up)",
    )
    up: tuple[float, float, float] = option((0.0, 0.0, 1.0), "the vertical, of any length; z if not given")
    scale: bool = option(False, "also estimate one scale factor")
    unit: str | None = option(
        None, "the units of source and target, where they are two, such as mm:m; also cm, km, in, ft, us-ft, yd"
    )
    allow_mirror: bool = option(False, "also try the mirror image of the source, as of left-handed files")
    max_angle: float | None = option(None, "no rotation beyond it, in degrees", least=0)
    max_shift: float | None = option(None, "no shift of the source's centre beyond it", least=0)
    iterations: int = option(10, "of the solver from one start, at most", least=1)
    robust: bool = option(True, "robust steps on both clouds' Jacobians, or the paper's plain ones on the target's")
    refine: bool = option(True, "a last geometric polish (GICP)")
    model: Path | None = option(
        None,
        "what `fmr train` has learnt (.safetensors): encoders, verdict, sites; the bundled ones if not given",
    )
    device: Literal["auto", "cpu", "cuda"] = option(
        "auto", "where the solver of the global feature runs: cpu, cuda, or auto: the CPU, fast enough for a pair"
    )
    seed: int = option(0, "the same seed gives the same answer", least=0)

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if value is not None or f.default is not None:
                object.__setattr__(self, f.name, checked(f, value))
        if not isinstance(self.init, str):
            object.__setattr__(self, "init", checked_pose(self.init, self.scale))
        if self.unit is not None and (self.scale or not isinstance(self.init, str)):
            raise OptionsError(f"--unit {self.unit}: leave it out with --scale, or with a transform for --init")


def flag(name: str) -> str:
    """An option's name as it is typed: --voxel-size."""
    return "--" + name.replace("_", "-")


def choices(f: Field[Any]) -> tuple[str, ...]:
    """The words that an option may be; none for a number, a switch or a file."""
    return STARTS if f.name == "init" else get_args(f.type) if get_args(f.type)[:1] == (f.default,) else ()


def checked(f: Field[Any], value: Any) -> Any:
    """The value of one option, as its plain Python type. Raises OptionsError."""
    said = f"{flag(f.name)} {value!r}"
    if f.name == "up":
        return checked_direction(value)
    if f.name == "init" and not isinstance(value, str):
        return value  # a pose, which is looked at when ``scale`` is known
    if words := choices(f):
        if not isinstance(value, str) or value not in words:
            raise OptionsError(f"{said}: unknown, choose from {', '.join(words)}")
        return value
    if f.name == "model":
        if not isinstance(value, str | Path):
            raise OptionsError(f"{said}: is no path, give a .safetensors file")
        return Path(value)
    if f.name == "unit":
        from fmr_cli.registration.units import factor_of

        factor_of(value)
        return value
    if f.type is bool:
        if value not in (True, False):
            raise OptionsError(f"{said}: is neither true nor false")
        return bool(value)
    return checked_number(said, value, whole=f.type is int, **{k: f.metadata[k] for k in ("least", "above")})


def checked_number(said: str, value: Any, whole: bool, least: float | None, above: float | None) -> float:
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise OptionsError(f"{said}: is no finite number")
    if least is not None and value < least:
        raise OptionsError(f"{said}: is too small, give {least:g} or more")
    if above is not None and value <= above:
        raise OptionsError(f"{said}: is too small, give more than {above:g}")
    try:
        return operator.index(value) if whole else float(value)  # type: ignore[arg-type]
    except TypeError:
        raise OptionsError(f"{said}: is no whole number") from None


def checked_direction(value: Any) -> tuple[float, ...]:
    try:
        up = tuple(float(x) for x in value)
    except (TypeError, ValueError):
        up = ()
    if len(up) != 3 or not all(map(math.isfinite, up)) or not any(up):
        raise OptionsError(f"--up {value}: is no direction; give three finite numbers, not all zero")
    return up


def checked_pose(value: Any, scale: bool) -> Matrix:
    """A 4x4 T_target_source as a tuple of rows."""
    import numpy as np

    from fmr_cli.io.transforms import TOLERANCE, as_transform

    try:
        T = np.array(value, float)
        if T.ndim == 0:
            raise TypeError
    except (TypeError, ValueError):
        raise OptionsError(f"--init {value!r}: choose from {', '.join(STARTS)}, or give a 4x4 transform") from None
    if T.shape != (4, 4):
        raise OptionsError(f"--init: has the shape {T.shape}; choose from {', '.join(STARTS)}, or give a 4x4 transform")
    try:
        T = as_transform(T)
    except FmrError as error:
        raise OptionsError(f"--init: {error}") from None
    factor = float(np.cbrt(np.linalg.det(T[:3, :3])))
    if not scale and abs(factor - 1) > TOLERANCE:
        raise OptionsError(f"--init: its transform scales by {factor:.6g}; add --scale, or give a rigid motion")
    return tuple(tuple(row) for row in T.tolist())


def read_init(text: str, folder: Path = Path()) -> Any:
    """The name of a start, or the matrix in a transform file (relative to ``folder``). Raises FmrError."""
    if text in STARTS:
        return text
    if not (folder / text).is_file():
        raise OptionsError(f"{text}: is no start ({', '.join(STARTS)}) and no transform file, check --init")
    from fmr_cli.io import read_transform

    return read_transform(folder / text)
