"""Box voting against values worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from lidarfw.components.postprocessors.nms import NMS
from lidarfw.errors import ConfigError
from lidarfw.types import Boxes, Spec

from lidarfw_msrm.postprocessors.box_voting import BoxVoting


def stages(x: list[float], yaw: list[float], score: list[float]) -> Boxes:
    """One region in as many stages as there are numbers."""
    count = len(x)
    rows = [[x[n], 0, 0, 4, 2, 1.5, yaw[n]] for n in range(count)]
    label = torch.zeros(count, dtype=torch.long)
    found = Boxes.from_tensor(torch.tensor(rows), label, torch.tensor(score))
    return found.replace(stage=torch.arange(1, count + 1))


def vote(boxes: Boxes, **options: object) -> Boxes:
    return BoxVoting(Spec(Boxes), **options)(boxes)  # type: ignore[arg-type]


def test_boxes_are_weighted_by_confidence() -> None:
    found = vote(stages([10, 10.2, 10.6], [0, 0, 0], [0.9, 0.6, 0.3]))
    torch.testing.assert_close(found.center[0, 0], torch.tensor(10.166667))
    torch.testing.assert_close(found.score, torch.tensor([0.6]))
    assert found.stage is None


@pytest.mark.parametrize(
    ("yaw", "expected"),
    [([3.10, -3.12, 3.14], 3.127728), ([0.10, 0.10 + math.pi - 0.04, 0.16], 0.096662)],
)
def test_yaw_is_averaged_on_the_circle(yaw: list[float], expected: float) -> None:
    found = vote(stages([0, 0, 0], yaw, [0.9, 0.6, 0.3]))
    torch.testing.assert_close(found.yaw[0], torch.tensor(expected), atol=1e-5, rtol=0)


@pytest.mark.parametrize("score", [[0.5, 0.5, 0.5], [0.0, 0.0, 0.0]])
def test_equal_or_no_confidence_gives_the_plain_mean(score: list[float]) -> None:
    found = vote(stages([1, 2, 6], [0, 0, 0], score))
    torch.testing.assert_close(found.center[0, 0], torch.tensor(3.0))


def test_uniform_weights_give_the_plain_mean() -> None:
    found = vote(stages([1, 2, 6], [0, 0, 0], [0.9, 0.1, 0.1]), weights="uniform")
    torch.testing.assert_close(found.center[0, 0], torch.tensor(3.0))


def test_the_scale_of_confidence_changes_no_box() -> None:
    one = vote(stages([1, 2, 6], [0.1, 0.2, 0.3], [0.09, 0.06, 0.03]))
    ten = vote(stages([1, 2, 6], [0.1, 0.2, 0.3], [0.9, 0.6, 0.3]))
    torch.testing.assert_close(one.tensor, ten.tensor)


def test_one_stage_stays_as_it_is() -> None:
    single = stages([5], [0.3], [0.7])
    torch.testing.assert_close(vote(single).tensor, single.tensor)
    unstaged = single.replace(stage=None)
    torch.testing.assert_close(vote(unstaged).tensor, single.tensor)


def test_only_the_chosen_stages_vote() -> None:
    found = stages([1, 2, 6], [0, 0, 0], [0.5, 0.5, 0.5])
    torch.testing.assert_close(vote(found, stages=(2, 3)).center[0, 0], torch.tensor(4.0))
    torch.testing.assert_close(vote(found, stages=(1,)).tensor, found.tensor[:1])
    with pytest.raises(ConfigError, match=r"there are boxes of the stages \[1, 2, 3\]"):
        vote(found, stages=(4,))


@pytest.mark.parametrize("mode", ["stage", "cluster"])
def test_proposals_vote_only_when_they_are_named(mode: str) -> None:
    found = stages([1, 1.2, 1.6], [0, 0, 0], [0.9, 0.5, 0.5])
    found = found.replace(stage=torch.arange(3))
    torch.testing.assert_close(vote(found, mode=mode).center[0, 0], torch.tensor(1.4))
    torch.testing.assert_close(vote(found, mode=mode, stages=(0,)).tensor, found.tensor[:1])


def test_regions_vote_apart_in_their_samples() -> None:
    parts = []
    for batch in (0, 1):
        for stage in (1, 2):
            x = torch.tensor([[0.0], [20.0], [40.0]])[: 3 - batch] + stage + 100 * batch
            rows = torch.cat([x, torch.zeros(len(x), 2), torch.ones(len(x), 3), torch.zeros(len(x), 1)], 1)
            label = torch.zeros(len(x), dtype=torch.long)
            one = Boxes.from_tensor(rows, label, torch.full((len(x),), 0.5), label + batch, 2)
            parts.append(one.replace(stage=label + stage))
    mixed = Boxes.cat([parts[1], parts[2], parts[0], parts[3]])
    found = vote(mixed)
    assert found.batch.tolist() == [0, 0, 0, 1, 1]
    torch.testing.assert_close(found.center[:, 0], torch.tensor([1.5, 21.5, 41.5, 101.5, 121.5]))


def test_only_the_best_regions_of_each_sample_vote() -> None:
    """Three regions in the first sample, two in the second, each in two stages."""
    batch, stage = torch.tensor([0] * 3 + [1] * 2).repeat(2), torch.tensor([1, 2]).repeat_interleave(5)
    rows = torch.zeros(10, 7)
    rows[:, 0], rows[:, 3:6] = 10.0 * torch.arange(5).repeat(2) + stage, 1
    label = torch.zeros(10, dtype=torch.long)
    found = Boxes.from_tensor(rows, label, torch.full((10,), 0.5), batch, 2).replace(stage=stage)
    torch.testing.assert_close(vote(found, regions=1).center[:, 0], torch.tensor([1.5, 31.5]))
    assert vote(found, regions=2).batch.tolist() == [0, 0, 1, 1]
    torch.testing.assert_close(vote(found, regions=9).tensor, vote(found).tensor)
    with pytest.raises(ConfigError, match="at least 1"):
        vote(found, regions=0)


def test_stages_of_different_numbers_are_refused() -> None:
    with pytest.raises(ConfigError, match="mode: cluster"):
        vote(Boxes.cat([stages([1, 2], [0, 0], [0.5, 0.5]), stages([9], [0], [0.5])]))


def test_clusters_of_any_detector() -> None:
    score = [0.9, 0.3, 0.8, 0.2]
    near = stages([0.0, 0.4, 20.0, 0.2], [0, 0, 0, math.pi], score).replace(stage=None)
    found = vote(near, mode="cluster")
    assert len(found) == 2
    expected = (0.9 * 0 + 0.3 * 0.4 + 0.2 * 0.2) / 1.4
    torch.testing.assert_close(found.center[:, 0], torch.tensor([expected, 20.0]))
    torch.testing.assert_close(found.score, torch.tensor([1.4 / 3, 0.8]))
    other = near.replace(label=torch.tensor([0, 1, 0, 1]))
    assert len(vote(other, mode="cluster")) == 3


@pytest.mark.parametrize("mode", ["stage", "cluster"])
def test_nothing_in_nothing_out(mode: str) -> None:
    assert len(vote(stages([1], [0], [0.5])[:0], mode=mode)) == 0


def test_suppression_after_the_vote() -> None:
    def left(shift: float) -> int:
        two = Boxes.cat([stages([0.0], [0], [0.9]), stages([shift], [0], [0.8])]).replace(stage=None)
        return len(NMS(Spec(Boxes), iou_threshold=0.1)(vote(two)))

    assert left(1.0) == 1  # IoU 0.6
    assert left(3.62) == 2  # IoU 0.05


def test_unknown_options_are_refused() -> None:
    with pytest.raises(ConfigError, match="mode is one of stage, cluster"):
        BoxVoting(Spec(Boxes), mode="best")
