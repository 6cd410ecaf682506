"""The naive yardsticks agree with the ops, and `lidarfw bench` measures and reports."""

import json
import math
from pathlib import Path

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from lidarfw import ops
from lidarfw.cli import main
from lidarfw.errors import ConfigError
from lidarfw.ops import bench, inputs, naive, rivals, rulebook, sparse_conv
from lidarfw.types import SceneCoords


@pytest.fixture(scope="module")
def scan():
    return bench.street_scan()


def test_the_simulated_scan_is_like_a_real_one(scan) -> None:
    voxels = ops.voxelize_mean(scan, bench.GRID)
    assert 15_000 <= len(voxels) <= 20_000
    assert torch.equal(scan.xyz, bench.street_scan().xyz)
    assert torch.atan2(scan.xyz[:, 1], scan.xyz[:, 0]).abs().max() < math.radians(41.2)
    pairs = len(rulebook.submanifold_rulebook(voxels, rulebook.Kernel((3, 3, 3))))
    assert 2.5 < pairs / len(voxels) < 8  # as sparse as LiDAR is


def test_naive_versions_give_what_ours_give(scan) -> None:
    voxels = ops.voxelize_mean(scan, bench.GRID)
    index, mean = naive.voxelize_mean(scan, bench.GRID)
    assert torch.equal(index, voxels.index)
    torch.testing.assert_close(mean, voxels.features, rtol=1e-4, atol=1e-4)
    for book in (
        rulebook.submanifold_rulebook(voxels, rulebook.Kernel((3, 3, 3))),
        rulebook.strided_rulebook(voxels, rulebook.Kernel((3, 3, 3), (2, 2, 2), (1, 1, 1))).book,
    ):
        weight = torch.randn(27, 4, 8, generator=torch.Generator().manual_seed(0))
        ours = sparse_conv.convolve(voxels.features, weight, book)
        torch.testing.assert_close(naive.convolve(voxels.features, weight, book), ours, rtol=1e-4, atol=1e-3)
    image = ops.range_project(scan, bench.VIEW)
    plain = torch.from_numpy(naive.range_project(scan.xyz.numpy(), scan.features.numpy(), bench.VIEW))
    same = (plain[..., 1:4].permute(2, 0, 1) == image.xyz[0]).all(0)  # angles of numpy and torch differ in the last bit
    assert same.float().mean() > 0.999
    labels = torch.randint(20, image.mask.shape, generator=torch.Generator().manual_seed(0))
    distance = scan.xyz.norm(dim=1)
    assert torch.equal(ops.range_knn(image, labels, distance), naive.range_knn(image, labels, distance))
    few, zeros = scan.xyz[:500], torch.zeros(500, dtype=torch.long)
    assert torch.equal(ops.farthest_points(few, zeros, 1, 20)[0], naive.farthest_points(few, 20))
    apart = torch.cdist(few.double(), few.double())
    found = ops.knn(few, zeros, few, zeros, 5)[0], naive.nearest(few, few, 5)
    torch.testing.assert_close(*(apart.gather(1, rows) for rows in found), rtol=1e-3, atol=1e-2)


def test_the_town_is_an_input_where_it_is_installed(monkeypatch) -> None:
    pytest.importorskip("lidarfw_town")
    scan = inputs.town_scan()
    assert 15_000 <= len(ops.voxelize_mean(scan, bench.GRID)) <= 25_000
    monkeypatch.setattr(inputs, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="pip install lidarfw-town"):
        inputs.town_scan()


def test_faiss_finds_what_ours_finds(scan) -> None:
    pytest.importorskip("faiss")
    few, zeros = scan.xyz[::40], torch.zeros(len(scan.xyz[::40]), dtype=torch.long)
    assert torch.equal(rivals.faiss_nearest(few, few, 4), ops.knn(few, zeros, few, zeros, 4)[0])


@pytest.mark.parametrize("kind", ["cluster", "spread", "dense"])
def test_numba_gives_the_same_overlaps_and_keeps_the_same_boxes(kind: str) -> None:
    pytest.importorskip("numba")
    boxes, scores = bench.random_boxes(300, kind), torch.rand(300, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        rivals.numba_iou(boxes, boxes), ops.iou_bev(boxes.double(), boxes.double()), rtol=0, atol=1e-6
    )
    assert torch.equal(rivals.numba_nms(boxes, scores, 0.1), ops.nms_rotated(boxes, scores, 0.1))


