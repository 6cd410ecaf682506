"""Postprocessors `nms` and `circle_nms`, and the filter `score`."""

from __future__ import annotations

import math

import pytest
import torch

from lidarfw.components.filters.score import ScoreFilter
from lidarfw.components.postprocessors.nms import NMS, CircleNMS
from lidarfw.errors import ConfigError
from lidarfw.interfaces import PostProcessor
from lidarfw.ops import iou_bev
from lidarfw.types import Boxes, FrameMeta, FrameResult, Spec

SPEC = Spec(Boxes, classes=("Car", "Pedestrian"))


def make_boxes(number: int = 200, samples: int = 3, seed: int = 0) -> Boxes:
    """Crowded boxes with every optional field that detections may have."""
    random = torch.Generator().manual_seed(seed)
    place = torch.rand(number, 3, generator=random) * torch.tensor([30.0, 30.0, 1.0])
    size = torch.rand(number, 3, generator=random) * 3 + 1
    yaw = (torch.rand(number, 1, generator=random) * 2 - 1) * math.pi
    label, batch = (torch.randint(0, n, (number,), generator=random) for n in (2, samples))
    score = torch.rand(number, generator=random)
    boxes = Boxes.from_tensor(torch.cat([place, size, yaw], 1), label, score, batch, samples)
    extra = {"velocity": place[:, :2] * 2, "embedding": torch.rand(number, 4, generator=random), "stage": label + 1}
    return boxes.replace(**extra)


def assert_same(a: Boxes, b: Boxes) -> None:
    for name in ("tensor", "label", "score", "batch", "velocity", "embedding", "stage"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=0)
    assert a.batch_size == b.batch_size


@pytest.mark.parametrize(
    "post", [NMS(SPEC), NMS(SPEC, class_wise=True), CircleNMS(SPEC)], ids=["all", "class", "circle"]
)
class TestBoth:
    def test_keeps_rows_whole_and_sorted(self, post: PostProcessor) -> None:
        boxes = make_boxes()
        kept = post(boxes)
        assert 0 < len(kept) < len(boxes)
        rows = [(boxes.score == score).nonzero()[0, 0] for score in kept.score]
        assert_same(kept, boxes[torch.stack(rows)])
        order = kept.batch * 2.0 - kept.score
        assert order.equal(order.sort().values)

    def test_is_idempotent(self, post: PostProcessor) -> None:
        kept = post(make_boxes())
        assert_same(post(kept), kept)

    def test_frames_do_not_touch_each_other(self, post: PostProcessor) -> None:
        boxes = make_boxes()
        kept = post(boxes)
        for number in range(3):
            assert_same(kept.sample(number), post(boxes.sample(number)))

    def test_order_of_the_input_does_not_matter(self, post: PostProcessor) -> None:
        boxes = make_boxes()
        assert_same(post(boxes), post(boxes[torch.randperm(len(boxes), generator=torch.Generator().manual_seed(1))]))

    def test_empty(self, post: PostProcessor) -> None:
        for boxes in (Boxes.empty(2), make_boxes()[:0]):
            kept = post(boxes)
            assert (len(kept), kept.batch_size) == (0, boxes.batch_size)


def test_nms_suppresses_above_the_threshold_only() -> None:
    tensor = torch.tensor([[0, 0, 0, 4, 2, 1.5, 0], [1, 0, 5, 4, 2, 1.5, 0], [3.5, 0, 0, 4, 2, 1.5, 0]])
    boxes = Boxes.from_tensor(tensor, torch.tensor([0, 0, 0]), torch.tensor([0.9, 0.8, 0.7]))  # IoU .6, 1/15, .23
    assert NMS(SPEC)(boxes).score.tolist() == pytest.approx([0.9, 0.7])
    assert NMS(SPEC, iou_threshold=0.61)(boxes).score.tolist() == pytest.approx([0.9, 0.8, 0.7])
    assert NMS(SPEC, iou_threshold=0.05)(boxes).score.tolist() == pytest.approx([0.9])


def test_nms_leaves_no_overlap() -> None:
    kept = NMS(SPEC, iou_threshold=0.1)(make_boxes())
    overlap = iou_bev(kept.tensor, kept.tensor).fill_diagonal_(0)
    assert overlap[kept.batch[:, None] == kept.batch].max() <= 0.1
    assert overlap.max() > 0.1  # of different frames


def test_class_wise_nms_keeps_other_classes() -> None:
    tensor = torch.tensor([[0, 0, 0, 4, 2, 1.5, 0.0]]).repeat(3, 1)
    boxes = Boxes.from_tensor(tensor, torch.tensor([0, 1, 1]), torch.tensor([0.9, 0.8, 0.7]))
    assert NMS(SPEC)(boxes).label.tolist() == [0]
    assert NMS(SPEC, class_wise=True)(boxes).label.tolist() == [0, 1]


def test_limits_hold_per_frame() -> None:
    boxes = make_boxes(300)
    kept = NMS(SPEC, max_per_frame=4, score_threshold=0.5)(boxes)
    assert [len(s) for s in kept.samples()] == [4, 4, 4]
    assert kept.score.min() >= 0.5
    one = NMS(SPEC, max_candidates=1)(boxes)
    assert one.score.tolist() == [s.score.max().item() for s in boxes.samples()]


def test_circle_radius_is_per_class() -> None:
    tensor = torch.zeros(4, 7)
    tensor[:, 0] = torch.tensor([0.0, 1.5, 10.0, 11.5])
    tensor[:, 3:6] = 1
    boxes = Boxes.from_tensor(tensor, torch.tensor([0, 0, 1, 1]), torch.tensor([0.9, 0.8, 0.7, 0.6]))
    assert CircleNMS(SPEC, radius={"Car": 2.0})(boxes).score.tolist() == pytest.approx([0.9, 0.7, 0.6])
    assert CircleNMS(SPEC, default_radius=2.0)(boxes).score.tolist() == pytest.approx([0.9, 0.7])
    with pytest.raises(ConfigError, match=r"'Carr'[\s\S]*Did you mean 'Car'"):
        CircleNMS(SPEC, radius={"Carr": 2.0})


def test_score_filter_is_per_class() -> None:
    boxes = make_boxes(100, 1)
    other = make_boxes(5, 1)
    frame = FrameResult(FrameMeta("a"), {"head.center": boxes, "head.anchor": other})
    kept = ScoreFilter(SPEC, score={"Pedestrian": 0.8}, default_score=0.25)
    (result,) = kept.step(kept.start(), frame, boxes=boxes)
    found = result.predictions["head.center"]
    assert_same(found, boxes[boxes.score >= torch.tensor([0.25, 0.8])[boxes.label]])
    assert result.predictions["head.anchor"] is other
    assert frame.predictions["head.center"] is boxes
    with pytest.raises(ConfigError, match="'Bus'"):
        ScoreFilter(SPEC, score={"Bus": 0.5})
