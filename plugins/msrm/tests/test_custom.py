"""The recipe for scans of one's own, on .npy scans of a tiny town of which half have labels."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lidarfw.cli import main

ROOT = Path(__file__).resolve().parents[3]
CLASSES = ("Car", "Pedestrian", "Cyclist")
SMALL = [
    "backbone=resnet_se_small", "neck=bev_fpn_second_small", "head=[anchor,msrm_small]",
    "backbone.resnet_se.lower=[0,-16,-5]", "backbone.resnet_se.upper=[32,16,3]",
    "backbone.resnet_se.cell=[0.4,0.4,0.2]",
    "backbone.resnet_se.channels=[8,8,16,16]", "head.msrm.grid=2", "head.msrm.regions=8", "head.msrm.neighbors=4",
    "trainer=cpu", "trainer.max_steps=2", "logger=none", "trainer.enable_progress_bar=false",
    "trainer.enable_model_summary=false", "postprocessor.nms.score_threshold=0",
]  # fmt: skip


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans of the town as a folder of one's own."""
    pytest.importorskip("lidarfw_town")
    root = tmp_path_factory.mktemp("yard")
    tool = [sys.executable, str(ROOT / "tools" / "town_folder.py"), str(root), "--frames", "4", "--labelled", "2"]
    home = {"XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache")), "PATH": "/usr/bin:/bin"}
    subprocess.run([*tool, "--sensor", "ouster32"], check=True, env=home, capture_output=True)
    return root


def test_scans_are_those_of_the_sensor(town: Path) -> None:
    assert sorted(p.name for p in (town / "street" / "points").iterdir()) == [f"{n:06d}.npy" for n in range(4)]
    assert len(list((town / "street" / "boxes").iterdir())) == 2
    assert len(list((town / "left_out" / "street" / "boxes").iterdir())) == 2
    scan = np.load(town / "street" / "points" / "000000.npy")
    assert scan.dtype == np.float32
    assert scan.shape[1] == 4


def test_pseudo_labels_of_the_recipe(town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = [f"dataset.folder.root={town}"]
    given = ["experiment=msrm_custom", *data, *SMALL, "--rounds", "1", "--ignore", "0.05", "--keep"]
    assert main(["pseudo-label", str(tmp_path / "out"), *given, *(f"{name}=0.1" for name in CLASSES)]) == 0
    shown = capsys.readouterr().out
    assert "box_ap/mean_3d_ap" in shown
    rounds = [json.loads((tmp_path / "out" / f"round_{n}" / "round.json").read_text()) for n in (0, 1)]
    assert [one["frames"] for one in rounds] == [2, 2]
    assert rounds[1]["pseudo_frames"] == 2
