"""Which weights are worked with: files that hold none are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from fmr_cli.errors import ModelError
from fmr_cli.registration.models import load_encoder


def test_files_that_hold_no_encoder_are_named(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    with pytest.raises(ModelError, match=r"none\.safetensors: no such model file"):
        load_encoder(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("not weights")
    with pytest.raises(ModelError, match=r"text\.safetensors: not a safetensors file"):
        load_encoder(tmp_path / "text.safetensors")
    save_file({"a": torch.zeros(3)}, str(tmp_path / "other.safetensors"))
    with pytest.raises(ModelError, match=r"other\.safetensors: the weights do not fit"):
        load_encoder(tmp_path / "other.safetensors")


def test_one_file_holds_both_encoders_and_the_verdict_and_registration_uses_all(
    tmp_path: Path, scan_pair_files
) -> None:
    from dataclasses import replace

    from fmr_cli.io import read_cloud
    from fmr_cli.io.weights import weights_bytes
    from fmr_cli.registration import Options, prepare
    from fmr_cli.registration.confidence import Judge
    from fmr_cli.registration.models import model
    from fmr_cli.registration.pair import make_pair
    from fmr_cli.registration.verdict_weights import bundled_weights

    given = {f: np.asarray(v).tolist() for f, v in vars(bundled_weights()).items()}
    given["verdict"][0] += 1.0
    own = replace(model().weights, verdict=given, local={n: 2 * a for n, a in model().weights.local.items()})
    path = tmp_path / "all.safetensors"
    path.write_bytes(weights_bytes(own))
    source, target = (prepare(read_cloud(f)) for f in scan_pair_files)
    bundled, other = (make_pair(source, target, Options(model=m)) for m in (None, path))
    a, b = (pair.described(source)[1] for pair in (bundled, other))  # one cloud, which keeps what it has described
    assert not np.allclose(a, b)
    assert Judge(other).weights.verdict[0] == pytest.approx(Judge(bundled).weights.verdict[0] + 1)
    assert np.array_equal(other.encoder.layers[0][0], bundled.encoder.layers[0][0])
    path.write_bytes(weights_bytes(replace(own, verdict=None, local={})))  # written anew: read anew
    again = make_pair(source, target, Options(model=path))
    assert np.array_equal(again.described(source)[1], a)
    assert Judge(again).weights is bundled_weights()


def test_a_file_of_patches_alone_leaves_the_rest_as_it_is(tmp_path: Path) -> None:
    from fmr_cli.registration.models import bundled_local_path, model

    with bundled_local_path() as path:
        found = model(path)
    assert found.local.key == model().local.key
    assert np.array_equal(found.whole.layers[0][0], model().whole.layers[0][0])


def test_patches_of_another_encoder_are_one_line(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    from fmr_cli.registration.models import local_encoder

    save_file(
        {"local.point.0.weight": np.zeros((3, 3)), "local.point.0.bias": np.zeros(3)}, str(tmp_path / "l.safetensors")
    )
    with pytest.raises(ModelError, match=r"l\.safetensors: the weights do not fit the local encoder"):
        local_encoder(tmp_path / "l.safetensors")


@pytest.fixture
def scan_pair_files() -> tuple[Path, Path]:
    samples = Path(__file__).parents[2] / "samples"
    return samples / "scan_a.ply", samples / "scan_b.ply"


def test_a_calibration_of_another_version_s_evidence_gives_way_to_the_bundled_one() -> None:
    from fmr_cli.registration.verdict_weights import bundled_weights, usable

    given = {name: values.tolist() for name, values in vars(bundled_weights()).items()}
    own = usable(given | {"fit": [1.0, 2.0, 3.0, 4.0], "made by": "hand"})
    assert own.fit.tolist() == [1, 2, 3, 4]
    lacking = {name: values for name, values in given.items() if name != "mean"}
    for other in (None, {}, lacking, given | {"fit": [1.0, 2.0]}):
        assert usable(other) is bundled_weights()
