"""A model's file: what training writes is read back as it was."""

from __future__ import annotations

from pathlib import Path

import torch

from fmr_cli.feature_metric.decoder import Decoder
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.training.weights import encoder_bytes, load_weights


def test_weights_go_to_a_file_and_back(tmp_path: Path) -> None:
    torch.manual_seed(0)
    bodies = torch.randn(2, 30, 3)
    encoder, decoder = Encoder(96, (16, 32)), Decoder(96, 50)
    (tmp_path / "e.safetensors").write_bytes(encoder_bytes(encoder, decoder))
    again, tensors = load_weights(tmp_path / "e.safetensors")
    assert torch.equal(again(bodies), encoder(bodies))
    decoder.load_state_dict(tensors)
    assert not any(p.requires_grad for p in again.parameters())
