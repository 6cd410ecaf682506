"""The monocular detector: golden numbers of its geometry and losses, and what must never break."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from lidarfw import assembly
from lidarfw.components.losses.center import penalty_reduced_focal
from lidarfw.config import compose
from lidarfw.errors import ConfigError, DataError
from lidarfw.testing.examples import street
from lidarfw.types import Boxes, Camera, DataSpec, Image, Spec, Targets, collate

from lidarfw_time3d.dla import DLA
from lidarfw_time3d.km3d import KM3D, KM3DOutput, between_cells, found_at
from lidarfw_time3d.km3d_loss import KM3DLoss, angles, depth_weight, ramp_up, seen, turn_loss
from lidarfw_time3d.monocular import Lens, keypoints, observation, overlap_2d, rectangles, solve, wrapped

AHEAD = ((0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera("pinhole", 640, 360, (700.0, 700.0, 320.0, 180.0), (), AHEAD)
DATA = DataSpec(classes=("Car", "Pedestrian"))
# section 13, H6: a car with ry = 0.3 at (2, 1, 15) in camera axes
BOX = torch.tensor([[15.0, -2, -1, 4, 1.6, 1.5, -0.3 - math.pi / 2]], dtype=torch.float64)
U = [511.321, 508.497, 313.056, 333.942, 511.321, 508.497, 313.056, 333.942, 413.333]
V = [260.734, 269.779, 262.621, 254.899, 191.533, 192.826, 191.803, 190.700, 226.667]


def lens(camera: Camera = CAMERA, count: int = 1) -> Lens:
    return Lens.of((camera,) * count, "cpu")


def pixels_of(boxes: torch.Tensor, view: Lens) -> torch.Tensor:
    return view.pixels(view.to_camera(keypoints(boxes)))


def test_keypoints_of_a_box_h6() -> None:
    found = pixels_of(BOX, lens())[0].numpy()
    expected = np.stack([U, V], 1)
    nearest = np.abs(found[:8, None] - expected[None, :8]).max(2).min(0)
    assert nearest.max() < 1e-3  # each golden corner is one of ours: only the order differs
    np.testing.assert_allclose(found[8], expected[8], atol=1e-3)


def test_the_place_from_keypoints_h6() -> None:
    view, pixel = lens(), pixels_of(BOX, lens())
    size, yaw = BOX[:, 3:6], BOX[:, 6]
    np.testing.assert_allclose(solve(pixel, size, yaw, view)[0], [15, -2, -1], atol=1e-9)
    moved = solve(pixel + torch.tensor([1.0, 0]), size, yaw, view)[0]
    np.testing.assert_allclose(moved, [15.005059, -2.022132, -1.000339], atol=1e-6)
    spread = pixel[:, 8:] + 1.02 * (pixel - pixel[:, 8:])
    np.testing.assert_allclose(solve(spread, size, yaw, view)[0], [14.707761, -1.959759, -0.980444], atol=1e-6)


def test_a_tilted_camera_gives_the_same_place() -> None:
    """Boxes stand upright in the sensor frame, not in that of the camera."""
    tilt, turn = 0.2, np.eye(4)
    turn[1:3, 1:3] = [[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]]
    turn[:3, 3] = [0.1, -0.2, 0.3]
    matrix = turn @ np.array(AHEAD)
    turn_of_camera, shift = matrix[:3, :3], matrix[:3, 3]
    rows: Any = tuple(tuple(float(value) for value in row) for row in matrix)
    view = lens(Camera("pinhole", 640, 360, CAMERA.intrinsics, (), rows))
    np.testing.assert_allclose(solve(pixels_of(BOX, view), BOX[:, 3:6], BOX[:, 6], view)[0], [15, -2, -1], atol=1e-8)
    pixel = pixels_of(BOX, view)[:, 8]
    x, y, _ = -turn_of_camera.T @ shift
    assert float(view.bearing(pixel)[0]) == pytest.approx(math.atan2(-2 - y, 15 - x))


def test_keypoints_that_fell_together_give_a_finite_place() -> None:
    pixel = torch.full((1, 9, 2), 300.0, dtype=torch.float64, requires_grad=True)
    place = solve(pixel, BOX[:, 3:6], BOX[:, 6], lens())
    place.sum().backward()  # type: ignore[no-untyped-call]
    assert place.isfinite().all()
    assert pixel.grad is not None
    assert pixel.grad.isfinite().all()
    none = solve(pixel[:0], BOX[:0, 3:6], BOX[:0, 6], Lens.of((), "cpu"))
    assert none.shape == (0, 3)


def test_focal_h9() -> None:
    p, y = torch.tensor([0.9, 0.2, 0.05]), torch.tensor([1, 0.6, 0])
    loss = penalty_reduced_focal(torch.logit(p), y)
    assert float(loss[0]) == pytest.approx(0.00105361, abs=1e-8)
    assert float(loss[1:].sum()) == pytest.approx(0.00035673, abs=1e-8)


def test_ramp_up_h11() -> None:
    expected = [0.0067379, 0.0600547, 0.2865048, 0.7316156, 1]
    assert [ramp_up(e / 100) for e in (0, 25, 50, 75, 100)] == pytest.approx(expected, abs=1e-7)
    assert ramp_up(2.0) == 1


def test_depth_weight() -> None:
    np.testing.assert_allclose(depth_weight(torch.tensor([3.0, 5, 14, 104])), [0.03, 0.1, 1.1, 2.1], atol=1e-6)


def test_bins_cover_every_angle() -> None:
    """The right bins and residuals cost less than any others, at every angle; and the heading comes back."""
    angle = torch.linspace(-3.1, 3.1, 25, dtype=torch.float64)
    away = wrapped(angle[:, None] - torch.tensor([-math.pi / 2, math.pi / 2]))
    inside = (away.abs() < 2 * math.pi / 3).double()
    right = torch.stack([9 - 18 * inside, 18 * inside - 9, away.sin(), away.cos()], 2).flatten(1)
    assert float(turn_loss(right, angle)) < 1e-5
    assert float(turn_loss(right, angle + 0.5)) > 0.05
    values = torch.zeros(25, 34, dtype=torch.float64)
    values[:, 23:31] = right
    output = found_at(_maps(), torch.zeros(25, dtype=torch.long), torch.zeros(25, 2, dtype=torch.long))
    output.values = values
    pixel = torch.tensor([[413.0, 227.0]], dtype=torch.float64).expand(25, 2)
    back = observation(output.yaw(pixel), output.lens.bearing(pixel))
    np.testing.assert_allclose(wrapped(back - angle), 0, atol=1e-6)


def test_rectangles_are_cut_at_the_picture_and_before_the_camera() -> None:
    boxes = torch.tensor([
        [20.0, 0, 0, 4, 2, 1.5, 0],  # ahead
        [2, 0, -1, 6, 2, 1.5, 0],  # reaches behind the camera
        [-20, 0, 0, 4, 2, 1.5, 0],  # behind
        [20, 100, 0, 4, 2, 1.5, 0],  # beside the picture
    ])  # fmt: skip
    left, top, right, bottom = rectangles(boxes, lens(count=4)).unbind(1)
    front = 20 - 2
    assert float(left[0]) == pytest.approx(320 - 700 / front)
    assert float(bottom[0]) == pytest.approx(180 + 700 * 0.75 / front)
    assert (float(left[1]), float(right[1]), float(bottom[1])) == (0, 639, 359)
    assert ((right - left)[2:] == 0).all()
    assert ((bottom >= top) & (right >= left)).all()


def _maps(classes: int = 2, height: int = 90, width: int = 160) -> KM3DOutput:
    heatmap = torch.full((1, classes, height, width), -6.0)
    return KM3DOutput(heatmap, torch.zeros(1, 34, height, width), torch.randn(1, 4, height, width), (CAMERA,), 4)


def _drawn(boxes: Boxes) -> KM3DOutput:
    """Maps that say exactly where the boxes are."""
    output = _maps()
    shown, rectangle = seen(output, boxes)
    middle = (rectangle[:, :2] + rectangle[:, 2:]) / 8
    cell = middle.floor().long()
    found = found_at(output, shown.batch, cell)
    values = torch.zeros(len(shown), 34, dtype=torch.float64)
    values[:, :18] = (pixels_of(shown.tensor, found.lens) / 4 - cell[:, None]).flatten(1)
    values[:, 18:20], values[:, 20:23] = middle - cell, shown.size
    away = wrapped(angles(found, shown)[:, None] - torch.tensor([-math.pi / 2, math.pi / 2]))
    inside = (away.abs() < 2 * math.pi / 3).double()
    values[:, 23:31] = torch.stack([9 - 18 * inside, 18 * inside - 9, away.sin(), away.cos()], 2).flatten(1)
    values[:, 31], values[:, 32:34] = 9, (rectangle[:, 2:] - rectangle[:, :2]) / 4
    output.regression[0, :, cell[:, 1], cell[:, 0]] = values.T.float()
    output.heatmap[0, shown.label, cell[:, 1], cell[:, 0]] = 6
    return output


SCENE = Boxes.from_tensor(
    torch.tensor([[15.0, -2, -1, 4, 1.6, 1.5, -1.9], [25, 5, -1, 0.7, 0.6, 1.75, 2.5], [9, 1, -1, 3.9, 1.6, 1.5, 0.1]]),
    torch.tensor([0, 1, 0]),
)


def _head(**options: Any) -> KM3D:
    return KM3D(Spec(Image, 8, 4, CAMERA), DATA, channels=8, appearance=4, **options).eval()


def test_maps_that_are_right_decode_to_the_boxes_and_cost_nothing() -> None:
    output = _drawn(SCENE)
    boxes = _head().decode(output)
    order = boxes.center[:, 0].argsort()
    expected = SCENE[SCENE.center[:, 0].argsort()]
    assert boxes.label[order].tolist() == expected.label.tolist()
    torch.testing.assert_close(boxes.tensor[order][:, :6], expected.tensor[:, :6], atol=1e-2, rtol=0)
    assert wrapped(boxes.yaw[order] - expected.yaw).abs().max() < 1e-3
    assert boxes.box2d is not None
    assert overlap_2d(boxes.box2d[order], rectangles(expected.tensor, lens(count=3)).float()).diag().min() > 0.999
    assert boxes.embedding is not None
    assert boxes.embedding.shape == (3, 4)
    terms = KM3DLoss(Spec(Boxes))(output, Targets(boxes=SCENE), 1.0)
    assert {name: round(float(value), 2) for name, value in terms.items()} == dict.fromkeys(terms, 0.0)


def test_each_mistake_costs_its_own_term() -> None:
    loss, targets = KM3DLoss(Spec(Boxes)), Targets(boxes=SCENE)
    right = loss(_drawn(SCENE), targets, 1.0)
    for channels, name in (((0, 18), "keypoints"), ((18, 20), "offset"), ((20, 23), "size"), ((32, 34), "extent")):
        output = _drawn(SCENE)
        output.regression[:, channels[0] : channels[1]] += 0.5
        wrong = loss(output, targets, 1.0)
        assert float(wrong[name]) > float(right[name]) + 0.02
        others = {"keypoints", "offset", "size", "extent", "turn", "heatmap"} - {name}
        assert all(float(wrong[other]) == pytest.approx(float(right[other]), abs=1e-6) for other in others)


def test_the_place_is_learned_late() -> None:
    """Its weight is 0 until the ramp is at 0.3, half way through the rise."""
    output = _drawn(SCENE)
    output.regression[:, :18] *= 1.1
    loss, targets = KM3DLoss(Spec(Boxes), rise=0.5), Targets(boxes=SCENE)
    early, later, late = (float(loss(output, targets, progress)["position"]) for progress in (0.2, 0.3, 0.5))
    assert early == 0 < later < late


def test_what_cannot_be_seen_is_not_learned() -> None:
    """Behind the camera, beside the picture, without extent: no positives, finite; a truncated one is learned."""
    behind = torch.tensor([[-15.0, 2, 0, 4, 2, 1.5, 0], [15, 90, 0, 4, 2, 1.5, 0], [15, 0, 0, 0, 0, 0, 0]])
    hidden = Boxes.from_tensor(behind, torch.zeros(3, dtype=torch.long))
    assert len(seen(_maps(), hidden)[0]) == 0
    truncated = Boxes.from_tensor(torch.tensor([[3.0, 1, -1, 5, 2, 1.5, 0.2]]), torch.tensor([0]))
    for boxes in (hidden, hidden[:0], truncated):
        output = _maps()
        output.regression.requires_grad_()
        terms = KM3DLoss(Spec(Boxes))(output, Targets(boxes=boxes), 1.0)
        torch.stack(list(terms.values())).sum().backward()  # type: ignore[no-untyped-call]
        assert all(value.isfinite() for value in terms.values())
        assert output.regression.grad is not None
        assert output.regression.grad.isfinite().all()
    assert len(seen(_maps(), truncated)[0]) == 1


def test_ignored_rectangles_cost_nothing() -> None:
    output = _maps()
    output.heatmap[0, 0, 40:50, 60:80] = 3  # peaks where a region is not labelled
    region = Boxes.from_tensor(torch.zeros(1, 7), torch.tensor([-1])).replace(
        box2d=torch.tensor([[230.0, 150, 330, 210]])
    )
    loss = KM3DLoss(Spec(Boxes))
    free = loss(output, Targets(boxes=SCENE[:0], ignored=region), 1.0)["heatmap"]
    paid = loss(output, Targets(boxes=SCENE[:0]), 1.0)["heatmap"]
    assert float(free) < 0.1 * float(paid)


def test_nothing_before_the_camera_gives_no_boxes() -> None:
    output = _maps()
    output.regression[:, :18] = -1000  # keypoints anywhere: places behind the camera or nowhere
    boxes = _head().decode(output)
    assert boxes.tensor.isfinite().all()
    assert (boxes.center[:, 0] > 0).all()
    assert len(_head(score_threshold=0.9).decode(_maps())) == 0


def test_more_peaks_than_places_keep_the_best() -> None:
    assert len(_head(max_objects=2).decode(_drawn(SCENE))) == 2


def test_values_between_cells() -> None:
    maps = torch.arange(12.0).reshape(1, 1, 3, 4)
    place = torch.tensor([[0.0, 0], [1.5, 0], [1, 1.5], [3, 2], [9, 9], [-5, 1]])
    values = between_cells(maps, torch.zeros(6, dtype=torch.long), place)
    assert values[:, 0].tolist() == [0, 1.5, 7, 11, 11, 4]


def test_only_rectified_pictures() -> None:
    bent = Camera("pinhole", 640, 360, CAMERA.intrinsics, (0.1, 0, 0, 0), AHEAD)
    with pytest.raises(DataError, match="rectified"):
        lens(bent)
    fisheye = Camera("fisheye", 640, 360, CAMERA.intrinsics)
    with pytest.raises(ConfigError, match="fisheye"):
        KM3D(Spec(Image, 8, 4, fisheye), DATA)


def test_dla_34_is_the_network_of_the_paper() -> None:
    """15.2 million weights without the classifier (table 1: 15.8 with its 0.5), one map at stride 4, any size."""
    network = DLA(Spec(Image, 3, 1, CAMERA))
    trunk = sum(p.numel() for part in (network.base, network.stages) for p in part.parameters())
    assert trunk == 15_229_104
    small = DLA(Spec(Image, 3, 1, CAMERA), channels=(4, 4, 8, 8, 8, 8), depths=(1, 1, 1, 1)).eval()
    for height, width in ((64, 96), (37, 53)):
        features = small(Image(torch.randn(1, 3, height, width), (CAMERA,))).features
        assert features.shape == (1, 8, -(-height // 4), -(-width // 4))


def _model(end_to_end: bool) -> Any:
    config = compose([
        "dataset=synthetic", "dataset.synthetic.image=true", "dataset.synthetic.pose=true", "backbone=dla_small",
        "neck=[]", "head=km3d_small", "loss=[km3d,association,temporal_consistency]", "tracker=time3d_small",
        "metric=[mot3d]", "postprocessor=[]", "head.km3d.score_threshold=0", f"tracker.time3d.end_to_end={end_to_end}",
    ])  # fmt: skip
    torch.manual_seed(0)
    return assembly.build(assembly.plan(config))


@pytest.mark.parametrize("end_to_end", [True, False])
def test_the_association_loss_reaches_the_detector(end_to_end: bool) -> None:
    model = _model(end_to_end).train()
    batch = collate(list(street(3)))
    losses = model.losses(model(batch), batch, 1.0)
    assert float(losses["association"]["association"].detach()) > 0
    losses["association"]["association"].backward()
    parts = {name: getattr(model.head["km3d"].last, name).weight.grad for name in ("embedding", "keypoints", "size")}
    reached = {name: grad is not None and bool((grad != 0).any()) for name, grad in parts.items()}
    assert reached == dict.fromkeys(parts, end_to_end)
    image = model.backbone["dla"].base[0].weight.grad
    assert (image is not None and bool((image != 0).any())) == end_to_end
