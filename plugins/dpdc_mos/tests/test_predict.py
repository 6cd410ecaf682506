"""From a checkpoint and a folder of scans to label files, pictures and a map; merged and streamed end to end."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import lidarfw
import numpy as np
import pytest
import torch
from lidarfw import merging
from lidarfw.assembly import build, make_transforms, plan
from lidarfw.checkpoint import describe
from lidarfw.cli import main
from lidarfw.components.datasets.semantic_kitti import SemanticKittiDataset
from lidarfw.config import compose
from lidarfw.drive_prediction import SequenceFrames
from lidarfw.io import read_points
from lidarfw.predict import predict_frames
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import Frame, PointLabels, collate

SMALL = [
    "experiment=mos_finetune", "~dataset.town_mos", "dataset.semantic_kitti.root=nowhere",
    "dataset.semantic_kitti.task=moving", "dataset.semantic_kitti.sweeps=5", "dataset.semantic_kitti.pose=true",
    "backbone.dpdc.stem=8", "backbone.dpdc.widths=[16,16,16]",
    "transform.range_projection.height=16", "transform.range_projection.width=128",
]  # fmt: skip
TR = "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"  # LiDAR -> camera


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that has seen a few frames, so that its statistics are not those of the start, and is undecided."""
    torch.manual_seed(0)
    config = compose(SMALL)
    wired = plan(config)
    model = build(wired)
    data = SyntheticDataset(frames=4, sequence_length=4, points=2048, sweeps=5, pose=True)
    frames = [data[index] for index in range(4)]
    for change in make_transforms(config, training=False):
        frames = [change(frame, np.random.default_rng(0)) for frame in frames]
    batch = collate(frames)
    head: Any = model.head["moving_seg"]
    torch.nn.init.normal_(head.classify.weight)
    with torch.no_grad():
        model.train()(batch)
        logits = model.eval()(batch)["head.moving_seg"].logits
        head.classify.bias[1] -= (logits[:, 1] - logits[:, 0])[batch.inputs["range"].mask].median()
    path = tmp_path_factory.mktemp("model") / "mos.ckpt"
    weights = {f"model.{name}": value for name, value in model.state_dict().items()}
    torch.save({"lidarfw": describe(wired), "state_dict": weights}, path)
    return path


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five scans of a street in SemanticKITTI's layout."""
    folder = tmp_path_factory.mktemp("data") / "sequences" / "08"
    (folder / "velodyne").mkdir(parents=True)
    data = SyntheticDataset(frames=5, sequence_length=5, points=2048)
    to_camera = np.eye(4)
    to_camera[:3] = np.array(TR.split()[1:], dtype=float).reshape(3, 4)
    lines = []
    for index in range(5):
        points, pose = data[index].inputs["points"], data[index].targets.poses
        assert pose is not None
        table = torch.cat([points.xyz, points.features], 1).numpy().astype("<f4")
        (folder / "velodyne" / f"{index:06d}.bin").write_bytes(table.tobytes())
        camera = to_camera @ pose.matrix[0].double().numpy() @ np.linalg.inv(to_camera)
        lines.append(" ".join(f"{v:.9f}" for v in camera[:3].ravel()))
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    (folder / "calib.txt").write_text(TR)
    (folder / "times.txt").write_text("".join(f"{0.1 * i}\n" for i in range(5)))
    return folder


def cli(*arguments: Any) -> int:
    return main(["predict", *map(str, arguments)])


