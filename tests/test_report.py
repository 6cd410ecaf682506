"""The report of a run and the figures of an evaluation."""

from __future__ import annotations

import base64
import json
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lidarfw.assembly import build, plan
from lidarfw.checkpoint import describe
from lidarfw.cli import main
from lidarfw.commands.eval import table
from lidarfw.config import compose
from lidarfw.draw import png_bytes
from lidarfw.errors import DataError
from lidarfw.report import write_report

SMALL = [
    "dataset.synthetic.frames=5",
    "dataset.synthetic.points=1024",
    "head=center_small",
    "backbone.pillars.cell=[1.6,1.6]",
    "backbone.pillars.lower=[0,-25.6,-3]",
    "backbone.pillars.upper=[51.2,25.6,1]",
    "neck.bev_fpn.layers=[1,1,1]",
    "neck.bev_fpn.channels=[8,8,8]",
    "neck.bev_fpn.upsampled=[8,8,8]",
]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run: a checkpoint with weights as they are drawn, and curves."""
    folder = tmp_path_factory.mktemp("runs") / "first <run>"
    (folder / "checkpoints").mkdir(parents=True)
    torch.manual_seed(0)
    wired = plan(compose(SMALL))
    weights = {f"model.{name}": value for name, value in build(wired).state_dict().items()}
    torch.save({"lidarfw": describe(wired), "state_dict": weights}, folder / "checkpoints" / "last.ckpt")
    rows = ["step,epoch,loss/total,val/box_ap/mean_3d_ap", "0,0,9.5,", "1,0,8.5,", "1,0,,0.125", "2,1,,0.25"]
    (folder / "metrics.csv").write_text("\n".join(rows))
    return folder


def test_the_report_holds_everything_and_loads_nothing(run: Path) -> None:
    picture = run / "town.png"
    picture.write_bytes(png_bytes(np.full((8, 8, 3), 200, np.uint8)))
    path = write_report(run, frames=2, score=0.0, seconds={"train": 61.25}, pictures={"the <town>": picture})
    text = path.read_text()
    assert path == run / "report.html"
    for word in (
        "first &lt;run&gt;",
        "backbone.pillars",
        "loss.center",
        "0.2500",
        "61.2",
        "torch",
        "frames: 5",
        "the &lt;town&gt;",
    ):
        assert word in text, word
    assert "<run>" not in text
    pictures = [base64.b64decode(data) for data in re.findall(r'src="data:image/png;base64,([^"]+)"', text)]
    assert len(pictures) == 4  # curves, two frames, the one given
    assert all(cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR) is not None for picture in pictures)
    assert not re.findall(r'(?:src|href)="(?!data:)', text)
    assert "http" not in text


def test_given_figures_win_and_a_run_without_curves_has_none(run: Path, tmp_path: Path) -> None:
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "best.ckpt").write_bytes((run / "checkpoints" / "last.ckpt").read_bytes())
    text = write_report(tmp_path, {"box_ap/mean_3d_ap": 0.875}, frames=1).read_text()
    assert "0.8750" in text
    assert "Curves" not in text


def test_a_folder_that_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"has no checkpoints/best.ckpt or last.ckpt"):
        write_report(tmp_path)


def test_figures_as_a_table() -> None:
    text = table({"box_ap/car_3d_ap": 0.5, "box_ap/mean": math.nan, "other/x": 1.0})
    assert text.splitlines() == [
        "box_ap",
        "  car_3d_ap      0.5000",
        "  mean                -",
        "other",
        "  x              1.0000",
    ]
    assert "no figures" in table({})


def test_eval_prints_and_writes_the_figures(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written = tmp_path / "figures.json"
    checkpoint = str(run / "checkpoints" / "last.ckpt")
    arguments = ["trainer=cpu", "trainer.enable_progress_bar=false", "dataset.synthetic.frames=2"]
    assert main(["eval", checkpoint, *arguments, "--json", str(written)]) == 0
    figures = json.loads(written.read_text())
    assert set(figures) >= {"box_ap/mean_3d_ap", "box_ap/car_3d_ap"}
    printed = capsys.readouterr().out
    assert "mean_3d_ap" in printed
    assert f"{figures['box_ap/mean_3d_ap']:.4f}" in printed
    assert main(["eval", checkpoint, "backbone=second"]) == 2
    assert "model" in capsys.readouterr().err


def test_transforms_know_the_dataset_of_the_pictures(tmp_path: Path, told: list[str]) -> None:
    (tmp_path / "checkpoints").mkdir()
    wired = plan(compose([*SMALL, *told]))
    weights = {f"model.{name}": value for name, value in build(wired).state_dict().items()}
    torch.save({"lidarfw": describe(wired), "state_dict": weights}, tmp_path / "checkpoints" / "last.ckpt")
    assert "<figure>" in write_report(tmp_path, frames=1).read_text()
