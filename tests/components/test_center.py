"""Head and loss `center`."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from lidarfw.components.heads.center import CenterHead, CenterOutput, encode
from lidarfw.components.losses.center import CenterLoss, gaussian_radius, penalty_reduced_focal
from lidarfw.errors import ConfigError
from lidarfw.types import BEV, Boxes, DataSpec, Grid, Spec, Targets

GRID = Grid((0.0, -12.8, -3.0), (25.6, 12.8, 1.0), (0.4, 0.4, 4.0))
CLASSES = ("Car", "Pedestrian", "Cyclist")
DATA = DataSpec(targets=frozenset({Boxes}), classes=CLASSES)
STRIDE = 2


def head_of(channels: int = 8, **options: object) -> CenterHead:
    torch.manual_seed(0)
    return CenterHead(Spec(BEV, channels, STRIDE, GRID), DATA, channels=16, **options)


def bev_of(samples: int = 2, channels: int = 8, seed: int = 1) -> BEV:
    _, height, width = GRID.shape(STRIDE)
    return BEV(
        torch.randn(samples, channels, height, width, generator=torch.Generator().manual_seed(seed)), GRID, STRIDE
    )


def spread_boxes(number: int, samples: int, seed: int = 0, velocity: bool = False) -> Boxes:
    """Boxes at distinct, non-neighbouring cells of all classes and headings."""
    random = torch.Generator().manual_seed(seed)
    cells = torch.randperm(64, generator=random)[:number]  # of an 8 x 8 lattice of 3.2 m
    corner = torch.stack([cells % 8, cells // 8], 1) * 3.2 + torch.tensor([0.0, -12.8])
    xy = corner + 1.0 + torch.rand(number, 2, generator=random)
    z = torch.rand(number, 1, generator=random) - 1.5
    size = torch.rand(number, 3, generator=random) * 3 + 0.5
    yaw = (torch.rand(number, generator=random) * 2 - 1) * math.pi
    tensor = torch.cat([xy, z, size, yaw[:, None]], 1)
    label, batch = torch.randint(0, 3, (number,), generator=random), torch.arange(number) % samples
    boxes = Boxes.from_tensor(tensor, label, None, batch, samples)
    return boxes.replace(velocity=torch.randn(number, 2, generator=random)) if velocity else boxes


def perfect(head: CenterHead, boxes: Boxes, sharp: float = 40.0) -> CenterOutput:
    """The output that says exactly `boxes`; leaves of the graph."""
    output = head.eval()(bev_of(boxes.batch_size))
    heatmap, regression = torch.full_like(output.heatmap, -sharp), torch.zeros_like(output.regression)
    cell, values = encode(boxes, GRID, STRIDE)
    if boxes.velocity is not None:
        values = torch.cat([values, boxes.velocity], 1)
    heatmap[boxes.batch, boxes.label, cell[:, 1], cell[:, 0]] = sharp
    regression[boxes.batch, output.group[boxes.label], :, cell[:, 1], cell[:, 0]] = values
    return replace(output, heatmap=heatmap.requires_grad_(), regression=regression.requires_grad_())


def sort_rows(boxes: Boxes) -> Tensor:
    rows = torch.cat([boxes.batch[:, None], boxes.label[:, None], boxes.tensor], 1)
    return rows[(rows[:, 0] * 1e4 + rows[:, 2] * 1e2 + rows[:, 3]).argsort()]


@pytest.mark.parametrize("groups", [None, [["Pedestrian", "Cyclist"], ["Car"]], [["Cyclist"], ["Car"], ["Pedestrian"]]])
def test_perfect_output_decodes_to_the_boxes(groups: list[list[str]] | None) -> None:
    head, boxes = head_of(groups=groups, velocity=True), spread_boxes(30, 3, velocity=True)
    found = head.decode(perfect(head, boxes))
    found = found[found.score > 0.5]
    assert found.batch_size == 3
    torch.testing.assert_close(sort_rows(found), sort_rows(boxes), atol=1e-4, rtol=0)
    assert found.velocity is not None
    order = [(b.batch * 1e4 + b.center[:, 0] * 1e2 + b.center[:, 1]).argsort() for b in (found, boxes)]
    torch.testing.assert_close(found.velocity[order[0]], boxes.velocity[order[1]], atol=1e-5, rtol=0)


def test_decode_orders_limits_and_thresholds() -> None:
    head = head_of(max_objects=7, score_threshold=0.12).eval()
    boxes = head.decode(head(bev_of(3)))
    assert (boxes.score >= 0.12).all()
    for sample in boxes.samples():
        assert len(sample) <= 7
        assert sample.score.equal(sample.score.sort(descending=True).values)
    free = head_of(max_objects=7).eval()
    assert len(free.decode(free(bev_of(3)))) == 21


def test_peaks_are_local_maxima() -> None:
    head = head_of()
    output = perfect(head, spread_boxes(1, 1))
    with torch.no_grad():
        output.heatmap.fill_(-5.0)
        output.heatmap[0, 1, 4, 4] = 3.0
        output.heatmap[0, 1, 4, 5] = 2.0  # beside the peak
        output.heatmap[0, 1, 4, 7] = 1.0  # a peak of its own
        output.heatmap[0, 2, 4, 5] = 2.5  # another class
    found = head.decode(output)
    torch.testing.assert_close(found.score[found.score > 0.1], torch.tensor([3.0, 2.5, 1.0]).sigmoid())
    assert found.label[found.score > 0.1].tolist() == [1, 2, 1]


def test_provides_and_tap_tell_the_truth() -> None:
    head = head_of()
    output = head(bev_of(2))
    assert head.provides == Spec(Boxes, classes=CLASSES)
    assert head.tap == Spec(BEV, 16, STRIDE, GRID)
    assert output.tap.features.shape == (2, 16, *GRID.shape(STRIDE)[1:])
    assert (output.tap.grid, output.tap.stride) == (GRID, STRIDE)
    assert output.heatmap.shape == (2, 3, 32, 32)
    assert output.regression.shape == (2, 1, 8, 32, 32)
    output.heatmap.sum().backward()
    assert all(p.grad is not None for p in head.shared.parameters())  # the tap lies on the path to the output


def test_every_class_has_the_map_of_its_group() -> None:
    head = head_of(groups=[["Cyclist", "Car"], ["Pedestrian"]]).eval()
    with torch.no_grad():
        for number, biases in enumerate([[1.0, 3.0], [2.0]]):  # within a group, in class order
            head.groups[number].last["heatmap"].weight.zero_()
            head.groups[number].last["heatmap"].bias.copy_(torch.tensor(biases))
    output = head(bev_of(1))
    assert output.heatmap[0, :, 0, 0].tolist() == [1.0, 2.0, 3.0]
    assert output.group.tolist() == [0, 1, 0]


def test_untrained_head_expects_few_objects() -> None:
    assert 0.05 < head_of().eval()(bev_of()).heatmap.sigmoid().mean() < 0.2


def test_groups_must_hold_every_class_once() -> None:
    for groups in ([["Car"]], [["Car", "Pedestrian"], ["Cyclist", "Car"]], [["Car", "Pedestrian", "Truck"]]):
        with pytest.raises(ConfigError, match=r"every class exactly once[\s\S]*Cyclist[\s\S]*fix"):
            head_of(groups=groups)


# --- loss -----------------------------------------------------------------------------------------------------------


def test_gaussian_radius_golden() -> None:
    sizes = torch.tensor([[4.0, 1.8], [0.8, 0.8]])
    torch.testing.assert_close(gaussian_radius(sizes / 0.8, 0.1), torch.tensor([1.41407, 0.43246]), atol=1e-4, rtol=0)
    torch.testing.assert_close(gaussian_radius(sizes / 1.6, 0.1), torch.tensor([0.70704, 0.21623]), atol=1e-4, rtol=0)


def test_focal_golden() -> None:
    loss = penalty_reduced_focal(torch.zeros(3), torch.tensor([1.0, 0.0, 0.8]))
    torch.testing.assert_close(loss, torch.tensor([0.173287, 0.173287, 2.77259e-4]), atol=1e-6, rtol=1e-5)


def test_gaussians_peak_fall_off_and_merge() -> None:
    head, loss = head_of(), CenterLoss(Spec(Boxes, classes=CLASSES))
    small = [[4.2, 0.2, -1.0, 0.8, 0.6, 1.7, 0.0], [5.8, 0.2, -1.0, 0.8, 0.6, 1.7, 0.0]]  # cells (5, 16), (7, 16)
    boxes = Boxes.from_tensor(torch.tensor(small), torch.tensor([1, 1]))
    target = loss.gaussians(head(bev_of(1)), boxes)
    sigma = 5 / 6
    assert target[0, 1, 16, 5] == 1
    assert target[0, 1, 16, 7] == 1
    assert target[0, 1, 16, 6] == pytest.approx(math.exp(-1 / (2 * sigma**2)))  # the larger of two equal ones
    assert target[0, 1, 14, 5] == pytest.approx(math.exp(-4 / (2 * sigma**2)))
    assert target[0, 1, 14, 6] == pytest.approx(math.exp(-5 / (2 * sigma**2)))
    assert target[0, 1, 13, 5] == 0
    assert target[0, [0, 2]].abs().sum() == 0
    assert (target > 0).sum() == 5 * 7


def test_gaussian_at_the_border_is_cut() -> None:
    loss = CenterLoss(Spec(Boxes, classes=CLASSES))
    boxes = Boxes.from_tensor(torch.tensor([[0.1, -12.7, -1.0, 4.0, 2.0, 1.5, 0.0]]), torch.tensor([0]))
    target = loss.gaussians(head_of()(bev_of(1)), boxes)
    assert target[0, 0, 0, 0] == 1
    assert (target > 0).sum() == 9


@pytest.mark.parametrize("velocity", [False, True])
def test_loss_is_zero_at_perfect_output(velocity: bool) -> None:
    head, boxes = head_of(velocity=velocity), spread_boxes(20, 2, velocity=velocity)
    output = perfect(head, boxes)
    terms = CenterLoss(head.provides)(output, Targets(boxes))
    assert set(terms) == {"heatmap", "offset", "height", "size", "yaw"} | ({"velocity"} if velocity else set())
    assert all(value < 1e-5 for value in terms.values())


def test_regression_golden() -> None:
    """One box in one of two samples: L1 of a known error, times 2, over 1 object and 2 samples."""
    head, boxes = head_of(), spread_boxes(1, 1).replace(batch_size=2)
    output = perfect(head, boxes)
    with torch.no_grad():
        output.regression[:, :, 0] += 0.3
        output.regression[:, :, 2] -= 0.5
        output.regression[:, :, 3:6] += 0.1
    terms = CenterLoss(head.provides)(output, Targets(boxes))
    expected = {"offset": 0.3, "height": 0.5, "size": 0.3, "yaw": 0.0}
    assert {name: terms[name].item() for name in expected} == pytest.approx(expected, abs=1e-5)


def test_loss_falls_by_gradient_descent() -> None:
    head, boxes = head_of(), spread_boxes(12, 2)
    loss, bev = CenterLoss(head.provides), bev_of(2)
    optimizer = torch.optim.Adam(head.parameters(), 3e-3)
    totals = []
    for _ in range(30):
        total = sum(loss(head(bev), Targets(boxes)).values())
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert totals[-1] < totals[0] / 3


@pytest.mark.parametrize(
    "targets",
    [Targets(), Targets(Boxes.empty(2)), Targets(Boxes.empty(2), ignored=Boxes.empty(2))],
    ids=["unlabelled", "no boxes", "nothing ignored"],
)
def test_loss_without_boxes_is_finite_and_attached(targets: Targets) -> None:
    head = head_of(velocity=True)
    terms = CenterLoss(head.provides)(head(bev_of(2)), targets)
    total = sum(terms.values())
    total.backward()
    gradients = [p.grad for p in head.parameters() if p.grad is not None]
    assert total.isfinite()
    assert gradients
    assert all(g.isfinite().all() for g in gradients)
    if targets.boxes is None:
        assert total == 0


def test_batch_without_samples() -> None:
    head = head_of().eval()
    output = head(bev_of(0))
    assert len(head.decode(output)) == 0
    assert sum(CenterLoss(head.provides)(output, Targets(Boxes.empty(0))).values()) == 0


def test_boxes_outside_and_2d_only_labels_are_dropped() -> None:
    head, loss = head_of(), CenterLoss(Spec(Boxes, classes=CLASSES))
    inside = spread_boxes(5, 1)
    outside = [[-0.1, 0, 0, 4, 2, 1, 0], [25.7, 0, 0, 4, 2, 1, 0], [5, 12.9, 0, 4, 2, 1, 0]]
    odd = torch.tensor([*outside, [5, 5, 0, 0, 2, 1, 0], [math.nan] * 7])
    more = Boxes.cat([inside, Boxes.from_tensor(odd, torch.zeros(5, dtype=torch.long))])
    output = head(bev_of(1))
    expected = loss(output, Targets(inside))
    found = loss(output, Targets(more, ignored=Boxes.from_tensor(odd[3:], torch.full((2,), -1))))
    assert {k: v.item() for k, v in found.items()} == pytest.approx({k: v.item() for k, v in expected.items()})


def test_samples_do_not_touch_each_other() -> None:
    head, boxes = head_of().eval(), spread_boxes(9, 3)
    loss, bev = CenterLoss(head.provides), bev_of(3)
    together = loss(head(bev), Targets(boxes))
    alone = [loss(head(BEV(bev.features[i : i + 1], GRID, STRIDE)), Targets(boxes.sample(i))) for i in range(3)]
    for name, value in together.items():
        torch.testing.assert_close(value, sum(terms[name] for terms in alone) / 3)
    decoded = head.decode(head(bev))
    single = head.decode(head(BEV(bev.features[1:2], GRID, STRIDE)))
    torch.testing.assert_close(decoded.sample(1).tensor, single.tensor)


def test_ignored_cells_give_no_loss() -> None:
    head, loss = head_of(), CenterLoss(Spec(Boxes, classes=CLASSES))
    box = torch.tensor([[10.0, 0.0, -1.0, 4.0, 2.0, 1.5, 0.5]])
    output = head(bev_of(1))
    heatmap = output.heatmap.detach().clone().requires_grad_()
    output = replace(output, heatmap=heatmap)

    def gradient(label: int) -> Tensor:
        ignored = Boxes.from_tensor(box, torch.tensor([label]))
        (grad,) = torch.autograd.grad(loss(output, Targets(Boxes.empty(), ignored))["heatmap"], heatmap)
        return grad[0]

    cells = GRID.bev_centers(STRIDE) - box[0, :2]
    along = cells[..., 0] * math.cos(0.5) + cells[..., 1] * math.sin(0.5)
    across = cells[..., 1] * math.cos(0.5) - cells[..., 0] * math.sin(0.5)
    covered = (along.abs() <= 2) & (across.abs() <= 1)
    assert covered.sum() > 8
    assert gradient(1)[1][covered].abs().max() == 0
    assert gradient(1)[0][covered].abs().min() > 0
    assert gradient(-1)[:, covered].abs().max() == 0
    assert gradient(-1)[:, ~covered].abs().min() > 0


def test_an_object_in_an_ignored_region_is_still_learned() -> None:
    head, loss = head_of(), CenterLoss(Spec(Boxes, classes=CLASSES))
    boxes = spread_boxes(1, 1)
    terms = [loss(perfect(head, boxes, sharp=-4.0), Targets(boxes, i))["heatmap"] for i in (None, boxes)]
    assert terms[1] > 3.5  # -log(sigmoid(-4)) of the centre cell alone
    assert terms[1] < terms[0]


def test_unknown_velocities_do_not_count() -> None:
    head, boxes = head_of(velocity=True), spread_boxes(6, 1, velocity=True)
    output = perfect(head, boxes)
    boxes.velocity[2:] = math.nan
    with torch.no_grad():
        output.regression[:, :, 8:] += 1.0
    term = CenterLoss(head.provides)(output, Targets(boxes))["velocity"]
    term.backward()
    assert term.item() == pytest.approx(2 * 0.2 * (2 * 2) / 6)  # weights, two boxes with 1 m/s error along x and y
    assert output.regression.grad.isfinite().all()


def test_velocity_without_labels_is_refused() -> None:
    head = head_of(velocity=True)
    with pytest.raises(ConfigError, match=r"velocity=false"):
        CenterLoss(head.provides)(head(bev_of(1)), Targets(spread_boxes(2, 1)))


def test_half_precision_output() -> None:
    head, boxes = head_of(), spread_boxes(8, 2)
    with torch.autocast("cpu", torch.bfloat16):
        output = head(bev_of(2))
        total = sum(CenterLoss(head.provides)(output, Targets(boxes)).values())
    total.backward()
    assert total.dtype == torch.float32
    assert head.decode(output).tensor.isfinite().all()
