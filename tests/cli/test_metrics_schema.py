"""The metrics' schema: what scripts read from `--metrics` changes only on purpose, and with the golden file."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

GOLDEN = Path(__file__).with_name("metrics_schema.json")


def schema(value: Any) -> Any:
    """Keys and JSON types of a value; of a list, its length and what its first element is."""
    if isinstance(value, dict):
        return {name: schema(held) for name, held in value.items()}
    if isinstance(value, list):
        return [len(value), schema(value[0])] if value else [0]
    for kind, name in ((bool, "boolean"), (int, "integer"), (float, "number"), (str, "string")):
        if isinstance(value, kind):
            return name
    assert value is None
    return "null"


def test_the_metrics_have_the_keys_and_types_of_the_golden_file(fmr, samples, tmp_path):
    done = fmr("align", samples / "scan_a.ply", samples / "scan_b.ply", "--metrics", tmp_path / "m.json")
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "m.json").read_text())
    assert "total" in metrics["seconds"]
    assert set(map(type, metrics["seconds"].values())) == {float}
    metrics["seconds"] = {"total": metrics["seconds"]["total"]}
    for name, kind in (("warnings", str), ("undetermined", str), ("feature_errors", float)):  # as many as there are
        assert all(type(value) is kind for value in metrics.pop(name))
    alternative = {"T_target_source", "confidence", "feature_error"}
    assert all(set(found) == alternative for found in metrics.pop("alternatives"))
    found = schema(metrics)
    if os.environ.get("FMR_UPDATE_GOLDEN"):
        GOLDEN.write_text(json.dumps(found, indent=1) + "\n")
    assert found == json.loads(GOLDEN.read_text()), (
        f"the metrics' schema has changed: where that is meant, say so in CHANGELOG.md and run this test once with "
        f"FMR_UPDATE_GOLDEN=1, which writes {GOLDEN.name}"
    )
