"""Which weights are worked with: files that hold none are named."""

from __future__ import annotations

from pathlib import Path

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
