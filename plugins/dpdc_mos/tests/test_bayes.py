"""The Bayes filter over short made-up sequences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import Boxes, DataSpec, FrameMeta, FrameResult, PointLabels, Points, Poses, Spec

from lidarfw_dpdc_mos.bayes import BayesFilter, BayesState

LABELS = Spec(PointLabels, classes=("static", "moving"))
POSE = Spec(Poses)


def bayes(pose: Spec | None = POSE, **options: Any) -> BayesFilter:
    return BayesFilter(LABELS, Spec(Points, 1), pose, None, DataSpec(), **options)


def labels_of(xi: Sequence[float]) -> PointLabels:
    moving = torch.tensor(list(xi))
    return PointLabels(torch.stack([1 - moving, moving], 1), torch.zeros(len(xi), dtype=torch.long))


def step(
    part: BayesFilter,
    state: BayesState,
    time: float,
    xyz: Sequence[Sequence[float]],
    xi: Sequence[float],
    x: float = 0.0,
    **more: Any,
) -> list[FrameResult]:
    """One frame of a sensor that stands at `x`."""
    points = Points.from_scan(torch.tensor([list(map(float, p)) for p in xyz]).view(-1, 3), torch.zeros(len(xyz), 1))
    labels = labels_of(xi)
    matrix = torch.eye(4)[None].clone()
    matrix[0, 0, 3] = x
    pose = Poses(matrix, torch.ones(1, dtype=torch.bool), torch.ones(1))
    frame = FrameResult(FrameMeta(f"{time:.1f}", time=time), {"head.moving_seg": labels})
    return part.step(state, frame, labels, points, pose, **more)


def moving(result: FrameResult) -> list[float]:
    return result.of(PointLabels).probability[:, 1].tolist()


def still(xi: Sequence[float], **options: Any) -> list[float]:
    """Probabilities that come out for one point that stays where it is."""
    part = bayes(**options)
    state = part.start()
    out = [r for i, value in enumerate(xi) for r in step(part, state, 0.1 * i, [(10, 0, 0)], [value])]
    return [moving(r)[0] for r in [*out, *part.flush(state)]]


@pytest.mark.parametrize("transport", ["warp", "voxel"])
def test_log_odds_of_a_still_point(transport: str) -> None:
    assert still([0.6, 0.7, 0.2], window=3, transport=transport) == pytest.approx([0.6, 0.913043, 0.887324], abs=1e-5)
    for prior, expected in ((0.5, 0.466667), (0.1, 0.986087), (0.01, 0.999883)):
        assert still([0.6, 0.7, 0.2], window=3, prior=prior, transport=transport)[-1] == pytest.approx(
            expected, abs=1e-5
        )
    window = still([0.6, 0.7, 0.2, 0.9], window=2, transport=transport)
    assert window == pytest.approx([0.6, 0.913043, 0.636364, 0.870968], abs=1e-5)


def test_what_a_prior_below_a_half_does() -> None:
    """Two frames of 0.5 give 0.75; the threshold of the mean logit at N = 1, 2, 5, 10."""
    assert still([0.5, 0.5])[-1] == pytest.approx(0.75, abs=1e-6)
    for frames, threshold in ((1, 0.5), (2, 0.366), (5, 0.293), (10, 0.271)):
        for offset, side in ((0.002, True), (-0.002, False)):
            assert (still([threshold + offset] * frames, window=frames)[-1] > 0.5) is side


def test_gates_of_the_transport() -> None:
    """The sensor moves 1 m ahead: what stands still comes 1 m nearer, what moved 1 m stays at its range."""
    for max_speed, delta in ((15.0, 1.5), (5.0, 0.5)):
        part = bayes(max_speed=max_speed)
        state = part.start()
        step(part, state, 0.0, [(10, 0, 0), (0, 20, 0)], [0.9, 0.9])
        (result,) = step(part, state, 0.1, [(9.05, 0, 0), (-1, 20, 0)], [0.5, 0.5], x=1.0)
        assert moving(result) == pytest.approx([27 / 28] * 2, abs=1e-5)  # 9 * 3 : 1
        part = bayes(max_speed=max_speed)
        state = part.start()
        step(part, state, 0.0, [(10, 0, 0)], [0.9])
        (result,) = step(part, state, 0.1, [(10, 0, 0)], [0.5], x=1.0)
        assert (moving(result)[0] > 0.9) is (delta >= 1)


def test_motion_compensation_follows_an_object() -> None:
    boxes = Boxes.from_tensor(torch.tensor([[10.0, 0, 0, 4, 2, 2, 0]]), torch.tensor([0])).replace(
        velocity=torch.tensor([[20.0, 0.0]])
    )
    for follow, expected in ((True, 27 / 28), (False, 0.5)):
        part = bayes(motion_compensation=follow, max_speed=1.0)
        state = part.start()
        step(part, state, 0.0, [(10, 0, 0)], [0.9], boxes=boxes)
        (result,) = step(part, state, 0.1, [(12, 0, 0)], [0.5], boxes=boxes)
        assert moving(result)[0] == pytest.approx(expected, abs=1e-5)


def test_a_window_of_later_frames() -> None:
    """With a delay the later frames speak too; every frame comes out once and in order."""
    part = bayes(window=3, delay=2)
    state = part.start()
    assert [step(part, state, 0.1 * i, [(10, 0, 0)], [xi]) for i, xi in enumerate([0.6, 0.7])] == [[], []]
    (first,) = step(part, state, 0.2, [(10, 0, 0)], [0.2])
    assert (first.meta.id, moving(first)[0]) == ("0.0", pytest.approx(0.887324, abs=1e-5))
    rest = part.flush(state)
    assert [r.meta.id for r in rest] == ["0.1", "0.2"]
    assert part.flush(state) == []


def test_points_that_the_network_predicts_again() -> None:
    """Transport by point: evidence of a scan is what all passes over it said (4DMOS)."""
    part = bayes(pose=None, transport="point", window=2, delay=1)
    state = part.start()
    xyz = torch.tensor([[10.0, 0, 0], [5.0, 5, 0]])
    out: list[FrameResult] = []
    for i, (now, again) in enumerate([([0.6, 0.1], None), ([0.5, 0.5], [0.7, 0.2])]):
        both = now if again is None else now + again
        time = torch.tensor([0.0, 0.0] if again is None else [0.0, 0.0, -0.1, -0.1])
        points = Points.from_scan(xyz.repeat(len(both) // 2, 1), torch.zeros(len(both), 1), time)
        labels = labels_of(both)
        frame = FrameResult(FrameMeta(str(i), time=0.1 * i), {"head.moving_seg": labels})
        out += part.step(state, frame, labels, points)
    expected = [1 / (1 + math.exp(-(math.log(a / (1 - a)) + math.log(b / (1 - b)) + math.log(3)))) for a, b in
                ((0.6, 0.7), (0.1, 0.2))]  # fmt: skip
    assert moving(out[0]) == pytest.approx(expected, abs=1e-5)


def test_tempering_forgetting_and_a_prior_of_the_point() -> None:
    logit = math.log(0.7 / 0.3) + math.log(3)
    assert still([0.7, 0.5], tempering=0.5)[-1] == pytest.approx(
        1 / (1 + math.exp(-(-math.log(3) + 0.5 * (logit + math.log(3))))), abs=1e-5
    )
    assert still([0.7, 0.5], forgetting=0.5)[-1] == pytest.approx(1 / (1 + math.exp(-(0.5 * logit))), abs=1e-5)
    part = bayes(adaptive=(1.0, -2.0, 0.5))
    assert part.prior_log_odds(torch.tensor([[3.0, 0, 4.0]])).tolist() == pytest.approx([1 - 2 * math.log(5) + 2])
    assert still([0.3], adaptive=(1.0, -2.0, 0.5)) == pytest.approx([0.3], abs=1e-6)  # one frame: the prior cancels


def test_certain_absent_and_broken_probabilities() -> None:
    for transport in ("warp", "voxel"):
        assert all(0 < p < 1 for p in still([0.0, 1.0, 1.0, 0.0], window=4, transport=transport))
    part = bayes()
    state = part.start()
    labels = PointLabels(torch.tensor([[0.0, 0.0], [float("nan")] * 2]), torch.zeros(2, dtype=torch.long))
    points = Points.from_scan(torch.tensor([[5.0, 0, 0], [0, 5.0, 0]]), torch.zeros(2, 1))
    (result,) = part.step(state, FrameResult(FrameMeta("0"), {"h": labels}), labels, points)
    assert moving(result) == pytest.approx([0.25, 0.25])
    assert result.of(PointLabels).probability.sum(1).tolist() == pytest.approx([1, 1])
    assert state.unknown == 1


def test_an_empty_frame_moves_the_window_on() -> None:
    part = bayes(window=2)
    state = part.start()
    step(part, state, 0.0, [(10, 0, 0)], [0.9])
    (result,) = step(part, state, 0.1, [], [])
    assert moving(result) == []
    (result,) = step(part, state, 0.2, [(10, 0, 0)], [0.9])
    assert moving(result) == pytest.approx([0.9], abs=1e-6)


def test_a_gap_starts_anew_and_lets_go_what_was_held() -> None:
    part = bayes(window=2, delay=1)
    state = part.start()
    assert step(part, state, 0.0, [(10, 0, 0)], [0.9]) == []
    held = step(part, state, 0.8, [(10, 0, 0)], [0.6])
    assert [r.meta.id for r in held] == ["0.0"]
    assert moving(part.flush(state)[0]) == pytest.approx([0.6], abs=1e-6)


def test_memory_is_bounded() -> None:
    part = bayes(window=3)
    state = part.start()
    for i in range(20):
        step(part, state, 0.1 * i, [(10, 0, 0)], [0.5])
        assert len(state.window) <= 3
        assert sum(seen.result is not None for seen in state.window) == 0


def test_more_than_two_classes_share_the_rest() -> None:
    part = BayesFilter(
        Spec(PointLabels, classes=("road", "car", "moving")), Spec(Points, 1), POSE, None, DataSpec(), window=2
    )
    labels = PointLabels(torch.tensor([[0.2, 0.2, 0.6], [0.0, 0.0, 0.0]]), torch.zeros(2, dtype=torch.long))
    points = Points.from_scan(torch.tensor([[5.0, 0, 0], [0, 5.0, 0]]), torch.zeros(2, 1))
    (result,) = part.step(part.start(), FrameResult(FrameMeta("0"), {"h": labels}), labels, points)
    expected = [[0.2, 0.2, 0.6], [0.375, 0.375, 0.25]]
    assert torch.allclose(result.of(PointLabels).probability, torch.tensor(expected), atol=1e-5)


def test_without_poses_it_warns() -> None:
    with pytest.warns(UserWarning, match="no poses"):
        part = bayes(pose=None)
    state = part.start()
    points = Points.from_scan(torch.tensor([[5.0, 0, 0]]), torch.zeros(1, 1))
    for i in range(2):
        labels = labels_of([0.5])
        (result,) = part.step(state, FrameResult(FrameMeta("0", time=0.1 * i), {"h": labels}), labels, points)
    assert moving(result) == pytest.approx([0.75], abs=1e-6)


def test_errors_name_the_option() -> None:
    for options, text in (
        ({"transport": "fly"}, "warp, voxel, point"),
        ({"window": 2, "delay": 2}, "delay < window"),
        ({"prior": 0.0}, "between 0 and 1"),
        ({"adaptive": (1.0,)}, "three numbers"),
        ({"moving": "moves"}, "Did you mean 'moving'"),
    ):
        with pytest.raises(ConfigError, match=text):
            bayes(**options)
