"""The measurement of retrievers on maps like those of drives."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from lidarfw_crossplace import scale


def test_descriptors_change_along_the_way() -> None:
    draw = torch.Generator().manual_seed(0)
    vector = scale.descriptors(scale.drive(400, 96, draw), 96, 0.1, draw)
    assert torch.allclose(vector.norm(dim=1), torch.ones(400), atol=1e-5)
    near, far = ((vector[gap:] - vector[:-gap]).norm(dim=1).mean() for gap in (1, 150))
    assert near < 0.6 * far


def test_exact_search_is_measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]):  # type: ignore[no-untyped-def]
    options = ["scale", "--places", "300", "--retrievers", "exact", "--width", "96", "--queries", "50"]
    monkeypatch.setattr(sys, "argv", [*options, "--json", str(tmp_path / "rows.json")])
    scale.main()
    assert "| exact | 300 |" in capsys.readouterr().out
    assert '"recall": 1.0' in (tmp_path / "rows.json").read_text()


def test_a_search_that_misses_is_seen(tmp_path: Path) -> None:
    draw = torch.Generator().manual_seed(0)
    vector = scale.descriptors(scale.drive(100, 96, draw), 96, 0.1, draw)
    truth = scale.exact_rows(vector, vector)
    assert truth.tolist() == list(range(100))
    assert scale.measure("exact", vector, vector, truth.roll(1), tmp_path).recall == 0
