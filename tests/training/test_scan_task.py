"""Learning from scans that are registered with each other: material, held-out tests, a killed run that goes on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from scipy.spatial.transform import Rotation

from fmr_cli import PointCloud, write_cloud
from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.errors import ModelError
from fmr_cli.multiway.scans import Scan
from fmr_cli.registration import Options, prepare
from fmr_cli.registration.models import model
from fmr_cli.synthetic import scenes
from fmr_cli.training.local_views import PATCH_RADIUS, aliases
from fmr_cli.training.loop import Trainer
from fmr_cli.training.recipe import ScanRecipe
from fmr_cli.training.scan_material import ROUNDS, held_out, read_rounds
from fmr_cli.training.scan_task import ScanTask, local_start
from fmr_cli.training.scan_views import (
    Overlapping,
    drawn_views,
    inlier_ratio,
    made_up_pair,
    seen_twice,
    visible,
    whole_views,
)
from fmr_cli.training.self_registration import BLOCK, drawn, of_all_bands, register_scans, settled

CPU = torch.device("cpu")
TINY = ScanRecipe(
    rounds=2, pairs=4, single=2, made_up=0, patches=24, others=8, whole_every=0, steps=4, epoch_steps=2, tested=2,
    checked=0, batch=1,
)  # fmt: skip


@pytest.fixture(scope="module")
def room() -> list[np.ndarray]:
    """Five scans of a furnished room, each in a frame of its own, and the poses that put them there."""
    rng = np.random.default_rng(3)
    scene, found = scenes.room(rng), []
    for k in range(5):
        eye = np.array([0.2 * k - 0.4, 0.1 * k, 1.4])
        found.append(scenes.room_scan(scene, rng, eye, 0.25 * k, views=4)[::3])
    return found


@pytest.fixture(scope="module")
def files(room, tmp_path_factory) -> tuple[list[Scan], list[np.ndarray]]:
    folder, poses = tmp_path_factory.mktemp("scans"), []
    rng = np.random.default_rng(4)
    scans = []
    for k, points in enumerate(room):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 3, 3)
        write_cloud(folder / f"scan_{k}.ply", PointCloud(transform_points(T, points)))
        poses.append(T)
        scans.append(Scan(f"scan_{k}", folder / f"scan_{k}.ply"))
    return scans, poses


@pytest.fixture(scope="module")
def found(files):
    return register_scans(files[0][:4], list(range(4)), None, 12, 0)


def test_scans_register_themselves_and_every_pair_of_a_part_has_a_pose(files, found):
    poses = files[1]
    assert len(found.pairs) >= 4
    for pair in found.pairs:
        truth = poses[pair.target] @ np.linalg.inv(poses[pair.source])
        E = np.linalg.inv(truth) @ np.array(pair.T_target_source)
        assert angle_degrees(E) < 3
        assert 0.1 <= pair.overlap <= 1
    assert "pairs show one place" in found.said


def test_a_pose_that_follows_from_others_is_believed_where_neither_scan_lacks_a_thing(room, monkeypatch):
    """Two scans of a room that no link joins: at the true pose, and at one where floors fit and walls don't."""
    scans = [prepare(PointCloud(points)) for points in room[:2]]
    survey = SimpleNamespace(
        links={}, edges=dict.fromkeys(range(2), 0.05), options=Options(), frames=[s.frame for s in scans],
        description=lambda n, edge: SimpleNamespace(moment=np.eye(4)),
        store=SimpleNamespace(prepared=scans.__getitem__),
    )  # fmt: skip
    true = np.eye(4)
    true[:3, 3] = scans[0].centre - scans[1].centre
    beside = true.copy()
    beside[:3, 3] += 0.1, 0.0, 0.0
    found = settled(survey, 0, 1, true, 0.2)
    assert found is not None
    assert angle_degrees(np.array(found.T_target_source)) < 1
    assert settled(survey, 0, 1, beside, 0.2) is None
    monkeypatch.setattr("fmr_cli.training.self_registration.LACKING", 1.0)
    assert settled(survey, 0, 1, beside, 0.2) is not None  # more speaks for it than against it: that is not enough