@pytest.mark.parametrize("kind", ["cluster", "spread", "dense"])
def test_naive_suppression_keeps_the_same_boxes(kind: str) -> None:
    boxes, scores = bench.random_boxes(400, kind), torch.rand(400, generator=torch.Generator().manual_seed(0))
    assert torch.equal(naive.nms(boxes, scores, 0.1), ops.nms_rotated(boxes, scores, 0.1))
    exact = rivals.shapely_iou(boxes[:50], boxes[:50])
    torch.testing.assert_close(ops.iou_bev(boxes[:50].double(), boxes[:50].double()), exact, rtol=0, atol=1e-6)


def test_naive_pose_search_finds_the_pose_that_ours_finds() -> None:
    source = torch.randn(100, 3, generator=torch.Generator().manual_seed(0)) * 10
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    world = ops.transform(pose, source)
    triples = torch.randint(100, (20, 3), generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(naive.best_pose(source, world, triples, 0.5), pose, rtol=1e-3, atol=1e-3)
    pairs = SceneCoords(source, world, torch.ones(100), torch.zeros(100, dtype=torch.long))
    torch.testing.assert_close(ops.ransac_pose(pairs).matrix[0], pose, rtol=1e-4, atol=1e-4)


def test_floating_point_operations_are_counted_from_the_pairs(scan, monkeypatch) -> None:
    voxels = ops.voxelize_mean(scan, bench.GRID)
    net = bench.backbone(4).eval()
    monkeypatch.setattr(sparse_conv, "convolve", naive.convolve)  # the counter does not see products into scratch
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        net(bench.fresh(voxels))
    assert bench.flops(bench.fresh(voxels)) == pytest.approx(counter.get_total_flops(), rel=1e-6)


def test_bench_ops_prints_and_writes_what_it_measured(tmp_path, capsys) -> None:
    table, picture = tmp_path / "figures.json", tmp_path / "ratios.png"
    arguments = ["--rounds", "2", "--only", "NMS of 1000, spread", "--json", str(table), "--picture", str(picture)]
    assert main(["bench", "ops", "--against", "shapely", *arguments]) == 0
    printed = capsys.readouterr().out
    assert "rotated NMS of 1000, spread" in printed
    assert "x)" in printed
    written = json.loads(table.read_text())
    assert [len(times) for times in written["timings"][0]["candidates"].values()] == [2, 2]
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["ops", "--rounds", "0"], "--rounds must be at least 1"),
        (["ops", "--against", "numba"], "pip install numba"),
        (["ops", "--against", "faiss"], "pip install faiss-cpu"),
        (["ops", "--town"], "pip install lidarfw-town"),
        (["ops", "--scan", "nowhere.bin"], "no such file"),
    ],
)
def test_mistakes_are_named(arguments: list[str], message: str, monkeypatch, capsys) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr(inputs, "find_spec", lambda name: None)
    assert main(["bench", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_bench_of_a_model_times_its_components(tmp_path, capsys) -> None:
    file = tmp_path / "latency.json"
    assert main(["bench", "experiment=second_kitti", "--rounds", "1", "--json", str(file)]) == 0
    printed = capsys.readouterr().out
    assert "frames/s" in printed
    found = json.loads(file.read_text())
    assert {"backbone.second", "neck.height_compression", "rest"} <= set(found["components"])
    assert sum(found["components"].values()) == pytest.approx(found["total"])
    assert found["frames_per_second"] == pytest.approx(1000 / found["total"])


def test_bench_of_a_model_that_sees_pictures_asks_for_one(capsys) -> None:
    assert main(["bench", "dataset.synthetic.image=true", "backbone=resnet", "neck=lift", "head=center"]) == 2
    assert "--image FILE" in capsys.readouterr().err


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs Linux' /proc")
def test_peak_memory_is_that_of_a_pass() -> None:
    peak = bench.peak_memory("ours", sweeps=1)
    assert peak is not None
    assert 10 < peak < 300  # the features alone: 18,601 x 16 x 4 bytes and more on the other levels
