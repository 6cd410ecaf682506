"""The splits of section 5.1 on small data in the official layouts, the experiments on top of them, and prediction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from lidarfw.assembly import build, plan
from lidarfw.checkpoint import describe
from lidarfw.cli import main
from lidarfw.components.datasets.drives import Drive
from lidarfw.config import compose
from lidarfw.errors import ConfigError
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import collate

from lidarfw_taco.datasets import Kitti360Relocalization, NuScenesRelocalization

PAPER = {"taco_oxfold": "Vehicle", "taco_nuscenes": "car", "taco_kitti360": ""}
TINY = [
    "backbone.taco.stem=4",
    "backbone.taco.blocks=[[4],[8],[8]]",
    "backbone.taco.bev_channels=8",
    "backbone.taco.cell=[0.8,0.8,0.8]",
    "head.scene_coord.hidden=16",
]
TINY_DETECTOR = ["neck.bev_fpn.layers=[1,1]", "neck.bev_fpn.channels=[8,8]", "neck.bev_fpn.upsampled=[8,8]"]


def drive(count: int, poses: np.ndarray) -> Drive:
    return Drive("0000", [Path(f"{n:06d}.bin") for n in range(count)], np.arange(count, dtype=float), poses)


def test_every_fifth_frame_is_to_find() -> None:
    whole = drive(12, np.eye(4)[None].repeat(12, 0))
    assert NuScenesRelocalization(split="train").chosen(whole).tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 10, 11]
    assert NuScenesRelocalization(split="val").chosen(whole).tolist() == [4, 9]
    assert NuScenesRelocalization(split="test", window=4).chosen(whole).tolist() == [3, 7, 11]


def test_returns_are_to_find() -> None:
    """50 frames out, 1 m apart, then 60 back along the same way: what was passed 30 s before and more is a return."""
    place = np.concatenate([np.arange(50.0), 49 - np.arange(60.0)])
    poses = np.eye(4)[None].repeat(110, 0)
    poses[:, 0, 3] = place
    split = {name: Kitti360Relocalization(split=name, frames=50, radius=5.0) for name in ("train", "val")}
    whole = drive(110, poses)
    assert split["train"].chosen(whole).tolist() == list(range(50))
    found = split["val"].chosen(whole)
    assert found.min() == 62, "at 62 s the vehicle is at 37 m, 5 m from 32 m, where it was 30 s before"
    assert found.max() == 104, "5 m before the beginning"
    assert (np.diff(found) == 1).all()


def test_frames_are_found_in_the_split(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = NuScenesRelocalization(split="val")
    drives = [drive(7, np.eye(4)[None].repeat(7, 0)), drive(3, np.eye(4)[None].repeat(3, 0)),
              drive(10, np.eye(4)[None].repeat(10, 0))]  # fmt: skip
    monkeypatch.setattr(NuScenesRelocalization, "drives", drives)
    assert len(dataset) == 3
    assert [dataset.find(index)[1] for index in range(3)] == [4, 4, 9]
    assert dataset.find(-1)[1] == 9
    assert dataset.sequences() == [range(0, 1), range(1, 3)]
    with pytest.raises(IndexError):
        dataset.find(3)


def test_mistakes_are_explained() -> None:
    with pytest.raises(ConfigError, match="Splits: train, val, test"):
        NuScenesRelocalization(split="mini")
    with pytest.raises(ConfigError, match="at least 2"):
        NuScenesRelocalization(window=1)
    with pytest.raises(ConfigError, match="frames >= 1"):
        Kitti360Relocalization(frames=0)


@pytest.mark.parametrize("name", PAPER)
def test_experiments_of_the_paper_say_its_values(name: str) -> None:
    config = compose([f"experiment={name}"])
    assert config.optimizer.lr == 0.01
    assert config.optimizer.weight_decay == 0.0001
    assert config.loader.batch_size == 100
    assert config.trainer.max_epochs == 100
    assert plan(config).of("head")[-1].name == "scene_coord"
    if PAPER[name]:
        assert config.metric.box_ap.iou[PAPER[name]] == 0.5
        assert {step.name: step.weight for step in plan(config).of("loss")} == {
            "center": 1.0, "scene_coord": 1.0, "itcl": 0.1, "idcl": 0.1, "ilcl": 0.1,
        }  # fmt: skip


@pytest.mark.parametrize("joint", [True, False])
def test_experiments_take_a_step_on_tiny_data(joint: bool) -> None:
    name, more = ("taco", TINY_DETECTOR) if joint else ("taco_localization", [])
    model = build(plan(compose([f"experiment={name}", "dataset=synthetic", *TINY, *more]))).train()
    dataset = SyntheticDataset(frames=2, points=1024)
    batch = collate([dataset[0], dataset[1]])
    terms = model.losses(model(batch), batch)
    torch.stack([value for values in terms.values() for value in values.values()]).sum().backward()
    assert all(value.isfinite() for values in terms.values() for value in values.values())
    with torch.no_grad():
        assert len(model.eval().predict(batch)) == 2


def test_prediction_writes_poses_and_a_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.manual_seed(0)
    overrides = ["experiment=taco", "dataset=synthetic", "dataset.synthetic.frames=3",
                 "dataset.synthetic.points=1024", *TINY, *TINY_DETECTOR]  # fmt: skip
    wired = plan(compose(overrides))
    weights = {f"model.{name}": value for name, value in build(wired).state_dict().items()}
    torch.save({"lidarfw": describe(wired), "state_dict": weights}, tmp_path / "model.ckpt")
    out = tmp_path / "out"
    assert main(["predict", str(tmp_path / "model.ckpt"), "--split", "val", "-o", str(out)]) == 0
    assert (out / "trajectory.png").is_file()
    assert len(list(out.glob("*_bev.png"))) == 3
    assert '"postprocessor.pose_ransac"' in next(out.glob("*.json")).read_text()
    assert "poses found" in capsys.readouterr().out
