from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.geometry.normals import principal_variances


def test_principal_variances_are_the_eigenvalues() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(200, 3, 3))
    A[:20, 2] = A[:20, 1]  # flat
    C = A @ A.transpose(0, 2, 1)
    six = C[:, 0, 0], C[:, 1, 1], C[:, 2, 2], C[:, 0, 1], C[:, 0, 2], C[:, 1, 2]
    assert np.stack(principal_variances(*six), 1) == pytest.approx(np.linalg.eigvalsh(C), abs=1e-9)
