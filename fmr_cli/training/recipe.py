"""Every setting of a training run, as a TOML file that can be read back and run again.

``kind`` says what is trained: "scans", all that registration uses, on the user's scans (ScanRecipe); "global", the
encoder of whole clouds alone (Recipe); "local", that of local patches, on made-up scans (LocalRecipe).
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from fmr_cli.errors import FmrError
from fmr_cli.synthetic.batches import Augment


class RecipeError(FmrError):
    """A recipe that cannot be run as written."""


@dataclass(frozen=True)
class LocalRecipe:
    """How the encoder of local patches is trained, on made-up scans alone. Lengths in voxel edges."""

    kind: str = "local"
    start: str = "base"  # "base", "scratch" or a .safetensors file
    pairs: int = 480  # of scans, made once and drawn from in every step
    patches: int = 128  # of one place, of each scan of a pair, at most
    others: int = 0  # of each scan's patches that are in it alone
    patch_points: int = 64  # of a patch's 64, drawn anew in each step
    batch: int = 4  # pairs of a step
    temperature: float = 0.07  # of InfoNCE, as in most work that uses it
    apart: float = 3.0  # voxel edges: nearer places are not each other's negatives
    learning_rate: float = 1e-3
    steps: int = 2400
    epoch_steps: int = 200
    seed: int = 0
    held_out: float = 0.05  # share of the pairs that are never trained on

    def __post_init__(self) -> None:
        wrong = [
            f"{name} = {value}" for name, value in asdict(self).items() if isinstance(value, int | float) and value < 0
        ]
        for name in ("pairs", "patches", "patch_points", "batch", "temperature", "steps", "epoch_steps"):
            if not getattr(self, name) >= (1 if name != "temperature" else 1e-6):
                wrong.append(f"{name} = {getattr(self, name)}")
        if wrong:
            raise RecipeError(f"the recipe has {wrong[0]}; give a larger number")
        if not 0 < self.held_out < 1:
            raise RecipeError("the recipe needs held_out between 0 and 1")
        if self.pairs - self.held_out_pairs < self.batch:
            raise RecipeError(f"the recipe has {self.pairs} pairs; a batch of {self.batch} needs more")

    @property
    def held_out_pairs(self) -> int:
        return max(round(self.held_out * self.pairs), 1)

    def changed(self, **changes: Any) -> LocalRecipe:
        """A copy with other values; None leaves them. Raises RecipeError for what only the global encoder has."""
        given = {name: value for name, value in changes.items() if value is not None}
        for name in given:
            if name not in {f.name for f in fields(self)}:
                raise RecipeError(f'a recipe of kind "local" has no {name}; leave it away')
        return replace(self, **given)

    def toml(self) -> str:
        """The recipe as TOML, every key of it."""
        return "\n".join([*(f"{name} = {_value(value)}" for name, value in asdict(self).items()), ""])


@dataclass(frozen=True)
class Recipe:
    """How the encoder of whole clouds is trained. Angles in degrees, lengths in units of the normalised cloud."""

    kind: str = "global"
    start: str = "base"  # "base", "scratch" or a .safetensors file
    feature_dim: int = 1024  # from scratch only; otherwise the start's
    hidden: tuple[int, ...] = (64, 64, 64, 128)
    shapes: int = 0  # procedural shapes; 0 for the scans on the command line
    scenes: int = 0  # procedural rooms, streets and things, each scanned once and cut into SCENE_CROPS clouds
    crops: int = 4096  # at most, cut from the scans
    cloud_points: int = 2048  # kept of every shape or crop
    points: int = 512  # of each cloud in a step
    anchor_steps: int = 0  # first steps, in which each channel learns to fall off around an anchor (losses.anchor_loss)
    anchor_width: float = 0.3  # of the fall
    anchor_rate: float = 2e-3  # the learning rate in those steps
    chamfer_weight: float = 1.0
    chamfer_batch: int = 24
    pose_weight: float = 0.0
    pose_batch: int = 12
    pose_after: float = 0.0  # share of the steps after the anchors' before the pose loss sets in
    chamfer_until: float = 1.0  # share of those steps after which the Chamfer loss stops
    unroll: int = 5  # IC iterations that the pose loss goes through
    plain: float = 0.0  # share of the pose steps as in the paper, not robust, on pairs that overlap fully
    plain_rotation: float = 90.0  # degrees at most, in those steps
    decoder_warmup: int = 200  # steps for a new decoder alone, where the encoder is already trained
    learning_rate: float = 3e-4
    clip: float = 1.0  # largest norm of the gradient
    steps: int = 3000
    epoch_steps: int = 100
    seed: int = 0
    held_out: float = 0.15  # share of the clouds that are never trained on
    held_out_pairs: int = 32  # registered at each setting after every epoch
    augment: Augment = field(default_factory=Augment)

    def __post_init__(self) -> None:
        wrong = [
            f"{name} = {value}"
            for name, value in asdict(self).items()
            if isinstance(value, int | float) and not isinstance(value, bool) and value < 0
        ]
        for name in ("feature_dim", "cloud_points", "points", "chamfer_batch", "pose_batch", "unroll", "steps"):
            if getattr(self, name) < 1:
                wrong.append(f"{name} = {getattr(self, name)}")
        if self.anchor_steps and self.anchor_width == 0:
            wrong.append("anchor_width = 0")
        if wrong:
            raise RecipeError(f"the recipe has {wrong[0]}; give a larger number")
        if self.epoch_steps < 1 or self.held_out_pairs < 1 or not 0 < self.held_out < 1:
            raise RecipeError("the recipe needs epoch_steps and held_out_pairs of 1 or more, held_out between 0 and 1")
        if self.plain > 1:
            raise RecipeError("the recipe needs a plain of 1 at most, a share of the pose steps")
        if not 0 < self.augment.overlap <= 1 or not 0 < self.augment.density <= 1:
            raise RecipeError("the recipe's overlap and density must be above 0 and at most 1")
        if self.anchor_steps > self.steps:
            raise RecipeError(f"the recipe has {self.anchor_steps} anchor_steps of {self.steps} steps; give more steps")
        if self.chamfer_weight == 0 and self.pose_weight == 0 and self.anchor_steps < self.steps:
            raise RecipeError("the recipe has no loss; set chamfer_weight or pose_weight above 0")

    def changed(self, **changes: Any) -> Recipe:
        """A copy with other values; keys of Augment go there. Values of None are left as they are."""
        given = {name: value for name, value in changes.items() if value is not None}
        names = {f.name for f in fields(Augment)}
        augment = replace(self.augment, **{name: value for name, value in given.items() if name in names})
        return replace(self, augment=augment, **{name: value for name, value in given.items() if name not in names})

    def toml(self) -> str:
        """The recipe as TOML, every key of it."""
        own = asdict(self)
        augment = own.pop("augment")
        lines = [f"{name} = {_value(value)}" for name, value in own.items()]
        return "\n".join(
            [*lines, "", "[augment]", *(f"{name} = {_value(value)}" for name, value in augment.items()), ""]
        )


@dataclass(frozen=True)
class ScanRecipe:
    """How registration goes on from the user's scans: its local encoder, and a share of the time its global one.

    Lengths in voxel edges. whole: how the global encoder goes on.
    """

    kind: str = "scans"
    start: str = "base"  # "base", "scratch" or a .safetensors file
    rounds: int = 3  # of registering the scans with each other, by what has been learnt so far; at most, in a timed run
    scans: int = 40  # registered with each other in a round, at most
    pairs: int = 160  # of them that show one place, drawn for training in a round, at most
    single: int = 48  # pairs made from single scans, in a round
    made_up: int = 96  # pairs of procedural scans, so that nothing is forgotten
    patches: int = 96  # of one place, of each scan of a pair, at most
    others: int = 48  # of each scan's patches that are in it alone
    patch_points: int = 32  # of a patch's 64, drawn anew in each step: two fifths of the time, and another sampling
    batch: int = 2  # pairs of a step
    temperature: float = 0.07  # of InfoNCE
    apart: float = 3.0  # voxel edges: nearer places are not each other's negatives
    learning_rate: float = 2e-3  # a minute has some hundred steps
    stays: float = (
        0.2  # share of the start's weights in the mean that is kept: by 0.4 half as much is forgotten and gained
    )
    whole_every: int = 5  # one step in so many is the global encoder's; 0 leaves it as it is
    steps: int = 1200
    epoch_steps: int = 100
    seed: int = 0
    held_out: float = 0.2  # share of the scans that are never trained on
    tested: int = 12  # held-out pairs whose matches are counted after each epoch
    checked: int = 48  # held-out pairs that are registered before and after, at most
    site_points: int = 300_000  # that the model keeps of the sites it has seen, at most (12 bytes each); 0 keeps none
    whole: Recipe = field(default_factory=lambda: Recipe(crops=1024, decoder_warmup=100, held_out_pairs=12))

    def __post_init__(self) -> None:
        counts = "rounds", "scans", "patches", "patch_points", "batch", "steps", "epoch_steps", "tested"
        for name, value in vars(self).items():
            least = 1 if name in counts else 0
            if isinstance(value, int | float) and not value >= least:
                raise RecipeError(f"the recipe has {name} = {value}; give a larger number")
        if not 0 < self.held_out < 1 or not self.temperature > 0 or not self.stays < 1:
            raise RecipeError("the recipe needs held_out between 0 and 1, stays below 1, and a temperature above 0")
        if self.scans < 2:
            raise RecipeError("the recipe has scans = 1; give two or more")
        if not self.pairs + self.single + self.made_up:
            raise RecipeError("the recipe has no pairs; set pairs, single or made_up above 0")

    def changed(self, **changes: Any) -> ScanRecipe:
        """A copy with other values; those of the global encoder go there. Values of None are left as they are."""
        given = {name: value for name, value in changes.items() if value is not None}
        own = {f.name for f in fields(self)}
        theirs = {n: v for n, v in given.items() if n not in own or n in ("start", "seed")}
        return replace(self, whole=self.whole.changed(**theirs), **{n: v for n, v in given.items() if n in own})

    def within(self, minutes: float) -> ScanRecipe:
        """A copy whose material suits so many minutes; the global encoder has its share of longer runs alone."""
        return replace(
            self,
            rounds=1 if minutes < 3 else 2 if minutes < 8 else 3,
            scans=_between(10 * minutes**0.5, 10, 40),  # a round then takes a fifth of the time or so on two cores
            pairs=_between(40 * minutes, 40, 240),
            single=_between(12 * minutes, 12, 64),
            made_up=_between(20 * minutes, 20, 96),
            tested=8 if minutes < 3 else 12,
            checked=_between(12 * minutes, 12, 60),
            whole_every=0 if minutes < 3 else self.whole_every,
        )

    def toml(self) -> str:
        """The recipe as TOML, every key of it."""
        lines = [f"{f.name} = {_value(getattr(self, f.name))}" for f in fields(self) if f.name != "whole"]
        whole = self.whole.toml().replace("[augment]", "[whole.augment]")
        return "\n".join([*lines, "", "[whole]", whole])


def _between(value: float, least: int, most: int) -> int:
    return round(min(max(value, least), most))


AnyRecipe = Recipe | LocalRecipe | ScanRecipe


def _value(value: Any) -> str:
    return json.dumps(list(value) if isinstance(value, tuple) else value)


def read_recipe(path: Path | str) -> AnyRecipe:
    """Reads a TOML recipe; keys that it lacks keep their defaults. Raises RecipeError for what cannot be run."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        table = tomllib.loads(text)
    except FileNotFoundError:
        raise RecipeError(f"{path}: no such recipe; give a .toml file") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RecipeError(f"{path}: not valid TOML ({error}); see models/base.toml for an example") from None
    try:
        return _recipe(table)
    except RecipeError as error:
        raise RecipeError(f"{path}: {error}") from None


