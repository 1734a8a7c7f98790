"""Training pairs: the transform that comes with a pair is the one between its clouds."""

from __future__ import annotations

import pytest
import torch

from fmr_cli.geometry import se3
from fmr_cli.synthetic.batches import Augment, draw_pairs
from fmr_cli.synthetic.shapes import others, shapes


@pytest.fixture(scope="module")
def pool():
    return torch.from_numpy(shapes(8, 2048, seed=0))


def draw(pool, **augment):
    generator = torch.Generator().manual_seed(3)
    return draw_pairs(pool, 8, 512, Augment(**{"noise": 0.0, "density": 1.0, **augment}), generator)


def covered(pairs):
    """Share of each target that has a source point near, once the source is moved by the truth."""
    moved = se3.transform(pairs.truth, pairs.source)
    return (torch.cdist(pairs.target, moved).amin(2) < 0.06).float().mean(1)


@pytest.mark.parametrize("centre", [True, False])
def test_the_truth_moves_the_source_onto_the_target(pool, centre):
    pairs = draw(pool, overlap=1.0, centre=centre)
    assert float(covered(pairs).min()) > 0.9
    assert float((pairs.truth[:, :3, :3] - torch.eye(3)).abs().amax()) > 0.1


def test_the_overlap_is_what_was_asked_for(pool):
    share = covered(draw(pool, overlap=0.6, whole=0.0))
    assert float(share.min()) > 0.5
    assert float(share.mean()) < 0.95


def test_clouds_are_centred_and_fill_the_unit_box(pool):
    pairs = draw(pool, offset=0.0)
    assert float(pairs.source.mean(1).abs().max()) < 1e-5
    assert float(pairs.target.mean(1).abs().max()) < 1e-5
    extent = torch.maximum(pairs.source.abs().amax((1, 2)), pairs.target.abs().amax((1, 2)))
    assert torch.allclose(extent, torch.full((8,), 0.5))


def test_a_sparse_source_keeps_its_share_of_the_points(pool):
    sizes = set()
    for seed in range(12):
        augment, generator = Augment(density=0.1), torch.Generator().manual_seed(seed)
        sizes.add(draw_pairs(pool, 2, 512, augment, generator).source.shape[1])
    assert min(sizes) < 256 < max(sizes)
    assert min(sizes) >= 51


@pytest.mark.parametrize("kind", [shapes, others])
def test_procedural_shapes_are_normalised_and_repeatable(kind):
    clouds = kind(12, 300, seed=5)
    assert clouds.shape == (12, 300, 3)
    assert abs(clouds.mean(1)).max() < 1e-5
    assert abs(clouds).max((1, 2)) == pytest.approx(0.5)
    assert (clouds == kind(12, 300, seed=5)).all()