@pytest.mark.slow
def test_scans_that_share_nothing_and_broken_files_are_said(tmp_path, files):
    rng = np.random.default_rng(0)
    (tmp_path / "broken.ply").write_text("ply\nnothing")
    other = scenes.thing_scan(scenes.thing(rng), rng, rng.normal(size=3), 2)
    write_cloud(tmp_path / "other.ply", PointCloud(other))
    scans = [files[0][0], Scan("other", tmp_path / "other.ply"), Scan("broken", tmp_path / "broken.ply")]
    found = register_scans(scans, [0, 1, 2], None, 12, 0)
    assert found.pairs == []
    assert "learning from single scans alone" in found.said
    assert found.scans == [0, 1]
    assert len(found.skipped) == 1
    assert "broken.ply" in found.skipped[0]


def test_scans_that_are_all_in_one_part_are_not_registered_again(files, found):
    assert found.joined()
    apart = replace(found, scans=[*found.scans, 9])
    assert not apart.joined()
    assert not replace(found, pairs=[]).joined()


def facade(rng: np.random.Generator, start: float, bay: float = 2.0, length: float = 12.0) -> np.ndarray:
    """A scan (n, 3) of a wall with a window in each bay, from ``start`` on; neither end of it is in sight."""
    x, y = start + rng.uniform(0, length, 9000), rng.uniform(0, 3, 9000)
    window = (np.abs(x % bay - bay / 2) < 0.5) & (np.abs(y - 1.6) < 0.7)
    return np.column_stack([x, y, np.where(window, 0.3, 0.0)]) + rng.normal(0, 0.004, (9000, 3))