def _recipe(table: dict[str, Any]) -> AnyRecipe:
    kind = table.get("kind", "global")
    if kind not in ("global", "local", "scans"):
        raise RecipeError(f"kind must be 'scans', 'global' or 'local', not {kind!r}")
    if kind == "local":
        return LocalRecipe(**_checked(LocalRecipe, table))
    if kind == "scans":
        whole = table.pop("whole", {})
        if not isinstance(whole, dict):
            raise RecipeError("whole must be a table, [whole]")
        return ScanRecipe(**_checked(ScanRecipe, table), whole=_whole(whole))
    return _whole(table)


def _whole(table: dict[str, Any]) -> Recipe:
    augment = table.pop("augment", {})
    if not isinstance(augment, dict):
        raise RecipeError("augment must be a table, [augment]")
    return Recipe(**_checked(Recipe, table), augment=Augment(**_checked(Augment, augment)))


def _checked(cls: type, table: dict[str, Any]) -> dict[str, Any]:
    """The table's values, each a key of the dataclass and of its default's type."""
    defaults = {f.name: f.default for f in fields(cls) if f.default is not MISSING}  # without tables of their own
    values = {}
    for name, value in table.items():
        if name not in defaults:
            raise RecipeError(f"unknown key {name!r}; known are {', '.join(defaults)}")
        default: Any = defaults[name]
        if isinstance(default, float) and type(value) is int:
            value = float(value)
        if isinstance(default, tuple) and isinstance(value, list) and all(type(v) is int and v > 0 for v in value):
            value = tuple(value)
        if type(value) is not type(default):
            raise RecipeError(f"{name} must be {_kind(default)}, not {value!r}")
        values[name] = value
    return values


def _kind(default: Any) -> str:
    kinds = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
    return kinds.get(type(default), "a list of whole numbers above 0")
