"""Tables and pictures of what the stages do, of an untrained model that is given objects as proposals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from lidarfw.components.transforms.crop import Crop
from lidarfw.testing.synthetic import frames
from lidarfw.types import Boxes, FrameMeta, Points

from lidarfw_msrm import stages
from lidarfw_msrm.stages import Seen

CLASSES = ("Car", "Pedestrian", "Cyclist")


def seen(shift: tuple[float, ...]) -> list[Seen]:
    """Frames whose stages are off by these shares of a length."""
    found = []
    for number, frame in enumerate(frames(3)):
        truth, points = frame.targets.boxes, frame.inputs["points"]
        assert truth is not None
        assert isinstance(points, Points)
        parts = []
        for stage, share in enumerate(shift):
            along = torch.stack([truth.yaw.cos(), truth.yaw.sin(), truth.yaw * 0], 1) * truth.size[:, :1]
            parts.append(truth.replace(center=truth.center + share * along, stage=torch.full_like(truth.label, stage)))
        found.append(Seen(FrameMeta(f"s/{number}", "s", number), Boxes.cat(parts), points, frame.targets))
    return found


def test_figures_and_differences() -> None:
    there = seen((0.2, 0.1, 0.0))
    parts = {name: stages.measured(there, CLASSES, chosen) for name, chosen in stages.ways(2).items()}
    found = {name: stages.figures(stages.joined(frames)) for name, frames in parts.items()}
    assert found["proposals"]["match_mean_iou"] == pytest.approx(0.8 / 1.2, abs=1e-4)
    assert found["stage 1"]["match_mean_iou"] == pytest.approx(0.9 / 1.1, abs=1e-4)
    assert found["stage 2"]["mean_3d_ap"] == 1
    # equal scores: the vote lies half way between the stages, and the proposals do not vote
    assert found["vote"]["match_mean_iou"] == pytest.approx(0.95 / 1.05, abs=1e-4)
    meta = [one.meta for one in there]
    drawn = {name: stages.resampled(frames, meta, 20, 1) for name, frames in parts.items()}
    shown = stages.differences(found, drawn)
    assert "| stage 1 - proposals |" in shown
    assert "| stage 2 - stage 1 |" in shown
    assert "| vote - stage 2 |" in shown


def test_fewer_regions() -> None:
    one = seen((0.0, 0.0))[0]
    assert len(one.stages) // 2 > 1
    assert len(stages.detections(one.stages, (), 1)) == 1


def test_pictures(tmp_path: Path) -> None:
    one = seen((0.3, 0.1))[0]
    assert stages.draw(tmp_path / "a.png", one, 1)
    assert (tmp_path / "a.png").stat().st_size > 5000
    nothing = Seen(one.meta, one.stages[:0], one.points, one.targets)
    assert not stages.draw(tmp_path / "b.png", nothing, 1)


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from lidarfw.cli import main

    overrides = [
        "experiment=msrm_town", "dataset=synthetic", "dataset.synthetic.frames=2", "dataset.synthetic.points=2048",
        "backbone.resnet_se.cell=[0.4,0.4,0.2]", "head.msrm.grid=2", "head.msrm.regions=8", "head.msrm.neighbors=4",
        "trainer=cpu", "trainer.max_steps=1", "trainer.limit_val_batches=0", "logger=none", "metric=box_ap",
        "transform.crop.boxes=false",
        "trainer.enable_progress_bar=false", "trainer.enable_model_summary=false", f"hydra.run.dir={tmp_path}",
    ]  # fmt: skip
    assert main(["train", *overrides]) == 0
    calls: list[str] = []
    monkeypatch.setattr(Crop, "prepare", lambda *_: calls.append("prepare"))
    monkeypatch.setattr(Crop, "attach", lambda *_: calls.append("attach"))
    file = tmp_path / "figures.json"
    arguments = [str(tmp_path / "checkpoints" / "last.ckpt"), "--regions", "4", "--resamples", "2", "--block", "1"]
    assert stages.main([*arguments, "--json", str(file)]) == 0
    assert "| vote, 4 regions |" in capsys.readouterr().out
    assert list(json.loads(file.read_text())) == [
        "proposals",
        "stage 1",
        "stage 2",
        "stage 3",
        "vote",
        "vote, 4 regions",
    ]
    assert calls == ["prepare", "attach"]
    assert stages.main([str(tmp_path / "no.ckpt")]) == 2
