"""Figures of single frames, of sequences and of bootstrap samples, and `lidarfw eval --frames`."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import training_parts
from training_runs import settings

from lidarfw import registry
from lidarfw.cli import main
from lidarfw.components.metrics.box_ap import BoxAP
from lidarfw.components.metrics.recall_at import RecallAt
from lidarfw.errors import ConfigError
from lidarfw.resampling import FrameRecord, blocks, draws, interval
from lidarfw.training import evaluate, train
from lidarfw.types import Boxes, Descriptors, FrameMeta, FrameResult, Poses, Spec, Targets

CLASSES = ("Car", "Pedestrian", "Cyclist")


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    with registry.use(**training_parts.SLOTS):
        train(settings(folder, "dataset.toy.frames=10"))
    return folder / "checkpoints/last.ckpt"


def metas(*lengths: int) -> list[FrameMeta]:
    return [FrameMeta(f"{s}_{i}", str(s), i) for s, length in enumerate(lengths) for i in range(length)]


class FakeModel:
    """A model whose only metric is average precision."""

    def __init__(self) -> None:
        self.metrics = {"box_ap": BoxAP(Spec(Boxes, classes=CLASSES))}

    def update_metrics(self, results, metrics=None) -> None:
        for result in results:
            (metrics or self.metrics)["box_ap"].update(result.predictions["head.toy"], result.targets)


def detections(frames: list[FrameMeta]) -> list[FrameResult]:
    """Objects, of which some are found, beside wrong detections."""
    generator = torch.Generator().manual_seed(0)
    results = []
    for meta in frames:
        place = torch.rand(6, 2, generator=generator) * 40
        tensor = torch.cat([place, torch.tensor([[0.0, 4, 2, 1.5, 0]]).repeat(6, 1)], 1)
        label = torch.randint(3, (6,), generator=generator)
        found = Boxes.from_tensor(tensor, label, torch.rand(6, generator=generator))
        truth = Boxes.from_tensor(tensor[:4], label[:4])
        results.append(FrameResult(meta, {"head.toy": found[torch.rand(6, generator=generator) < 0.7]}, None, None))
        results[-1].targets = Targets(truth)
    return results


def test_blocks_are_consecutive_frames_of_one_sequence():
    assert blocks(metas(5, 2), 2) == [[0, 1], [2, 3], [4], [5, 6]]
    assert blocks(metas(3), 1) == [[0], [1], [2]]
    assert blocks([], 4) == []


def test_draws_are_the_same_in_every_call():
    assert np.array_equal(draws(7, 20), draws(7, 20))
    assert draws(7, 20).shape == (20, 7)
    assert set(draws(3, 200).ravel()) == {0, 1, 2}
    assert draws(0, 5).shape == (5, 0)


def test_interval_is_the_middle_ninety_percent():
    assert interval([*range(101)]) == pytest.approx((5, 95))
    assert interval([math.nan, 2.0]) == (2, 2)
    assert all(math.isnan(value) for value in interval([]))


def test_average_precision_of_a_sample_is_computed_anew():
    """Not an average over frames: the record of frames gives what the metric gives on those frames."""
    frames = metas(9, 8)
    results, model, record = detections(frames), FakeModel(), FrameRecord()
    record.start(model)
    record.add(results)
    for rows in ([3], [0, 5, 16], [2, 2, 2, 7]):
        metric = BoxAP(Spec(Boxes, classes=CLASSES))
        for row in rows:
            metric.update(results[row].predictions["head.toy"], results[row].targets)
        expected = {f"box_ap/{key}": float(value) for key, value in metric.compute().items()}
        assert record.figures(rows) == pytest.approx(expected)
    samples = record.resampled(20, 4)
    runs = blocks(frames, 4)
    rows = [row for place in draws(len(runs), 20)[7] for row in runs[place]]
    assert samples[7] == pytest.approx(record.figures(rows))
    assert len({sample["box_ap/mean_3d_ap"] for sample in samples}) > 10
    assert record.by_sequence()["1"] == pytest.approx(record.figures(range(9, 17)))


class PlaceModel:
    """A model whose only metric asks a map, sequence 0, where the frames of the others were taken."""

    def __init__(self) -> None:
        self.metrics = {"recall_at": RecallAt(Spec(Descriptors, 2), map_sequences=["0"])}

    def update_metrics(self, results, metrics=None) -> None:
        for result in results:
            vector, poses = result.predictions["head.toy"], result.targets
            (metrics or self.metrics)["recall_at"].update(vector, poses, [result.meta])


def test_a_map_is_in_every_sample():
    """Queries are drawn, and what they are compared with stays: else a right answer would lack its place."""
    model, record, frames = PlaceModel(), FrameRecord(), metas(8, 6, 4)
    record.start(model)
    for number, meta in enumerate(frames):
        place = 50.0 * (meta.index if number != 10 else 7)
        matrix = torch.eye(4)[None].clone()
        matrix[0, 0, 3] = 50.0 * meta.index
        targets = Targets(poses=Poses(matrix, torch.tensor([True]), torch.ones(1)))
        vector = Descriptors(torch.tensor([[place, 0.0]]), ())
        record.add([FrameResult(meta, {"head.toy": vector}, None, targets)])
    found = record.to_plain(40, 1)
    assert found["figures"]["recall_at/recall@1"] == pytest.approx(0.9)
    assert (found["blocks"], set(found["resampled"]["recall_at/queries"])) == (10, {10})
    assert sum(found["by_frame"]["recall_at/recall@1"][8:]) == 9
    assert found["by_frame"]["recall_at/recall@1"][10] == 0
    assert {name: alone["recall_at/queries"] for name, alone in found["by_sequence"].items()} == {"1": [6], "2": [4]}
    shares = found["resampled"]["recall_at/recall@1"]
    assert sum(shares) / 40 == pytest.approx(0.9, abs=0.06)


def test_a_record_of_no_frames_is_finite():
    record = FrameRecord()
    record.start(FakeModel())
    assert record.figures() == {"box_ap/mean_3d_ap": 0, "box_ap/mean_bev_ap": 0}
    assert record.to_plain(3, 2)["frames"] == []


def test_the_record_of_an_evaluation_gives_its_figures(trained):
    record = FrameRecord()
    figures = evaluate(trained, record=record)
    assert record.figures() == pytest.approx(figures)
    assert [frame.id for frame in record.frames] == [f"val{number:03d}" for number in range(10)]
    alone = [record.figures([row])["toy/accuracy"] for row in range(10)]
    assert sum(alone) / 10 == pytest.approx(figures["toy/accuracy"])


def test_a_filter_that_holds_frames_back_loses_none(trained):
    record = FrameRecord()
    assert evaluate(trained, ["filter=delay"], record)["toy/frames"] == 10
    assert [frame.id for frame in record.frames] == [f"val{number:03d}" for number in range(10)]


def test_eval_writes_figures_of_frames_and_prints_intervals(trained, tmp_path, capsys):
    file = tmp_path / "frames.json"
    assert main(["eval", str(trained), "--frames", str(file), "--resamples", "40", "--block", "4"]) == 0
    found = json.loads(file.read_text())
    assert len(found["by_frame"]["toy/accuracy"]) == len(found["frames"]) == 10
    assert len(found["resampled"]["toy/accuracy"]) == 40
    assert set(found["by_sequence"]) == {"val0", "val1", "val2"}
    low, high = interval(found["resampled"]["toy/accuracy"])
    assert f"[{low:.4f}, {high:.4f}]" in capsys.readouterr().out
    assert low <= found["figures"]["toy/accuracy"] <= high


def test_one_block_gives_no_intervals(trained, tmp_path, capsys):
    command = ["eval", str(trained), "dataset.toy.frames=4", "--frames", str(tmp_path / "f.json"), "--resamples", "5"]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "no intervals: all frames are one block of 10" in printed
    assert "[" not in printed


def test_eval_refuses_blocks_of_nothing(trained, tmp_path, capsys):
    assert main(["eval", str(trained), "--frames", str(tmp_path / "f.json"), "--block", "0"]) == 2
    assert "--block must be at least 1" in capsys.readouterr().err


def test_what_comes_after_the_heads_may_change(trained):
    """A filter that the training did not have; weights and heads stay what they are."""
    assert evaluate(trained, ["filter=delay"]) == evaluate(trained)
    with pytest.raises(ConfigError, match="head is part of the model"):
        evaluate(trained, ["head.toy.depth=1"])
    with pytest.raises(ConfigError, match="has no option 'nosuch'"):
        evaluate(trained, ["metric.toy.nosuch=1"])
