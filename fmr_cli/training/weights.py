"""What training reads and writes of a model's file: the encoder, and the decoder for further training."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.io.weights import Weights, read_weights, weights_bytes
from fmr_cli.registration.models import bundled_encoder


def encoder_bytes(encoder: Encoder, decoder: nn.Module | None = None) -> bytes:
    """The weights as a file; a decoder's go along where one is given."""
    tensors = {} if decoder is None else decoder.state_dict()
    arrays = {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}
    return weights_bytes(Weights(encoder.hidden, encoder.feature_dim, encoder.arrays(), arrays))


def load_weights(path: Path | str) -> tuple[Encoder, dict[str, Tensor]]:
    """The encoder and the decoder's tensors, none where the file has none. Raises ModelError: missing, does not fit.

    Of a file that holds no encoder of whole clouds, the bundled one.
    """
    weights = read_weights(path)
    if not weights.layers:
        return bundled_encoder(), {}
    return Encoder.of(weights.layers), {name: torch.from_numpy(array) for name, array in weights.decoder.items()}
