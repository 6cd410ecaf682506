"""Head and loss `anchor`."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from lidarfw.components.heads.anchor import AnchorHead, AnchorOutput, decode, direction_bin, encode, turn
from lidarfw.components.losses.anchor import NEGATIVE, NEITHER, AnchorLoss, focal, match
from lidarfw.errors import ConfigError
from lidarfw.types import BEV, Boxes, DataSpec, Grid, Spec, Targets

GRID = Grid((0.0, -12.8, -3.0), (25.6, 12.8, 1.0), (0.4, 0.4, 4.0))
CLASSES = ("Car", "Pedestrian", "Cyclist")
STRIDE = 2
SIZES = torch.tensor([[3.9, 1.6, 1.56], [0.8, 0.6, 1.73], [1.76, 0.6, 1.73]])


def head_of(classes: tuple[str, ...] = CLASSES, **options: object) -> AnchorHead:
    torch.manual_seed(0)
    return AnchorHead(Spec(BEV, 8, STRIDE, GRID), DataSpec(targets=frozenset({Boxes}), classes=classes), **options)


def bev_of(samples: int = 2, seed: int = 1) -> BEV:
    _, height, width = GRID.shape(STRIDE)
    return BEV(torch.randn(samples, 8, height, width, generator=torch.Generator().manual_seed(seed)), GRID, STRIDE)


def spread_boxes(number: int, samples: int, seed: int = 0) -> Boxes:
    """Boxes of the usual sizes at distinct places, of all classes and headings."""
    random = torch.Generator().manual_seed(seed)
    cells = torch.randperm(16, generator=random)[:number]  # of a 4 x 4 lattice of 6.4 m
    corner = torch.stack([cells % 4, cells // 4], 1) * 6.4 + torch.tensor([0.0, -12.8])
    xy = corner + 2.8 + torch.rand(number, 2, generator=random) * 0.8
    label = torch.arange(number) % 3
    size = SIZES[label] * (1 + 0.1 * (torch.rand(number, 3, generator=random) - 0.5))
    yaw = (torch.rand(number, generator=random) * 2 - 1) * math.pi
    z = -1 + 0.2 * torch.rand(number, 1, generator=random)
    batch = torch.arange(number) % samples
    return Boxes.from_tensor(torch.cat([xy, z, size, yaw[:, None]], 1), label, None, batch, samples)


def perfect(head: AnchorHead, boxes: Boxes, sharp: float = 20.0) -> AnchorOutput:
    """The output that says exactly `boxes` at the anchors assigned to them; leaves of the graph."""
    output = head.eval()(bev_of(boxes.batch_size))
    chosen = AnchorLoss(head.provides).assign(output, boxes, None)
    score, residual = torch.full_like(output.score, -sharp), torch.zeros_like(output.residual)
    direction = torch.zeros_like(output.direction)
    sample, row = (chosen >= 0).nonzero().unbind(1)
    own = boxes[chosen[sample, row]]
    score[sample, row, own.label] = sharp
    residual[sample, row] = encode(own.tensor, output.anchors[row])
    direction[sample, row, direction_bin(own.yaw)] = 2 * sharp
    leaves = {"score": score, "residual": residual, "direction": direction}
    return replace(output, **{name: value.requires_grad_() for name, value in leaves.items()})


def test_residual_golden_and_inverse() -> None:
    anchor = torch.tensor([[0, 0, 0, 3.9, 1.6, 1.56, 0]])
    box = torch.tensor([[1, 0.5, 0.2, 4.2, 1.7, 1.5, 0.1]])
    golden = torch.tensor([[0.237223, 0.118611, 0.128205, 0.074108, 0.060625, -0.039221, 0.1]])
    torch.testing.assert_close(encode(box, anchor), golden, atol=1e-6, rtol=0)
    boxes, anchors = spread_boxes(16, 1).tensor, spread_boxes(16, 1, seed=3).tensor
    torch.testing.assert_close(decode(encode(boxes, anchors), anchors), boxes, atol=1e-5, rtol=0)


def test_yaw_is_known_from_half_turn_and_direction() -> None:
    yaw = torch.linspace(-math.pi + 1e-3, math.pi - 1e-3, 401)
    yaw = yaw[((yaw - math.pi / 4).remainder(math.pi) - math.pi / 2).abs() < math.pi / 2 - 1e-3]  # off the bin edges
    for turns in (-math.pi, 0.0, math.pi):
        torch.testing.assert_close(turn(yaw + turns, direction_bin(yaw)), yaw, atol=1e-5, rtol=0)
    assert direction_bin(torch.tensor([0.0, math.pi / 2, math.pi, -math.pi / 2])).tolist() == [1, 0, 0, 1]


def test_anchors_stand_at_cell_centres_on_the_ground() -> None:
    head = head_of()
    anchors = head.anchors.view(32, 32, 3, 2, 7)
    torch.testing.assert_close(anchors[0, 0, 0, 0], torch.tensor([0.4, -12.4, -1.78 + 0.78, 3.9, 1.6, 1.56, 0.0]))
    torch.testing.assert_close(anchors[5, 9, 1, 1], torch.tensor([7.6, -8.4, -0.6, 0.8, 0.6, 1.73, math.pi / 2]))
    assert head.label.view(32, 32, 3, 2)[7, 7].tolist() == [[0, 0], [1, 1], [2, 2]]
    assert not {"anchors", "label", "thresholds"} & set(head.state_dict())


def test_perfect_output_decodes_to_the_boxes() -> None:
    head, boxes = head_of(), spread_boxes(15, 3)
    found = head.decode(perfect(head, boxes))
    found = found[found.score > 0.5]
    for sample in range(3):
        mine, truth = found.sample(sample), boxes.sample(sample)
        apart = torch.cdist(mine.center, truth.center)
        assert (apart.amin(0) < 1e-4).all()  # every box is found, most by several anchors
        torch.testing.assert_close(mine.tensor, truth.tensor[apart.argmin(1)], atol=1e-4, rtol=0)
        assert mine.label.equal(truth.label[apart.argmin(1)])


def test_decode_orders_limits_and_thresholds() -> None:
    head = head_of(max_objects=50).eval()
    for sample in head.decode(head(bev_of(3))).samples():
        assert len(sample) == 50
        assert sample.score.equal(sample.score.sort(descending=True).values)
    assert len(head_of(score_threshold=0.9).eval().decode(head(bev_of(3)))) == 0


def test_untrained_head_is_nearly_sure_of_nothing() -> None:
    head = head_of().eval()
    output = head(BEV(torch.zeros(1, 8, 32, 32), GRID, STRIDE))
    torch.testing.assert_close(output.score.sigmoid(), torch.full_like(output.score, 0.01))


def test_provides_and_tap_tell_the_truth() -> None:
    head, bev = head_of(), bev_of(2)
    output = head(bev)
    assert head.provides == Spec(Boxes, classes=CLASSES)
    assert head.tap == Spec(BEV, 8, STRIDE, GRID)
    assert output.tap is bev
    assert output.score.shape == (2, 32 * 32 * 6, 3)


def test_scores_belong_to_their_anchor() -> None:
    """A feature at one cell reaches the anchors of that cell alone."""
    head = head_of().eval()
    features = torch.zeros(1, 8, 32, 32)
    base = head(BEV(features.clone(), GRID, STRIDE))
    features[0, :, 20, 3] = 1.0
    output = head(BEV(features, GRID, STRIDE))
    for name in ("score", "residual", "direction"):
        changed = (getattr(output, name) != getattr(base, name)).any(2)[0]
        places = output.anchors[changed][:, :2]
        assert changed.sum() == 6
        torch.testing.assert_close(places, torch.tensor([[2.8, 3.6]]).expand(6, 2))


def test_class_without_anchor_is_refused_with_a_fix() -> None:
    with pytest.raises(ConfigError, match=r"'Tram'[\s\S]*head\.anchor\.anchors=\{Tram: \{size"):
        head_of(("Car", "Tram"))
    tram = {"size": [16.0, 2.5, 3.5], "bottom": -1.8, "matched": 0.6, "unmatched": 0.4}
    with pytest.raises(ConfigError, match="'Tram'"):
        head_of(("Car", "Truck"), anchors={"Tram": tram})
    head = head_of(("Car", "Tram"), anchors={"Tram": tram})
    assert head.anchors.view(32, 32, 2, 2, 7)[0, 0, 1, 0, 3].item() == 16.0
    torch.testing.assert_close(head.thresholds, torch.tensor([[0.6, 0.45], [0.6, 0.4]]))


@pytest.mark.parametrize(
    "anchor",
    [
        {"size": [3.9, 1.6], "bottom": -1.78, "matched": 0.6, "unmatched": 0.45},
        {"size": [3.9, 1.6, -1.5], "bottom": -1.78, "matched": 0.6, "unmatched": 0.45},
        {"size": [3.9, 1.6, 1.5], "bottom": -1.78, "matched": 0.4, "unmatched": 0.45},
        {"size": [3.9, 1.6, 1.5], "matched": 0.6, "unmatched": 0.45},
        {"size": [3.9, 1.6, 1.5], "bottom": -1.78, "matched": 0.6, "unmatched": 0.45, "botom": 1},
        {"size": 3, "bottom": -1.78, "matched": 0.6, "unmatched": 0.45},
        {"size": [3.9, 1.6, 1.5], "bottom": "low", "matched": 0.6, "unmatched": 0.45},
        3,
    ],
)
def test_wrong_anchor_is_refused(anchor: object) -> None:
    with pytest.raises(ConfigError, match=r"anchors\.Car needs size"):
        head_of(anchors={"Car": anchor})


# --- loss -----------------------------------------------------------------------------------------------------------


def test_focal_golden() -> None:
    loss = focal(torch.zeros(2), torch.tensor([True, False]), 0.25, 2.0)
    torch.testing.assert_close(loss, torch.tensor([0.043322, 0.129965]), atol=1e-6, rtol=0)


def test_match_by_threshold_and_by_force() -> None:
    iou = torch.tensor([[0.7, 0.1], [0.5, 0.2], [0.1, 0.3], [0.0, 0.0], [0.65, 0.0]])
    assert match(iou, torch.tensor(0.6), torch.tensor(0.45)).tolist() == [0, NEITHER, 1, NEGATIVE, 0]
    both = torch.tensor([[0.3, 0.4], [0.2, 0.1]])  # the same anchor is the best of both boxes
    assert match(both, torch.tensor(0.6), torch.tensor(0.45)).tolist() == [1, NEGATIVE]
    apart = torch.zeros(2, 1)  # a box that no anchor touches
    assert match(apart, torch.tensor(0.6), torch.tensor(0.45)).tolist() == [NEGATIVE, NEGATIVE]
    assert match(torch.zeros(3, 0), torch.tensor(0.6), torch.tensor(0.45)).tolist() == [NEGATIVE] * 3


def test_every_box_has_an_anchor_of_its_class() -> None:
    head, boxes = head_of(), spread_boxes(15, 3)
    output = head(bev_of(3))
    chosen = AnchorLoss(head.provides).assign(output, boxes, None)
    assert set(chosen[chosen >= 0].tolist()) == set(range(15))
    sample, row = (chosen >= 0).nonzero().unbind(1)
    assert output.label[row].equal(boxes.label[chosen[sample, row]])
    assert sample.equal(boxes.batch[chosen[sample, row]])


def test_loss_is_zero_at_perfect_output() -> None:
    head, boxes = head_of(), spread_boxes(15, 3)
    terms = AnchorLoss(head.provides)(perfect(head, boxes), Targets(boxes))
    assert set(terms) == {"class", "box", "direction"}
    assert all(value < 1e-5 for value in terms.values())


def test_loss_golden_of_a_known_error() -> None:
    head, boxes = head_of(), spread_boxes(1, 1)
    output = perfect(head, boxes)
    with torch.no_grad():
        output.residual[:, :, 0] += 0.05
        output.residual[:, :, 2] += 1.0
        output.residual[:, :, 6] += math.pi + 0.05  # half a turn costs nothing: that is for the direction
        output.direction.zero_()
    terms = AnchorLoss(head.provides)(output, Targets(boxes))
    small = 4.5 * math.sin(0.05) ** 2  # 0.5 d^2 / beta
    assert terms["box"].item() == pytest.approx(2 * (0.01125 + 0.944444 + small), abs=1e-4)
    assert terms["direction"].item() == pytest.approx(0.2 * math.log(2), abs=1e-5)


def test_loss_falls_by_gradient_descent() -> None:
    head, boxes, bev = head_of(), spread_boxes(12, 2), bev_of(2)
    bev.features.requires_grad_()
    loss = AnchorLoss(head.provides)
    optimizer = torch.optim.Adam([bev.features, *head.parameters()], 0.02)
    totals = []
    for _ in range(40):
        total = sum(loss(head(bev), Targets(boxes)).values())
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert totals[-1] < totals[0] / 4


@pytest.mark.parametrize(
    "targets", [Targets(), Targets(Boxes.empty(2)), Targets(Boxes.empty(2), ignored=Boxes.empty(2))]
)
def test_loss_without_boxes_is_finite_and_attached(targets: Targets) -> None:
    head = head_of()
    total = sum(AnchorLoss(head.provides)(head(bev_of(2)), targets).values())
    total.backward()
    assert total.isfinite()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in head.parameters())
    if targets.boxes is None:
        assert total == 0


def test_batch_without_samples() -> None:
    head = head_of().eval()
    output = head(bev_of(0))
    assert len(head.decode(output)) == 0
    assert sum(AnchorLoss(head.provides)(output, Targets(Boxes.empty(0))).values()) == 0


def test_boxes_outside_and_2d_only_labels_are_dropped() -> None:
    head, inside = head_of(), spread_boxes(5, 1)
    odd = torch.tensor([[-0.1, 0, -1, 4, 2, 1.5, 0], [5, 5, 0, 0, 2, 1, 0], [math.nan] * 7])
    more = Boxes.cat([inside, Boxes.from_tensor(odd, torch.zeros(3, dtype=torch.long))])
    loss, output = AnchorLoss(head.provides), head(bev_of(1))
    expected = loss(output, Targets(inside))
    found = loss(output, Targets(more, ignored=Boxes.from_tensor(odd[1:], torch.full((2,), -1))))
    assert {k: v.item() for k, v in found.items()} == pytest.approx({k: v.item() for k, v in expected.items()})


def test_samples_do_not_touch_each_other() -> None:
    head, boxes, bev = head_of().eval(), spread_boxes(9, 3), bev_of(3)
    loss = AnchorLoss(head.provides)
    together = loss(head(bev), Targets(boxes))
    alone = [loss(head(BEV(bev.features[i : i + 1], GRID, STRIDE)), Targets(boxes.sample(i))) for i in range(3)]
    for name, value in together.items():
        torch.testing.assert_close(value, sum(terms[name] for terms in alone) / 3)


def test_anchors_on_ignored_boxes_give_no_loss() -> None:
    head = head_of()
    output = head(bev_of(1))
    van = torch.tensor([[10.0, 0.0, -1.0, 3.9, 1.6, 1.56, 0.0]])

    def chosen(label: int, boxes: Boxes) -> Tensor:
        ignored = Boxes.from_tensor(van, torch.tensor([label]))
        return AnchorLoss(head.provides).assign(output, boxes, ignored)[0]

    of_car = chosen(0, Boxes.empty())
    assert (of_car == NEITHER).sum() > 0
    assert (output.label[of_car == NEITHER] == 0).all()
    assert ((output.anchors[of_car == NEITHER][:, :2] - van[:, :2]).norm(dim=1) < 2).all()
    assert chosen(-1, Boxes.empty()).equal(of_car)  # no small anchor overlaps a car's footprint enough
    learned = chosen(0, Boxes.from_tensor(van, torch.tensor([0])))
    assert (learned == 0).sum() > 0  # a box to learn comes before an ignored one


def test_half_precision_output() -> None:
    head, boxes = head_of(), spread_boxes(8, 2)
    with torch.autocast("cpu", torch.bfloat16):
        output = head(bev_of(2))
        total = sum(AnchorLoss(head.provides)(output, Targets(boxes)).values())
    total.backward()
    assert total.dtype == torch.float32
    assert head.decode(output).tensor.isfinite().all()