def sphere(rng: np.random.Generator, start: float) -> np.ndarray:
    """A scan (n, 3) of a ball, which looks the same from everywhere."""
    d = rng.normal(size=(6000, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True) + rng.normal(0, 0.004, d.shape)


@pytest.mark.slow
@pytest.mark.parametrize("surface", [facade, sphere])
def test_of_scans_that_are_all_alike_no_alias_is_taken_for_the_truth(tmp_path, surface):
    rng, scans = np.random.default_rng(0), []
    for k in range(3):
        T = np.eye(4)
        T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        write_cloud(tmp_path / f"{k}.ply", PointCloud(transform_points(T, surface(rng, 4.3 * k))))
        scans.append(Scan(str(k), tmp_path / f"{k}.ply"))
    found = register_scans(scans, list(range(3)), None, 12, 0)
    assert found.pairs == []
    assert "learning from single scans alone" in found.said


def test_of_ten_thousand_scans_some_rows_are_drawn():
    rng = np.random.default_rng(0)
    some = drawn(10_000, 40, rng)
    assert len(some) == len(set(some)) == 40
    assert max(some) < 10_000
    gaps = np.diff(some)
    assert (gaps <= BLOCK).mean() > 0.8  # most have a neighbour that overlaps
    assert drawn(7, 40, rng) == list(range(7))


def test_all_bands_of_overlap_are_drawn():
    candidates = [(k, 0, np.eye(4), share) for k, share in enumerate([0.9] * 30 + [0.4] * 3 + [0.15] * 3)]
    shares = [c[3] for c in of_all_bands(candidates, 9, np.random.default_rng(0))]
    assert sorted(shares) == [0.15] * 3 + [0.4] * 3 + [0.9] * 3


def test_views_show_one_place(room):
    a, b = room[0], room[1]
    pair = Overlapping(a, b, np.eye(4), 0.06)  # both in the scene's frame
    views = drawn_views(pair, np.random.default_rng(0), 48, 16, touch=False)
    assert views is not None
    n = views.common
    assert 16 <= n <= 48
    off = (views.place[:n] - views.place_target[:n]).norm(dim=1)
    assert float(off.max()) < 2
    alone = views.place_target[n:]
    assert len(alone)
    nearest = torch.cdist(views.place[:n], alone).amin(0)
    assert float(nearest.min()) > 1  # what is in one scan alone is no view of the others' places


def test_matches_of_a_perfect_encoder_are_right(room):
    views = whole_views(Overlapping(room[0], room[0], np.eye(4), 0.06), 100)
    ideal = np.eye(len(views.place))
    assert inlier_ratio(ideal, ideal, views) == 1.0
    assert inlier_ratio(ideal, np.roll(ideal, 50, axis=0), views) < 0.1


def test_two_parts_of_a_scan_share_what_is_asked_for(room):
    for share in (0.2, 0.75):
        parts = seen_twice(room[0], np.random.default_rng(1), share)
        moved = transform_points(parts.T_target_source, parts.source)
        from fmr_cli.synthetic.sensors import overlap

        assert max(overlap(moved, parts.target, 1.5 * parts.edge)) == pytest.approx(share, abs=0.3)
    assert seen_twice(room[0][:300], np.random.default_rng(1)) is None


def test_what_hides_behind_is_not_visible():
    front = np.column_stack([np.random.default_rng(0).uniform(-1, 1, (4000, 2)), np.zeros(4000)])
    both = np.concatenate([front, front + np.array([0, 0, 0.5])])
    for seed in range(5):
        seen = visible(both, np.random.default_rng(seed), 0.05)
        assert 0.3 * len(both) < len(seen) < 0.95 * len(both)


def test_repeated_patches_are_aliases_and_others_are_not():
    rng = torch.Generator().manual_seed(0)
    shapes = torch.rand(6, 64, 10, generator=rng) * 2 - 1
    own = shapes + 0.02 * torch.randn(6, 64, 10, generator=rng)
    other = shapes.clone()
    other[5] = other[0] + 0.001 * torch.randn(64, 10, generator=rng)  # a second window, as alike as can be
    found = aliases(own[:5], other, 5)
    assert found.shape == (5, 6)
    assert found[0, 5]
    assert int(found.sum()) == 1
    assert PATCH_RADIUS > 0


def test_some_scans_are_held_out_and_never_all():
    assert held_out(1, 0.2, 0) == set()
    assert len(held_out(2, 0.2, 0)) == 1
    assert len(held_out(10, 0.2, 0)) == 2
    assert len(held_out(100, 0.2, 0)) == 20
    assert held_out(100, 0.2, 0) == held_out(100, 0.2, 0) != held_out(100, 0.2, 1)


def trainer(files, folder: Path, resume: bool = False, **changes) -> Trainer:
    folder.mkdir(exist_ok=True)
    task = ScanTask(replace(TINY, **changes), files[0], CPU, None, None)
    return Trainer(task, folder, resume=resume)


def finish(trainer: Trainer) -> list[str]:
    return [note for report in trainer.run() for note in report.notes]


@pytest.mark.slow
def test_a_run_that_is_killed_in_its_second_round_goes_on_to_the_same_weights(tmp_path, files):
    files = (files[0][:3], files[1])
    whole = trainer(files, tmp_path / "whole")
    notes = finish(whole)
    assert [n[:8] for n in notes] == ["round 1:", "round 2:"]
    for report in trainer(files, tmp_path / "killed").run():
        if report.step == 3:  # the second round has begun, its epoch is not saved
            break
    finish(trainer(files, tmp_path / "killed", resume=True))
    for name in ("state.safetensors", "model.safetensors"):
        a, b = (load_file(tmp_path / run / name) for run in ("whole", "killed"))
        assert all(torch.equal(a[key], b[key]) for key in a)
    assert (tmp_path / "whole" / ROUNDS).read_text() == (tmp_path / "killed" / ROUNDS).read_text()


def test_the_file_is_a_whole_model(tmp_path, files, found):
    (tmp_path / ROUNDS).write_text(json.dumps([found.plain()]))  # the run goes on behind its first registration
    run = trainer((files[0][:4], files[1]), tmp_path, rounds=1)
    finish(run)
    kept = model(tmp_path / "model.safetensors")
    assert np.array_equal(kept.whole.layers[0][0], model().whole.layers[0][0])
    assert kept.local.key == model().local.key or run.progress.best > 0
    text = "\n".join(run.task.card())
    assert "Round 1" in text
    material = run.task.material
    assert not material.held_out & {n for p in material.rounds[0].pairs if material.trains(p) for n in p.ends}


@pytest.mark.slow
def test_one_scan_alone_learns_from_its_parts(tmp_path, files):
    task = ScanTask(replace(TINY, rounds=1, steps=2), files[0][:1], CPU, None, None)
    notes = finish(Trainer(task, tmp_path))
    assert "one scan" in notes[0]
    assert task.material.views["single"]
    assert task.material.tests["held-out scans"]


def test_what_is_kept_lies_between_the_start_and_what_the_steps_have_led_to(files):
    task = ScanTask(replace(TINY, stays=0.25), files[0], CPU, None, None)
    first = {name: value.clone() for name, value in task.net.state_dict().items()}
    assert all(np.array_equal(value, first[name]) for name, value in task.learnt().items())  # bit for bit
    with torch.no_grad():
        for value in task.net.parameters():
            value += 1.0
    for name, value in task.learnt().items():
        np.testing.assert_allclose(value, first[name].numpy() + 0.75, rtol=1e-6, atol=1e-6)
    scratch = ScanTask(replace(TINY, start="scratch"), files[0], CPU, None, None)
    assert all(np.array_equal(value, scratch.net.state_dict()[name]) for name, value in scratch.learnt().items())


def test_forgetting_counts_as_no_gain(files):
    task = ScanTask(TINY, files[0], CPU, None, None)
    task.start_scores = {"held-out scans": {"right matches": 0.2}, "made-up scans": {"right matches": 0.3}}
    gained = {"held-out scans": {"right matches": 0.5}, "made-up scans": {"right matches": 0.29}}
    forgot = {"held-out scans": {"right matches": 0.5}, "made-up scans": {"right matches": 0.2}}
    assert task.quality(gained) == (0.5,)
    assert task.quality(forgot) == (0.0,)


def test_a_start_that_is_no_local_encoder_and_spoilt_rounds_are_one_line(tmp_path):
    from safetensors.numpy import save_file

    save_file({"local.point.0.weight": np.zeros((3, 3), np.float32)}, str(tmp_path / "x.safetensors"))
    with pytest.raises(ModelError, match="do not fit the local encoder"):
        local_start(tmp_path / "x.safetensors")
    (tmp_path / ROUNDS).write_text("[{")
    with pytest.raises(ModelError, match="no rounds to resume") as error:
        read_rounds(tmp_path / ROUNDS)
    assert "\n" not in str(error.value)


def test_made_up_pairs_are_the_same_each_time():
    a, b = made_up_pair((1, 2)), made_up_pair((1, 2))
    assert np.array_equal(a.source, b.source)
    assert len(a.source) >= 500


def test_a_timed_run_registers_no_more_often_than_leaves_time_for_steps(files, found):
    for seconds, rounds in ((100, 1), (300, 2), (10_000, 3)):
        task = ScanTask(replace(TINY, rounds=3), files[0][:4], CPU, None, None)
        task.material.rounds = [found]
        assert task.fit_renewals(seconds, each=60) == {"rounds": rounds}
        assert task.renewals() == rounds - 1
        assert task.material.round_at(99, 100) == rounds - 1


@pytest.mark.slow
def test_the_file_keeps_the_site_of_all_scans_also_of_those_that_were_held_out(tmp_path, files, found):
    poses = files[1]
    placed = {n: np.linalg.inv(T).tolist() for n, T in enumerate(poses)}
    known = replace(found, scans=list(range(5)), parts=[placed])
    for points in (20_000, 0):
        folder = tmp_path / str(points)
        folder.mkdir()
        (folder / ROUNDS).write_text(json.dumps([known.plain()]))
        run = trainer(files, folder, rounds=1, steps=2, site_points=points)
        notes = finish(run)
        kept = model(folder / "model.safetensors").weights.sites
        assert len(kept) == (points > 0)
        assert [note for note in notes if "the model keeps" in note] == (
            [f"the model keeps {len(kept[0]):,} points of a site that 5 scans show"] if kept else []
        )
        assert sum(map(len, kept)) <= points
        assert run.task.material.held_out  # of which the site shows what the others do not
    assert read_rounds(folder / ROUNDS)[0].parts == [placed]
