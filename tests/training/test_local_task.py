"""The local encoder's training: its loss, its file, and a run that learns, is killed and goes on."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file
from safetensors.torch import load_file

from fmr_cli.descriptors.patch_encoder import LocalEncoder
from fmr_cli.errors import ModelError
from fmr_cli.registration.models import bundled_local_encoder
from fmr_cli.training.local_task import LocalNet, LocalTask, info_nce, read_local_start
from fmr_cli.training.local_views import Views, make_material, pair_arrays, pair_views
from fmr_cli.training.loop import Trainer
from fmr_cli.training.recipe import LocalRecipe

CPU = torch.device("cpu")
TINY = LocalRecipe(start="scratch", pairs=4, patches=32, batch=2, steps=6, epoch_steps=2, held_out=0.25)


@pytest.fixture(scope="module")
def material() -> list[Views]:
    return [pair_views((5, number), 32) for number in range(TINY.pairs)]


def finish(trainer: Trainer) -> list[dict]:
    return [report.row for report in trainer.run() if report.row]


def views_at(place: torch.Tensor, alias: torch.Tensor | None = None) -> Views:
    n = len(place)
    no = torch.zeros(n, n, dtype=torch.bool) if alias is None else alias
    return Views(torch.empty(n, 1, 1), torch.empty(n, 1, 1), place, place, n, no, no)


def test_info_nce_is_zero_where_each_row_fits_its_own_alone():
    views = views_at(torch.arange(4.0)[:, None] * 10 * torch.ones(3))
    assert float(info_nce(torch.eye(4), torch.eye(4), views, 0.01, 3)) == pytest.approx(0, abs=1e-6)
    mixed = torch.eye(4)[[1, 0, 3, 2]]
    assert float(info_nce(torch.eye(4), mixed, views, 0.1, 3)) > 5


def test_near_places_and_aliases_do_not_repel():
    views = views_at(torch.tensor([[0.0, 0, 0], [1, 0, 0]]))
    same = torch.ones(2, 1)
    assert float(info_nce(same, same, views, 0.1, apart=3)) == pytest.approx(0, abs=1e-6)
    assert float(info_nce(same, same, views, 0.1, apart=0.5)) == pytest.approx(np.log(2))
    alias = views_at(views.place, ~torch.eye(2, dtype=torch.bool))
    assert float(info_nce(same, same, alias, 0.1, apart=0.5)) == pytest.approx(0, abs=1e-6)


def test_what_is_in_one_scan_alone_repels():
    views = views_at(torch.tensor([[0.0, 0, 0], [9, 0, 0]]))
    views.common, views.alias, views.alias_target = 1, views.alias[:1], views.alias_target[:1]
    same = torch.ones(2, 1)
    assert float(info_nce(same, same, views, 0.1, apart=3)) == pytest.approx(np.log(2))


def test_views_are_the_same_for_any_number_of_workers(material):
    seen = []
    again = make_material(2, 32, 5, lambda done, total: seen.append((done, total)), workers=1)
    assert seen == [(1, 2), (2, 2)]
    assert all(
        torch.equal(a.source, b.source) and torch.equal(a.place, b.place)
        for a, b in zip(again, material[:2], strict=True)
    )


def test_the_file_is_what_registration_reads(tmp_path, material):
    task = LocalTask(TINY, material, CPU, None)
    (tmp_path / "l.safetensors").write_bytes(task.weights())
    patches = material[0].source.float()
    described = LocalEncoder.load(tmp_path / "l.safetensors")(patches.numpy())
    np.testing.assert_allclose(described, task.net(patches).detach().numpy(), atol=1e-5)


def test_training_starts_from_the_bundled_weights_and_is_better_than_nothing(material):
    patches = material[0].source.float()
    bundled = LocalTask(TINY, material, CPU, read_local_start("base"))
    np.testing.assert_allclose(
        bundled.net(patches).detach().numpy(), bundled_local_encoder()(patches.numpy()), atol=1e-5
    )
    untrained = LocalTask(TINY, material, CPU, None)
    assert bundled.quality(bundled.test()) > untrained.quality(untrained.test())


@pytest.mark.slow
def test_a_run_learns_and_its_best_is_kept(tmp_path, material):
    recipe = TINY.changed(steps=60, epoch_steps=30)
    rows = finish(Trainer(LocalTask(recipe, material, CPU, None), tmp_path))
    assert rows[-1]["loss_info_nce"] < rows[1]["loss_info_nce"]
    LocalNet().load_state_dict(load_file(tmp_path / "model.safetensors"))


def test_a_run_that_ends_anywhere_goes_on_to_the_same_numbers(tmp_path, material):
    (tmp_path / "whole").mkdir()
    (tmp_path / "killed").mkdir()
    finish(Trainer(LocalTask(TINY, material, CPU, None), tmp_path / "whole"))
    for report in Trainer(LocalTask(TINY, material, CPU, None), tmp_path / "killed").run():
        if report.step == 3:
            break
    finish(Trainer(LocalTask(TINY, material, CPU, None), tmp_path / "killed", resume=True))
    whole, killed = (load_file(tmp_path / run / "state.safetensors") for run in ("whole", "killed"))
    assert all(torch.equal(whole[name], killed[name]) for name in whole)


@pytest.mark.parametrize(("name", "said"), [("none.safetensors", "no such model"), ("bad.safetensors", "not a safe")])
def test_what_is_no_start_is_one_line(tmp_path, name, said):
    (tmp_path / "bad.safetensors").write_text("no weights")
    with pytest.raises(ModelError, match=said):
        read_local_start(str(tmp_path / name))


def test_weights_of_another_encoder_are_one_line(tmp_path):
    save_file({"point.0.weight": np.zeros((3, 3), np.float32)}, tmp_path / "other.safetensors")
    with pytest.raises(ModelError, match="do not fit the local encoder") as error:
        read_local_start(str(tmp_path / "other.safetensors"))
    assert "\n" not in str(error.value)


def test_a_network_goes_on_from_layers_of_any_width(material):
    wide = LocalNet(point=(8, 24), head=(16, 32))
    again = LocalNet.of(wide.state_dict())
    patches = material[0].source.float()
    assert torch.equal(again(patches), wide(patches))


def test_a_thousand_pairs_do_not_come_as_open_files():
    plain = pair_arrays((5, 0), 32, 0)
    assert not any(isinstance(value, torch.Tensor) for value in plain.values())
