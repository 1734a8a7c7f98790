"""`fmr train`: from scans to weights that `fmr align` takes, interrupted in every way, refused on one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from safetensors.torch import load_file

from fmr_cli.cli import app

RECIPE = """
start = "scratch"
feature_dim = 32
hidden = [16, 16]
cloud_points = 256
points = 64
chamfer_batch = 4
pose_batch = 4
unroll = 2
epoch_steps = 5
held_out_pairs = 2
crops = 24
"""


@pytest.fixture
def recipe(tmp_path):
    (tmp_path / "tiny.toml").write_text(RECIPE)
    return tmp_path / "tiny.toml"


@pytest.mark.slow
def test_train_on_scans_from_the_bundled_weights(tmp_path, fmr, samples):
    (tmp_path / "quick.toml").write_text("held_out_pairs = 2\ncrops = 16\n")
    done = fmr("train", "--unsupervised", samples, "--recipe", "quick.toml", "--minutes", "0.01", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "runs/train"
    assert {f.name for f in run.iterdir()} >= {
        "model.safetensors", "README.md", "recipe.toml", "metrics.csv", "state.safetensors",
    }  # fmt: skip
    card = (run / "README.md").read_text()
    assert "16 crops of 2 scans" in card
    assert 'a recipe of kind "global" teaches the encoder of whole clouds alone' in done.stderr
    assert "started from base" in card
    assert "holds the start's" in done.stderr or "which is kept" in done.stderr
    aligned = fmr(
        "align", samples / "scan_a.ply", samples / "scan_b.ply", "--model", "runs/train/model.safetensors", cwd=tmp_path
    )
    assert aligned.returncode == 0, aligned.stderr


SCANS = """
kind = "scans"
rounds = 1
pairs = 4
single = 2
made_up = 4
patches = 24
others = 8
batch = 1
whole_every = 2
steps = 4
epoch_steps = 4
tested = 2
checked = 1
[whole]
crops = 16
held_out_pairs = 2
"""


@pytest.mark.slow
def test_scans_teach_all_that_registration_uses(tmp_path, fmr, samples):
    (tmp_path / "scans.toml").write_text(SCANS)
    (tmp_path / "scans").mkdir()
    for name in ("scan_a.ply", "scan_b.ply"):
        (tmp_path / "scans" / name).write_bytes((samples / name).read_bytes())
    (tmp_path / "scans/notes.txt").write_text("no scan")  # as folders have them
    done = fmr("train", "--unsupervised", "scans", "--recipe", "scans.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "round 1: 2 scans: 1 of 1 registered pairs aligned" in done.stderr
    assert "held-out pairs through align" in done.stderr
    run = tmp_path / "runs/train"
    assert {"model.safetensors", "training.png", "registered.json"} <= {f.name for f in run.iterdir()}
    card = (run / "README.md").read_text()
    assert "Held-out pairs through `fmr align`" in card
    assert "loss_info_nce" in (run / "metrics.csv").read_text()
    assert "loss_chamfer" in (run / "metrics.csv").read_text()
    names = load_file(run / "model.safetensors")
    assert {name.split(".")[0] for name in names} >= {"encoder", "local"}
    used = fmr(
        "multiway", "scans/scan_a.ply", "scans/scan_b.ply", "--out", "net", "--workers", 1,
        "--model", "runs/train/model.safetensors", cwd=tmp_path,
    )  # fmt: skip
    assert used.returncode == 0, used.stderr
    used = fmr("sequence", "scans", "--out", "poses.txt", "--model", "runs/train/model.safetensors", cwd=tmp_path)
    assert used.returncode == 0, used.stderr
    again = fmr("train", "--unsupervised", "scans", "--recipe", "runs/train/recipe.toml", "-o", "b", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    a, b = (load_file(tmp_path / run / "state.safetensors") for run in ("runs/train", "b"))
    assert all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.slow
def test_labelled_pairs_teach_the_local_encoder_too(tmp_path, fmr, samples):
    (tmp_path / "scans.toml").write_text(
        SCANS.replace("checked = 1", "checked = 0").replace("made_up = 4", "made_up = 0")
    )
    (tmp_path / "pairs.csv").write_text(
        f"source,target,transform\n{samples / 'scan_a.ply'},{samples / 'scan_b.ply'},{samples / 'truth.txt'}\n"
    )
    done = fmr("train", "--recipe", "scans.toml", "--pairs", "pairs.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "1 pairs of known pose" in done.stderr


def test_labelled_pairs_are_trained_on(tmp_path, fmr, samples, recipe):
    (tmp_path / "pairs.csv").write_text(
        f"source,target,transform\n{samples / 'scan_a.ply'},{samples / 'scan_b.ply'},{samples / 'truth.txt'}\n"
    )
    done = fmr("train", samples, "--recipe", recipe, "--pairs", "pairs.csv", "--epochs", "1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "1 labelled pairs" in done.stderr
    assert "loss_pose" in (tmp_path / "runs/train/metrics.csv").read_text()


def test_the_recipe_of_a_run_gives_the_same_weights_again(tmp_path, fmr, samples, recipe):
    first = fmr(
        "train", samples, "--recipe", recipe, "--semi-supervised", "--epochs", "1", "--overlap", "0.7", "-o", "a",
        cwd=tmp_path,
    )  # fmt: skip
    assert first.returncode == 0, first.stderr
    assert "overlap = 0.7" in (tmp_path / "a/recipe.toml").read_text()
    again = fmr("train", samples, "--recipe", "a/recipe.toml", "-o", "b", "-q", cwd=tmp_path)
    assert (again.returncode, again.stderr) == (0, "")
    a, b = (load_file(tmp_path / run / "state.safetensors") for run in "ab")
    assert all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.slow
def test_a_local_recipe_trains_the_encoder_of_patches(tmp_path, fmr, samples):
    (tmp_path / "local.toml").write_text('kind = "local"\npairs = 5\npatches = 24\nbatch = 2\nepoch_steps = 2\n')
    done = fmr("train", "--recipe", "local.toml", "--epochs", "1", "-o", "run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "pairs of procedural scans" in (tmp_path / "run/README.md").read_text()
    assert "the nearest descriptor is of the same place" in done.stderr
    weights = load_file(tmp_path / "run/model.safetensors")
    assert weights["head.1.weight"].shape == (32, 128)
    for arguments, said in (
        ((samples,), "leave SCANS and --pairs away"),
        (("--unsupervised",), "has a loss of its own"),
        (("--rotation", "3"), "has no rotation"),
    ):
        refused = fmr("train", "--recipe", "local.toml", "-o", "other", *arguments, cwd=tmp_path)
        assert refused.returncode == 2
        assert said in refused.stderr
        assert len(refused.stderr.splitlines()) == 1


@pytest.mark.slow
def test_kill_and_resume_end_in_the_same_weights(tmp_path, fmr, samples, recipe):
    arguments = ["train", str(samples), "--recipe", str(recipe), "--unsupervised", "--epochs", "4"]
    command = [sys.executable, "-m", "fmr_cli.cli", *arguments, "-o", "killed"]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        if line.startswith("epoch 2"):
            break
    time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    resumed = fmr("train", samples, "-o", "killed", "--resume", cwd=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    assert fmr(*arguments, "-o", "whole", cwd=tmp_path).returncode == 0
    for name in ("state.safetensors", "model.safetensors"):
        killed, whole = load_file(tmp_path / "killed" / name), load_file(tmp_path / "whole" / name)
        assert all(torch.equal(killed[key], whole[key]) for key in whole)


@pytest.mark.slow
def test_ctrl_c_keeps_the_best_so_far(tmp_path, samples, recipe):
    command = [
        sys.executable,
        "-m",
        "fmr_cli.cli",
        "train",
        str(samples),
        "--recipe",
        str(recipe),
        "--epochs",
        "100000",
    ]
    # A shell's background jobs ignore SIGINT, and so would what they start.
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        for line in process.stderr:
            if line.startswith("epoch 1"):
                break
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, said
    assert "stopped at step" in said
    assert (tmp_path / "runs/train/README.md").is_file()


@pytest.mark.slow
def test_two_processes_average_their_gradients(tmp_path, samples, recipe):
    command = [
        sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "fmr_cli.cli",
        "train", str(samples), "--unsupervised", "--recipe", str(recipe), "--epochs", "1", "-o", "two",
    ]  # fmt: skip
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "2 processes" in (tmp_path / "two/README.md").read_text()
    assert done.stderr.count("epoch 1, step 5") == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("{samples}",), "say how to learn"),
        (("--unsupervised",), "nothing to train on"),
        (("--unsupervised", "empty"), "empty: no scan in there"),
        (("--unsupervised", "{samples}", "--from", "none.safetensors"), "none.safetensors: no such model file"),
        (("--unsupervised", "{samples}", "--from", "bad.safetensors"), "bad.safetensors: not a safetensors file"),
        (("--recipe", "none.toml"), "none.toml: no such recipe"),
        (("--unsupervised", "{samples}", "--resume"), "--resume goes on with the settings saved"),
        (("{samples}", "--resume"), "there is no run to resume"),
        (("--unsupervised", "{samples}", "-o", "full"), "holds a run already"),
        (("--unsupervised", "{samples}", "-o", "bad.safetensors/run"), "cannot make this folder"),
        (("--unsupervised", "{samples}", "--pairs", "none.csv"), "has no use for poses"),
        (("--pairs", "none.csv", "{samples}"), "none.csv: no such file"),
    ],
)
def test_bad_input_is_one_line(tmp_path, fmr, samples, arguments, said):
    (tmp_path / "empty").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full/state.safetensors").write_text("a run")
    (tmp_path / "bad.safetensors").write_text("no weights")
    done = fmr("train", *(a.format(samples=samples) for a in arguments), cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert (tmp_path / "full/state.safetensors").read_text() == "a run"


def test_threads_that_wait_sleep_unless_the_user_says_otherwise(monkeypatch):
    monkeypatch.setattr(app, "app", lambda: None)
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    app.main()
    assert os.environ["OMP_WAIT_POLICY"] == "ACTIVE"
    monkeypatch.delenv("OMP_WAIT_POLICY")
    app.main()
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"