def test_a_sequence_becomes_labels_pictures_and_a_map(
    checkpoint: Path, sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli(checkpoint, sequence, "-o", tmp_path, "--static-map", tmp_path / "map.ply") == 0
    assert "moving points" in capsys.readouterr().out
    found = sorted((tmp_path / "sequences" / "08" / "predictions").iterdir())
    assert [path.name for path in found] == [f"{i:06d}.label" for i in range(5)]
    moving = 0
    for path in found:
        ids = np.fromfile(path, "<u4")
        assert len(ids) == len(read_points(sequence / "velodyne" / f"{path.stem}.bin").xyz)
        assert set(np.unique(ids)) <= {9, 251}
        moving += int((ids == 251).sum())
    strip = cv2.imread(str(tmp_path / "strip.png"))
    red = (strip[..., 2] > 150) & (strip[..., :2].max(-1) < 80)
    assert (red.sum() > 100) == (moving > 0)
    still = read_points(tmp_path / "map.ply").xyz
    assert 0 < len(still) < sum(len(np.fromfile(path, "<u4")) for path in found) - moving
    assert np.abs(still).max() < 120


def test_broken_points_of_a_sequence_can_be_dropped(
    checkpoint: Path, sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "08"
    shutil.copytree(sequence, broken)
    scan = broken / "velodyne" / "000001.bin"
    table = np.fromfile(scan, "<f4").reshape(-1, 4)
    table[[5, 9], 0] = np.nan
    scan.write_bytes(table.tobytes())
    assert cli(checkpoint, broken, "-o", tmp_path / "out") == 2
    assert "--repair" in capsys.readouterr().err
    assert cli(checkpoint, broken, "-o", tmp_path / "out", "--repair", "--no-pictures") == 0
    ids = np.fromfile(tmp_path / "out/sequences/08/predictions/000001.label", "<u4")
    assert len(ids) == len(table)  # one for every point of the file
    assert np.flatnonzero(ids == 0).tolist() == [5, 9]


@pytest.mark.parametrize("option", ["split", "poses", "map", "calib", "image", "columns", "intensity-max"])
def test_what_a_sequence_does_not_take_is_refused(
    option: str, checkpoint: Path, sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli(checkpoint, sequence, "-o", tmp_path, f"--{option}", "8") == 2
    assert f"--{option} does nothing for a sequence" in capsys.readouterr().err


def test_past_scans_come_with_the_frames(checkpoint: Path, sequence: Path) -> None:
    """The frames of a bare folder are those that the dataset gives, residual images included."""
    model = lidarfw.load(checkpoint)
    frames = SequenceFrames(model, sequence)
    data = SemanticKittiDataset(root=str(sequence.parents[1]), split="08", task="moving", sweeps=5, pose=True)
    data.labelled = False
    rng = np.random.default_rng(0)
    for index in (0, 1, 4):
        expected = data[index]
        for change in frames.transforms:
            expected = change(expected, rng)
        frame = frames[index]
        assert torch.equal(frame.inputs["range"].features, expected.inputs["range"].features)
        assert torch.equal(frame.inputs["pose"].matrix, expected.inputs["pose"].matrix)
        assert bool((frame.inputs["range"].features[:, 1:] != 0).any()) == (index > 0)


@pytest.mark.parametrize("folded", [False, True], ids=["branches", "branches and norms"])
def test_merged_for_inference_end_to_end(
    folded: bool, checkpoint: Path, sequence: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Projection, residuals, network, neighbours and filter: the same probabilities to 1e-5, fewer weights.

    Branches added up in float32. Norms folded in as well move the rounding of every layer by more than that, so what
    they do is looked at in float64.
    """
    if not folded:
        monkeypatch.setattr(merging, "_fold_norms", lambda sequence: None)
    model = lidarfw.load(checkpoint)
    merged = lidarfw.merge(model)
    kind = torch.float64 if folded else torch.float32
    results = [
        [r.of(PointLabels).probability for r in predict_frames(m.to(kind), _all(m, sequence, kind), True)]
        for m in (model, merged)
    ]
    for one, other in zip(*results, strict=True):
        assert float((one - other).abs().max()) <= 1e-5
    sizes = [sum(p.numel() for p in m.parameters()) for m in (model, merged)]
    assert sizes[1] < sizes[0]


def _all(model: Any, sequence: Path, kind: torch.dtype) -> Iterator[Frame]:
    frames = SequenceFrames(model, sequence)
    for frame in (frames[i] for i in range(len(frames))):
        image = frame.inputs["range"]
        yield frame.replace(inputs={**frame.inputs, "range": replace(image, features=image.features.to(kind))})


def test_a_scan_by_itself(checkpoint: Path, sequence: Path, tmp_path: Path) -> None:
    """Without past scans and pose: residuals are 0, the filter has one frame."""
    assert cli(checkpoint, sequence / "velodyne" / "000003.bin", "-o", tmp_path, "--format", "npz") == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["000003.npz", "000003_bev.png", "000003_range.png"]


def test_what_is_missing_is_named(checkpoint: Path, sequence: Path, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "velodyne" / "000000.bin").write_bytes((sequence / "velodyne" / "000000.bin").read_bytes())
    (tmp_path / "times.txt").write_text("0\n")
    assert cli(checkpoint, tmp_path, "-o", tmp_path / "out") == 2
    assert "poses.txt" in capsys.readouterr().err
