"""The loop: a resumed run ends where an uninterrupted one does; the best is kept; a NaN stops it with nothing lost."""

from __future__ import annotations

import csv
import resource

import pytest
import torch
from safetensors.torch import load_file

from fmr_cli.errors import FmrError, ModelError
from fmr_cli.registration.models import load_encoder
from fmr_cli.training.global_task import GlobalTask, read_start
from fmr_cli.training.loop import Trainer, step_seed
from fmr_cli.training.run_folder import TrainingError
from fmr_cli.training.weights import load_weights


def finish(trainer):
    return finish_reports(trainer.run())


def finish_reports(reports):
    return [report.row for report in reports if report.row]


@pytest.fixture(scope="module")
def whole(tmp_path_factory, tiny, data):
    """An uninterrupted run: (folder, rows, trainer)."""
    folder = tmp_path_factory.mktemp("whole")
    trainer = Trainer(GlobalTask(tiny, data, None), folder)
    return folder, finish(trainer), trainer


@pytest.mark.parametrize("steps_before_the_end", [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 5))])
def test_a_run_that_ends_anywhere_goes_on_to_the_same_numbers(tmp_path, tiny, data, whole, steps_before_the_end):
    folder, rows, _ = whole
    for report in Trainer(GlobalTask(tiny, data, None), tmp_path).run():
        if report.step == steps_before_the_end:
            break
    finish(Trainer(GlobalTask(tiny, data, None), tmp_path, resume=True))
    for name in ("state.safetensors", "model.safetensors"):
        ours, theirs = load_file(tmp_path / name), load_file(folder / name)
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    epochs = [row["success"] for row in csv.DictReader((tmp_path / "metrics.csv").open())]
    assert epochs == [str(row["success"]) for row in rows]


def test_the_best_epoch_is_kept(whole):
    folder, rows, trainer = whole
    assert len(rows) == 4
    assert trainer.progress.best == max(range(4), key=trainer.quality)
    assert load_encoder(folder / "model.safetensors").feature_dim == 32


def test_weights_go_on_with_their_decoder(whole):
    folder, _, _ = whole
    encoder, decoder = load_weights(folder / "model.safetensors")
    assert encoder.hidden == (16, 16)
    assert decoder


def test_a_new_decoder_is_trained_before_it_may_change_a_trained_encoder(tmp_path, tiny, data, whole):
    start = (load_encoder(whole[0] / "model.safetensors"), {})
    before = {name: value.clone() for name, value in start[0].state_dict().items()}
    recipe = tiny.changed(pose_weight=0.0, decoder_warmup=4, steps=4)
    trainer = Trainer(GlobalTask(recipe, data, start), tmp_path)
    first = {name: value.clone() for name, value in trainer.task.decoder.state_dict().items()}
    finish(trainer)
    assert all(torch.equal(value, before[name]) for name, value in trainer.task.encoder.state_dict().items())
    assert any(not torch.equal(value, first[name]) for name, value in trainer.task.decoder.state_dict().items())


def test_anchors_come_first_then_a_new_decoder_alone_then_the_rest(tmp_path, tiny, data):
    trainer = Trainer(GlobalTask(tiny.changed(anchor_steps=3, decoder_warmup=2, steps=7), data, None), tmp_path)
    seen = []
    for _ in range(7):
        before = trainer.task.encoder.layers[0].weight.detach().clone()
        losses = sorted(trainer.step())
        seen.append((losses, bool((trainer.task.encoder.layers[0].weight != before).any())))
    both = ["chamfer", "pose"]
    assert [losses for losses, _ in seen] == [["anchors"]] * 3 + [["chamfer"]] * 2 + [both] * 2
    assert [moved for _, moved in seen] == [True] * 3 + [False] * 2 + [True] * 2


def test_a_loss_that_is_not_finite_stops_the_run_and_keeps_what_there_was(tmp_path, tiny, data):
    trainer = Trainer(GlobalTask(tiny, data, None), tmp_path)
    reports = trainer.run()
    while next(reports).step < 3:
        pass
    with torch.no_grad():
        trainer.task.encoder.layers[0].weight.fill_(float("nan"))
    with pytest.raises(TrainingError, match=r"not finite at step 3; .*model.safetensors holds the best weights"):
        finish_reports(reports)
    kept = load_encoder(tmp_path / "model.safetensors")
    assert all(bool(torch.isfinite(p).all()) for p in kept.parameters())


def test_minutes_bound_the_run_and_the_plan_is_saved(tmp_path, tiny, data):
    trainer = Trainer(GlobalTask(tiny.changed(steps=10**9, epoch_steps=1000), data, None), tmp_path, minutes=0.02)
    finish(trainer)
    assert trainer.progress.step < 10_000
    assert trainer.progress.seconds < 30


@pytest.mark.parametrize("spoil", ["text", "other architecture"])
def test_a_state_that_does_not_fit_is_one_line(tmp_path, tiny, data, whole, spoil):
    state = (whole[0] / "state.safetensors").read_bytes()
    (tmp_path / "state.safetensors").write_bytes(b"no state" if spoil == "text" else state)
    recipe = tiny if spoil == "text" else tiny.changed(feature_dim=48)
    with pytest.raises(ModelError, match=r"state.safetensors: no state to resume") as error:
        Trainer(GlobalTask(recipe, data, None), tmp_path, resume=True)
    assert "\n" not in str(error.value)


def test_unknown_weights_to_start_from_are_one_line(tmp_path):
    with pytest.raises(FmrError, match="no such model file"):
        read_start(str(tmp_path / "none.safetensors"))


def test_a_full_disk_is_one_line_and_loses_nothing(tmp_path, tiny, data):
    reports = Trainer(GlobalTask(tiny, data, None), tmp_path).run()
    next(reports)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))  # stands in for the full disk
    try:
        with pytest.raises(FmrError, match=r"safetensors: cannot be written") as error:
            finish_reports(reports)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(error.value)
    kept = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    assert {name: kept[name] for name in before if name != "metrics.csv"} == {
        name: value for name, value in before.items() if name != "metrics.csv"
    }
    assert not [name for name in kept if ".tmp" in name]


def test_every_step_and_process_draws_its_own_numbers():
    seeds = {step_seed(seed, step, rank) for seed in range(3) for step in range(50) for rank in range(2)}
    assert len(seeds) == 300
    assert step_seed(0, 1, 2) == 3071860871404845570  # the same on every machine
