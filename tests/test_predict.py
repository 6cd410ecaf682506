"""Predicting from files: what a checkpoint and a scan give, and what is said when they do not fit."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import lidarfw
from lidarfw import kitti, registry
from lidarfw.assembly import build, plan
from lidarfw.checkpoint import describe
from lidarfw.cli import main
from lidarfw.config import compose
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Filter
from lidarfw.predict import FrameReader, find_sources, keep_scores, predict, to_plain
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import Boxes, Descriptors, FrameMeta, FrameResult, PointLabels, Poses, Tracks

SMALL = [
    "head=center_small",
    "backbone.pillars.cell=[0.8,0.8]",
    "backbone.pillars.lower=[0,-25.6,-3]",
    "backbone.pillars.upper=[51.2,25.6,1]",
    "backbone.pillars.channels=8",
    "neck.bev_fpn.layers=[1,1,1]",
    "neck.bev_fpn.channels=[8,8,8]",
    "neck.bev_fpn.upsampled=[8,8,8]",
]
CALIBRATION = """P0: 700 0 600 0 0 700 180 0 0 0 1 0
P1: 700 0 600 0 0 700 180 0 0 0 1 0
P2: 700 0 600 0 0 700 180 0 0 0 1 0
P3: 700 0 600 0 0 700 180 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0
"""


def write_checkpoint(path: Path, *overrides: str) -> Path:
    """A checkpoint with weights as they are drawn."""
    torch.manual_seed(0)
    wired = plan(compose(list(overrides)))
    weights = {f"model.{name}": value for name, value in build(wired).state_dict().items()}
    torch.save({"lidarfw": describe(wired), "state_dict": weights}, path)
    return path


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("model") / "tiny.ckpt", *SMALL)


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    """A KITTI folder with three scans; calibration and picture for the first only."""
    dataset = SyntheticDataset(frames=3, points=2048)
    for name in ("velodyne", "calib", "image_2"):
        (tmp_path / "kitti" / name).mkdir(parents=True)
    for index in range(3):
        points = dataset[index].inputs["points"]
        table = torch.cat([points.xyz, points.features], 1).numpy().astype("<f4")
        (tmp_path / "kitti" / "velodyne" / f"{index + 8}.bin").write_bytes(table.tobytes())
    (tmp_path / "kitti" / "calib" / "8.txt").write_text(CALIBRATION)
    cv2.imwrite(str(tmp_path / "kitti" / "image_2" / "8.png"), np.full((360, 1200, 3), 90, np.uint8))
    return tmp_path / "kitti" / "velodyne"


def cli(*arguments: Any) -> int:
    return main(["predict", *map(str, arguments)])


# The command


def test_one_scan_gives_json_and_pictures(checkpoint: Path, scans: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scans.parent / "out"
    assert cli(checkpoint, scans / "8.bin", "-o", out, "--score", 0) == 0
    assert sorted(path.name for path in out.iterdir()) == ["8.json", "8_bev.png", "8_image.png"]
    written = json.loads((out / "8.json").read_text())
    found = written["predictions"]["head.center"]["boxes"]
    assert len(found) > 0
    assert set(found[0]) >= {"class", "score", "center", "size", "yaw"}
    assert {box["class"] for box in found} <= {"Car", "Pedestrian", "Cyclist"}
    assert cv2.imread(str(out / "8_image.png")).shape == (360, 1200, 3)
    printed = capsys.readouterr().out
    assert "1 frames written" in printed
    assert f"{sum(box['class'] == 'Car' for box in found)} Car" in printed or not any(
        box["class"] == "Car" for box in found
    )


def test_results_equal_those_of_the_model_on_the_same_points(checkpoint: Path, scans: Path) -> None:
    model = lidarfw.load(checkpoint)
    reader = FrameReader(model)
    result = next(predict(model, reader, find_sources([scans / "9.bin"], lidar=True)))
    frame = SyntheticDataset(frames=3, points=2048)[1]
    direct = next(iter(model.stream().step(frame)))
    torch.testing.assert_close(result.of(Boxes).tensor, direct.of(Boxes).tensor)
    torch.testing.assert_close(result.of(Boxes).score, direct.of(Boxes).score)


def test_a_folder_is_read_in_the_order_of_its_numbers(checkpoint: Path, scans: Path) -> None:
    sources = find_sources([scans], lidar=True)
    assert [source.id for source in sources] == ["8", "9", "10"]
    assert [source.calibration is not None for source in sources] == [True, False, False]
    out = scans.parent / "out"
    assert cli(checkpoint, scans, "-o", out, "--format", "npz", "--no-pictures", "--score", 0) == 0
    assert sorted(path.name for path in out.iterdir()) == ["10.npz", "8.npz", "9.npz"]
    with np.load(out / "9.npz") as arrays:
        assert arrays["head.center.center"].shape[1] == 3
        assert arrays["classes"].tolist() == ["Car", "Pedestrian", "Cyclist"]


def test_kitti_text_reads_back_as_the_same_boxes(checkpoint: Path, scans: Path) -> None:
    out = scans.parent / "out"
    assert cli(checkpoint, scans / "8.bin", "-o", out, "--format", "kitti", "--score", 0, "--no-pictures") == 0
    labels = kitti.read_labels(out / "8.txt")
    boxes, _ = kitti.boxes_from_labels(labels, kitti.read_calibration(scans.parent / "calib" / "8.txt"), kitti.TYPES)
    model = lidarfw.load(checkpoint)
    result = next(predict(model, FrameReader(model), find_sources([scans / "8.bin"], lidar=True)))
    torch.testing.assert_close(boxes.center, result.of(Boxes).center, atol=2e-4, rtol=0)
    torch.testing.assert_close(boxes.size, result.of(Boxes).size, atol=2e-4, rtol=0)
    turn = boxes.yaw - result.of(Boxes).yaw
    torch.testing.assert_close(torch.cos(turn), torch.ones(len(boxes)))


def test_scores_below_are_left_out(checkpoint: Path, scans: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scans.parent / "out"
    assert cli(checkpoint, scans / "8.bin", "-o", out, "--score", 0.999) == 0
    assert json.loads((out / "8.json").read_text())["predictions"]["head.center"]["boxes"] == []
    assert "no boxes" in capsys.readouterr().out


class CountFrames(Filter):
    """Holds every frame back by one, and says how many came before it in its run."""

    def start(self) -> dict[str, Any]:
        return {"count": 0, "held": []}

    def step(self, state: dict[str, Any], frame: FrameResult) -> list[FrameResult]:
        out = state["held"]
        number = torch.full((1, 1), float(state["count"]))
        state["held"] = [dataclasses.replace(frame, predictions={**frame.predictions, "count": Descriptors(number)})]
        state["count"] += 1
        return out

    def flush(self, state: dict[str, Any]) -> list[FrameResult]:
        return state["held"]


def test_a_stream_is_one_run_and_single_scans_are_not(scans: Path, tmp_path: Path) -> None:
    with registry.use(filter={"count": CountFrames}):
        path = write_checkpoint(tmp_path / "model.ckpt", *SMALL, "filter=count", "tracker=greedy")
        for flags, counts in (["--stream"], [0, 1, 2]), ([], [0, 0, 0]):
            out = tmp_path / f"out{len(flags)}"
            assert cli(path, scans, "-o", out, "--no-pictures", *flags) == 0
            written = [json.loads((out / f"{name}.json").read_text()) for name in (8, 9, 10)]
            assert [w["predictions"]["count"]["vector"][0][0] for w in written] == counts
            assert all("tracks" in w for w in written)


def test_other_formats_give_the_same_boxes(checkpoint: Path, scans: Path) -> None:
    table = np.fromfile(scans / "8.bin", "<f4").reshape(-1, 4)
    np.save(scans / "a.npy", table)
    np.savez(scans / "b.npz", points=table)
    model = lidarfw.load(checkpoint)
    results = predict(model, FrameReader(model), find_sources([scans / n for n in ("8.bin", "a.npy", "b.npz")], True))
    first, *others = (result.of(Boxes).tensor for result in results)
    for other in others:
        torch.testing.assert_close(other, first)


def test_calibration_and_picture_can_be_given(checkpoint: Path, scans: Path, tmp_path: Path) -> None:
    shutil.copy(scans / "9.bin", tmp_path / "scan.bin")
    picture, calibration = scans.parent / "image_2" / "8.png", scans.parent / "calib" / "8.txt"
    assert cli(checkpoint, tmp_path / "scan.bin", "-o", tmp_path, "--calib", calibration, "--image", picture) == 0
    assert (tmp_path / "scan_image.png").exists()


def test_a_model_without_lidar_takes_pictures(tmp_path: Path) -> None:
    options = ["neck.lift.cell=[1.6,1.6]", "neck.lift.lower=[0,-12.8,-3]", "neck.lift.upper=[25.6,12.8,1]"]
    names = ["dataset.synthetic.image=true", "backbone=resnet_small", "neck=lift", "head=center_small"]
    path = write_checkpoint(tmp_path / "picture.ckpt", *names, *options)
    picture = SyntheticDataset(frames=1, image=True)[0].inputs["image"].features[0].permute(1, 2, 0).numpy()
    cv2.imwrite(str(tmp_path / "a.png"), (picture[..., ::-1] * 255).astype(np.uint8))
    assert cli(path, tmp_path / "a.png", "-o", tmp_path / "out", "--score", 0) == 0
    assert json.loads((tmp_path / "out" / "a.json").read_text())["id"] == "a"


# What is refused


def test_mistakes_are_explained(
    checkpoint: Path, scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = np.fromfile(scans / "8.bin", "<f4").reshape(-1, 4)
    np.save(tmp_path / "three.npy", table[:, :3])
    np.save(tmp_path / "loud.npy", table * [1, 1, 1, 255])
    np.save(tmp_path / "broken.npy", np.where(np.arange(4) == 0, np.nan, table))
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    shutil.copy(scans / "8.bin", tmp_path / "other")
    cases: list[tuple[list[Any], str]] = [
        ([tmp_path / "no.bin"], "no such file"),
        ([tmp_path / "empty"], "no file in this folder ends in .bin"),
        ([tmp_path / "three.npy"], "has 0 features per point (none), the model learned from 1"),
        ([tmp_path / "loud.npy"], "--intensity-max 255"),
        ([tmp_path / "broken.npy"], "--repair"),
        ([scans / "8.bin", tmp_path / "other" / "8.bin"], "would both write 8.*"),
        ([scans, "--image", "x.png"], "--image is the picture of one scan, and there are 3"),
        ([scans / "9.bin", "--format", "kitti"], "need the camera"),
        ([scans / "9.bin", "--intensity-max", "0"], "--intensity-max must be above 0, got 0"),
        ([scans / "9.bin", "--intensity-max", "nan"], "--intensity-max must be above 0, got nan"),
        ([scans / "9.bin", "--score", "nan"], "--score must be a finite number"),
        ([scans / "9.bin", "--columns", "2"], "--columns must be at least 3"),
        ([scans / "9.bin", "--static-map", "st.ply"], "--static-map does nothing for scans"),
        (["--split", "val", "--repair"], "--repair does nothing for a split"),
    ]
    for arguments, message in cases:
        assert cli(checkpoint, *arguments, "-o", tmp_path / "out") == 2, arguments
        error = capsys.readouterr().err
        assert message in error
        assert len(error.strip().splitlines()) <= 10
    assert cli(tmp_path / "no.ckpt", scans) == 2


def test_intensity_can_be_scaled_and_broken_points_dropped(checkpoint: Path, scans: Path, tmp_path: Path) -> None:
    table = np.fromfile(scans / "8.bin", "<f4").reshape(-1, 4)
    broken = np.concatenate([table * [1, 1, 1, 255], [[np.nan, 0, 0, 0]]])
    np.save(tmp_path / "loud.npy", broken)
    model = lidarfw.load(checkpoint)
    plain = next(predict(model, FrameReader(model), find_sources([scans / "8.bin"], True)))
    for strange in ({"intensity_max": 0.0}, {"intensity_max": math.nan}, {"columns": 2}):
        with pytest.raises(ConfigError):
            FrameReader(model, **strange)  # type: ignore[arg-type]
    reader = FrameReader(model, repair=True, intensity_max=255)
    scaled = next(predict(model, reader, find_sources([tmp_path / "loud.npy"], True)))
    torch.testing.assert_close(scaled.of(Boxes).tensor, plain.of(Boxes).tensor, atol=1e-3, rtol=1e-3)


def test_features_that_the_model_does_not_know_are_named(checkpoint: Path, scans: Path, tmp_path: Path) -> None:
    table = np.fromfile(scans / "8.bin", "<f4").reshape(-1, 4)
    (tmp_path / "a.pcd.bin").write_bytes(np.concatenate([table, table[:, :1]], 1).astype("<f4").tobytes())
    reader = FrameReader(lidarfw.load(checkpoint))
    frame = reader.read(find_sources([tmp_path / "a.pcd.bin"], True)[0])
    assert frame.inputs["points"].features.shape[1] == 1
    assert frame.meta.id == "a"
    assert reader.left_out == ("ring",)


# Plain values


def test_every_kind_of_prediction_becomes_plain() -> None:
    boxes = Boxes.from_tensor(torch.tensor([[1.0, 2, 3, 4, 5, 6, 0.1]]), torch.tensor([1]), torch.tensor([0.5]))
    predictions = {
        "head.a": boxes.replace(velocity=torch.tensor([[1.0, 0.0]])),
        "head.b": PointLabels(torch.eye(3), torch.zeros(3, dtype=torch.long)),
        "head.c": Poses(torch.eye(4)[None], torch.ones(1, dtype=torch.bool), torch.ones(1)),
    }
    result = FrameResult(FrameMeta("x"), predictions, Tracks(boxes, torch.tensor([7])))
    plain = json.loads(json.dumps(to_plain(result, ("Car", "Bus"))))
    assert plain["predictions"]["head.a"]["boxes"] == [
        {"class": "Bus", "score": 0.5, "center": [1, 2, 3], "size": [4, 5, 6], "yaw": 0.1, "velocity": [1, 0]}
    ]
    assert plain["predictions"]["head.b"] == {"kind": "PointLabels", "label": [0, 1, 2]}
    assert plain["predictions"]["head.c"]["matrix"][0][0] == [1, 0, 0, 0]
    assert plain["tracks"][0]["id"] == 7
    below = keep_scores(result, 0.6)
    assert len(below.predictions["head.a"]) == 0
    assert below.tracks is not None
    assert len(below.tracks.id) == 0


def test_real_scan_with_its_picture(checkpoint: Path, real_data: Callable[[str], Path], tmp_path: Path) -> None:
    scan = real_data("kitti_object/training/velodyne/000001.bin")
    assert cli(checkpoint, scan, "-o", tmp_path, "--score", 0, "--format", "kitti") == 0
    assert {path.name for path in tmp_path.iterdir()} == {"000001.txt", "000001_bev.png", "000001_image.png"}


def test_missing_calibration_of_a_picture(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no file in this folder"):
        find_sources([tmp_path], lidar=False)


def test_transforms_of_a_split_know_its_dataset(tmp_path: Path, told: list[str]) -> None:
    path = write_checkpoint(tmp_path / "told.ckpt", *SMALL, "dataset.synthetic.frames=2", *told)
    assert cli(path, "--split", "val", "-o", tmp_path / "out") == 0
    assert len(list((tmp_path / "out").glob("*.json"))) == 2
