"""The bench on a small model: its tables hold what was measured, and the model is as before."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from lidarfw_msrm import bench
from lidarfw_msrm.heads.pooling import Aggregation, Sites

SMALL = [
    "experiment=msrm_town", "head.msrm.stages=2", "head.msrm.grid=2", "head.msrm.neighbors=4",
    "backbone.resnet_se.cell=[0.4,0.4,0.2]", "dataset=synthetic",
]  # fmt: skip


def test_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "REGIONS", (4, 16))
    whole = bench.decomposition
    monkeypatch.setattr(bench, "decomposition", lambda rounds: whole(rounds, sites=100, neighbors=2))
    assert bench.main([*SMALL, "--rounds", "1", "--json", str(tmp_path / "found.json")]) == 0
    shown = capsys.readouterr().out
    assert "| 2 | " in shown
    found = json.loads((tmp_path / "found.json").read_text())
    assert list(found["stages"]) == ["1", "2"]
    assert found["regions"]["16"][1] > found["regions"]["4"][1] > 0  # more regions keep more
    assert found["decomposition"]["products"]["naive"] > found["decomposition"]["products"]["decomposed"]


def test_both_forms_give_the_same() -> None:
    naive, ours = bench.NaivePointNet(5, 8).eval(), Aggregation(5, 8).eval()
    ours.out = torch.nn.Sequential()
    gain = torch.tensor(1 / (1 + 1e-3) ** 0.5)  # of an untrained normalisation
    naive.linear.weight.data = torch.cat([ours.feature.weight, ours.offset.weight], 1) * gain
    sites = Sites(torch.rand(20, 3), torch.rand(20, 5), torch.zeros(0))
    pairs = torch.stack([torch.arange(6).repeat_interleave(3), torch.arange(18)], 1)
    xyz = torch.rand(6, 3)
    torch.testing.assert_close(naive(sites, xyz, pairs, 3), ours(ours.transform(sites), sites, xyz, pairs))


def test_a_model_without_the_head_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["dataset=synthetic", "head=center_small"]) == 2
    assert "no head 'msrm'" in capsys.readouterr().err
