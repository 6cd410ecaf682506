"""Regions, pooling, stages and their loss against values worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import BEV, Boxes, DataSpec, Grid, Spec, Targets
from torch import Tensor, nn

from lidarfw_msrm.heads.msrm import MSRMHead, MSRMOutput, thresholds
from lidarfw_msrm.heads.pooling import Aggregation, BEVPooling, Sites, bilinear, grid_points, neighbors
from lidarfw_msrm.heads.rois import best_overlap, fold, refine, residuals, sampled, to_local, to_sensor
from lidarfw_msrm.heads.stages import PartScore, StageAttention
from lidarfw_msrm.losses.msrm import MSRMLoss, corner_distance, soft_confidence

CLASSES = ("Car", "Pedestrian", "Cyclist")
GRID = Grid((0.0, -8.0, -3.0), (16.0, 8.0, 1.0), (0.5, 0.5, 4.0))


def boxes(*rows: list[float], label: list[int] | None = None, batch: list[int] | None = None) -> Boxes:
    tensor = torch.tensor(rows).view(-1, 7)
    labels = torch.zeros(len(tensor), dtype=torch.long) if label is None else torch.tensor(label)
    batches = torch.zeros(len(tensor), dtype=torch.long) if batch is None else torch.tensor(batch)
    return Boxes.from_tensor(tensor, labels, torch.linspace(1, 0.5, len(tensor)), batches, 1 + max(batch or [0]))


def random_boxes(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    low = torch.tensor([1.0, -7.0, -1.0, 1.0, 0.5, 1.0, -3.1])
    high = torch.tensor([15.0, 7.0, 0.0, 5.0, 2.0, 2.0, 3.1])
    return low + (high - low) * torch.rand(count, 7, generator=generator)


def head(**options: object) -> MSRMHead:
    torch.manual_seed(0)
    data = DataSpec(classes=CLASSES)
    small = {"stages": 3, "regions": 16, "grid": 2, "channels": 16, "heads": 2, "dropout": 0.0, "pool": "bev"}
    return MSRMHead(Spec(Boxes, classes=CLASSES), Spec(BEV, 8, 1, GRID), None, None, data, **(small | options))  # type: ignore[arg-type]


def bev(samples: int = 1, seed: int = 0) -> BEV:
    return BEV(torch.randn(samples, 8, 32, 32, generator=torch.Generator().manual_seed(seed)), GRID)


# --- frames and codes -----------------------------------------------------------------------------------------------


def test_a_box_in_the_frame_of_a_region() -> None:
    roi = torch.tensor([[10.0, 0, 0, 4, 2, 1.5, math.pi / 2]])
    box = torch.tensor([[10.0, 1, 0, 4, 2, 1.5, math.pi / 2]])
    local = to_local(box, roi)
    torch.testing.assert_close(local[0, :3], torch.tensor([1.0, 0, 0]), atol=1e-6, rtol=0)
    torch.testing.assert_close(to_sensor(local, roi), box)


def test_residuals_by_hand() -> None:
    roi = torch.tensor([[0.0, 0, 0, 3.9, 1.6, 1.56, 0]])
    box = torch.tensor([[1.0, 0.5, 0.2, 4.2, 1.7, 1.5, 0.1]])
    expected = torch.tensor([[0.237223, 0.118611, 0.128205, 0.074108, 0.060625, -0.039221, 0.1]])
    torch.testing.assert_close(residuals(box, roi), expected, atol=1e-5, rtol=0)


def test_refining_by_residuals_gives_the_box_up_to_half_a_turn() -> None:
    rois, truth = random_boxes(50), random_boxes(50, seed=1)
    found = refine(residuals(truth, rois), rois)
    torch.testing.assert_close(found[:, :6], truth[:, :6], atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(fold(found[:, 6] - truth[:, 6]), torch.zeros(50), atol=1e-4, rtol=0)
    assert bool(((found[:, 6] - rois[:, 6]).abs() <= math.pi / 2 + 1e-5).all())


def test_half_a_turn_is_no_turn() -> None:
    torch.testing.assert_close(
        fold(torch.tensor([math.pi / 2, 3.0, -3.0])), torch.tensor([math.pi / 2, 3.0 - math.pi, math.pi - 3.0])
    )


def test_overlap_counts_boxes_of_the_same_class_and_sample() -> None:
    rois = boxes([0, 0, 0, 4, 2, 2, 0], [0, 0, 0, 4, 2, 2, 0], [0, 0, 0, 4, 2, 2, 0], label=[0, 1, 0], batch=[0, 0, 1])
    truth = boxes([1, 0, 0, 4, 2, 2, 0], label=[0])
    overlap, row = best_overlap(rois.tensor, rois, truth)
    torch.testing.assert_close(overlap, torch.tensor([0.6, 0.0, 0.0]))
    assert row.tolist() == [0, 0, 0]
    assert best_overlap(rois.tensor, rois, Boxes.empty())[0].tolist() == [0, 0, 0]


# --- which regions are trained on -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "overlap", "stages"),
    [
        *[("Car", 0.5, []), ("Car", 0.52, [0]), ("Car", 0.57, [0, 1]), ("Car", 0.65, [0, 1, 2])],
        *[("Pedestrian", 0.48, [0]), ("Pedestrian", 0.52, [0, 1]), ("Cyclist", 0.56, [0, 1, 2])],
    ],
)
def test_thresholds_rise_from_stage_to_stage(name: str, overlap: float, stages: list[int]) -> None:
    limits = thresholds(CLASSES, 3, None)[:, CLASSES.index(name)]
    assert (overlap > limits).nonzero()[:, 0].tolist() == stages


def test_thresholds_of_other_stages_and_classes() -> None:
    torch.testing.assert_close(thresholds(("car", "bicycle"), 4, None)[:, 0], torch.tensor([0.5, 0.55, 0.6, 0.65]))
    torch.testing.assert_close(thresholds(("Car",), 2, {"Car": [0.7]})[:, 0], torch.tensor([0.7, 0.7]))
    with pytest.raises(ConfigError, match="Did you mean 'Car'"):
        thresholds(("Car",), 3, {"Cra": [0.5]})


def test_confidence_to_learn() -> None:
    limits = torch.tensor([[0.25, 0.75]] * 3 + [[0.15, 0.65]])
    found = soft_confidence(torch.tensor([0.2, 0.5, 0.8, 0.4]), limits)
    torch.testing.assert_close(found, torch.tensor([0.0, 0.5, 1.0, 0.5]))


def test_half_of_the_regions_are_foreground_and_most_of_the_others_hard() -> None:
    overlap = torch.cat([torch.full((100,), v) for v in (0.8, 0.3, 0.0)])
    rows = sampled(overlap, torch.full((300,), 0.5), torch.zeros(300, dtype=torch.long), 1, 40)
    kinds = (rows // 100).bincount(minlength=3)
    assert kinds.tolist() == [20, 16, 4]
    assert torch.equal(rows, rows.sort()[0])


@pytest.mark.parametrize("there", [(0, 0, 100), (100, 0, 0), (5, 3, 100), (2, 1, 1), (0, 0, 0)])
def test_what_is_short_is_filled_up(there: tuple[int, int, int]) -> None:
    overlap = torch.cat([torch.full((n,), v) for n, v in zip(there, (0.8, 0.3, 0.0), strict=True)])
    batch = torch.zeros(len(overlap), dtype=torch.long)
    rows = sampled(overlap, torch.full_like(overlap, 0.5), batch, 1, 40)
    assert len(rows.unique()) == len(rows) == min(40, sum(there))


def test_every_sample_has_its_own_regions() -> None:
    overlap, batch = torch.rand(300), torch.arange(300) % 3
    rows = sampled(overlap, torch.full((300,), 0.5), batch, 4, 20)
    assert batch[rows].bincount(minlength=4).tolist() == [20, 20, 20, 0]


# --- pooling --------------------------------------------------------------------------------------------------------


def test_grid_points_lie_in_the_middle_of_the_cells() -> None:
    steps = [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]
    flat = grid_points(torch.tensor([[0.0, 0, 0, 6, 6, 6, 0]]), 6)[0]
    expected = torch.cartesian_prod(*[torch.tensor(steps)] * 3)
    torch.testing.assert_close(flat, expected)
    turned = grid_points(torch.tensor([[0.0, 0, 0, 6, 6, 6, math.pi / 2]]), 6)[0]
    torch.testing.assert_close(
        turned, torch.stack([-expected[:, 1], expected[:, 0], expected[:, 2]], 1), atol=1e-5, rtol=0
    )


def test_neighbors_lie_within_the_radius_and_spread_over_it() -> None:
    line = torch.stack([torch.arange(100) * 0.1, torch.zeros(100), torch.zeros(100)], 1)
    sites = Sites(line, torch.zeros(100, 1), torch.zeros(100, dtype=torch.long))
    near, far = neighbors(sites, torch.zeros(1, 3), torch.zeros(1, dtype=torch.long), [0.35, 1.55], 4)
    assert near[:, 1].tolist() == [0, 1, 2, 3]
    assert far[:, 1].tolist() == [0, 4, 8, 12]
    assert neighbors(sites, torch.full((1, 3), 50.0), torch.zeros(1, dtype=torch.long), [1.0], 4)[0].shape == (0, 2)


def test_decomposed_aggregation_is_a_pointnet_on_features_and_offsets() -> None:
    torch.manual_seed(0)
    layer = Aggregation(5, 8).double()
    for norm in (m for m in layer.modules() if isinstance(m, nn.BatchNorm1d)):
        norm.running_mean.uniform_(-1, 1), norm.running_var.uniform_(0.5, 2)  # type: ignore[union-attr]
    layer.eval()
    sites = Sites(torch.rand(30, 3).double(), torch.randn(30, 5).double(), torch.zeros(30, dtype=torch.long))
    xyz = torch.rand(7, 3).double()
    pairs = torch.stack([torch.arange(7).repeat_interleave(4), torch.randint(30, (28,))], 1)
    found = layer(layer.transform(sites), sites, xyz, pairs)

    query, site = pairs.unbind(1)
    weights, bias = [], torch.zeros(8).double()
    for linear, norm in ((layer.feature, layer.feature_norm), (layer.offset, layer.offset_norm)):
        gain = norm.weight / (norm.running_var + norm.eps).sqrt()  # type: ignore[operator]
        weights.append(linear.weight * gain[:, None])
        bias = bias + norm.bias - norm.running_mean * gain  # type: ignore[operator]
    naive = torch.cat([sites.features[site], sites.xyz[site] - xyz[query]], 1) @ torch.cat(weights, 1).T + bias
    expected = layer.out(naive.relu().view(7, 4, 8).amax(1))
    torch.testing.assert_close(found, expected)


def test_bilinear_samples_of_a_plane_are_exact() -> None:
    centers = GRID.bev_centers()
    plane = BEV((2 * centers[..., 0] - centers[..., 1])[None, None], GRID)
    xy = torch.tensor([[3.3, 1.7], [10.0, -4.2]])
    found = bilinear(plane, xy, torch.zeros(2, dtype=torch.long))[:, 0]
    torch.testing.assert_close(found, 2 * xy[:, 0] - xy[:, 1])
    assert bilinear(plane, torch.tensor([[-5.0, 0.0]]), torch.zeros(1, dtype=torch.long)).item() == 0


def test_map_pooling_reads_the_footprint() -> None:
    pooling = BEVPooling(8, 4, 3).eval()
    found = pooling(bev(), random_boxes(5), torch.zeros(5, dtype=torch.long))
    assert found.shape == (5, pooling.channels)


# --- part score -----------------------------------------------------------------------------------------------------


def test_part_score_is_the_mean_of_the_parts() -> None:
    maps = BEV(torch.arange(49.0).view(1, 49, 1, 1).expand(1, 49, 32, 32), GRID)
    inside = torch.tensor([[8.0, 0, 0, 4, 2, 1.5, 0.3], [6.0, 1, 0, 3, 2, 1.5, 2.0]])
    found = PartScore.score(maps, inside, torch.zeros(2, dtype=torch.long))
    torch.testing.assert_close(found, torch.tensor([24.0, 24.0]))


def test_a_part_is_read_from_its_own_map_at_the_corner_of_the_box() -> None:
    features = torch.zeros(1, 49, 32, 32)
    # corner -l/2, -w/2 of the box below lies on the centre of cell (12, 14)
    features[0, 0, 14, 12] = 4.9
    box = torch.tensor([[8.25, 0.25, 0, 4, 2, 1.5, 0]])
    score = PartScore.score(BEV(features, GRID), box, torch.zeros(1, dtype=torch.long))
    torch.testing.assert_close(score, torch.tensor([0.1]))
    outside = torch.tensor([[100.0, 0, 0, 4, 2, 1.5, 0]])
    assert PartScore.score(BEV(features, GRID), outside, torch.zeros(1, dtype=torch.long)).item() == 0


# --- attention ------------------------------------------------------------------------------------------------------


def test_one_token_attends_to_itself() -> None:
    torch.manual_seed(0)
    attention = StageAttention(8, 2)
    tokens = torch.randn(5, 1, 8)
    code = torch.tensor([0.0] * 4 + [1.0] * 4).expand(5, 8)
    expected = attention.out(attention.value(torch.cat([tokens[:, 0], code], 1)))
    torch.testing.assert_close(attention(tokens), torch.cat([expected, tokens[:, 0]], 1))


def test_attention_weights_by_hand() -> None:
    attention = StageAttention(2, 1)
    for layer in (attention.query, attention.key, attention.value, attention.out):
        nn.init.zeros_(layer.weight), nn.init.zeros_(layer.bias)
    attention.query.bias.data = torch.tensor([1.0, 0.0])
    attention.key.weight.data[:, :2] = torch.eye(2)
    attention.value.weight.data[:, :2] = torch.eye(2)
    attention.out.weight.data = torch.eye(2)
    found = attention(torch.tensor([[[1.0, 0.0], [0.0, 1.0]]]))
    torch.testing.assert_close(found[0, :2], torch.tensor([0.669762, 0.330238]), atol=1e-5, rtol=0)


# --- the head -------------------------------------------------------------------------------------------------------


def apart(count: int = 8) -> Boxes:
    """Proposals that do not suppress each other."""
    rows = [[2.0 + 3.5 * (n % 4), -6.0 + 5 * (n // 4), -1, 3, 1.5, 1.5, 0.2 * n] for n in range(count)]
    return boxes(*rows, label=[n % 3 for n in range(count)])


def test_a_region_does_not_depend_on_the_others() -> None:
    net, proposals = head().eval(), apart()
    whole = net(proposals, bev())
    fewer = net(proposals[:5], bev())
    torch.testing.assert_close(whole.boxes[:, :5], fewer.boxes)
    torch.testing.assert_close(whole.confidence[:, :5], fewer.confidence)


def test_the_order_of_regions_does_not_matter_in_training_either() -> None:
    net, proposals = head().train(), apart()
    first = net(proposals, bev())
    turned = proposals.replace(score=proposals.score.flip(0))
    second = net(turned, bev())
    assert torch.equal(second.rois.tensor, first.rois.tensor.flip(0))
    torch.testing.assert_close(second.tokens, first.tokens.flip(1), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(second.boxes, first.boxes.flip(1), atol=1e-5, rtol=1e-4)


def test_zero_last_layers_leave_the_proposals_as_they_are() -> None:
    net, proposals = head().eval(), apart()
    for branch in net.correction:
        nn.init.zeros_(branch[-1].weight)  # type: ignore[index, arg-type]
    output = net(proposals, bev())
    for stage in output.boxes:
        torch.testing.assert_close(stage, output.rois.tensor, atol=1e-5, rtol=0)


def test_each_stage_starts_from_the_box_of_the_one_before() -> None:
    net, proposals = head().eval(), apart()
    for branch in net.correction:
        nn.init.zeros_(branch[-1].weight)  # type: ignore[index, arg-type]
        branch[-1].bias.data = torch.tensor([0.0, 0, 0, math.log(2), 0, 0, 0])  # type: ignore[index, union-attr]
    length = net(proposals, bev()).boxes[:, :, 3]
    torch.testing.assert_close(length, torch.tensor([1.0, 2, 4, 8])[:, None] * length[0])


def test_velocity_and_class_stay_those_of_the_proposal() -> None:
    net = head().eval()
    proposals = apart().replace(velocity=torch.arange(16.0).view(8, 2))
    found = net.decode(net(proposals, bev()))
    assert found.stage is not None
    assert found.velocity is not None
    assert found.stage.bincount().tolist() == [8, 8, 8, 8]
    torch.testing.assert_close(found.velocity.view(4, 8, 2)[3], found.velocity.view(4, 8, 2)[0])
    assert torch.equal(found.label.view(4, 8)[1], proposals.label)
    torch.testing.assert_close(found.tensor[:8], proposals.tensor)
    torch.testing.assert_close(found.score[:8], proposals.score)


def test_no_proposals_no_boxes() -> None:
    net, nothing = head(), apart()[:0]
    output = net.train()(nothing, bev(), targets=Targets(boxes=apart()))
    assert len(net.decode(output)) == 0
    loss = MSRMLoss(Spec(Boxes))(output, Targets(boxes=apart()))
    assert all(term.item() == 0 for term in loss.values())
    sum(loss.values()).backward()  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("options", "text"), [({"pool": "voxels"}, "no Voxels"), ({"heads": 3}, "channels"), ({"pool": "x"}, "auto")]
)
def test_what_cannot_be_built_is_refused(options: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        head(**options)


# --- the loss -------------------------------------------------------------------------------------------------------


def perfect(truth: Boxes) -> MSRMOutput:
    rois = truth.tensor
    chain = torch.stack([rois] * 4)
    residual = torch.zeros(3, len(rois), 7, requires_grad=True)
    confidence = torch.full((3, len(rois)), 30.0, requires_grad=True)
    limits = thresholds(CLASSES, 3, None)
    confident = torch.tensor([[0.25, 0.75], [0.15, 0.65], [0.15, 0.65]])
    return MSRMOutput(truth, chain, residual, confidence, torch.zeros(3, len(rois), 4), limits, confident)


def test_perfect_boxes_cost_nothing() -> None:
    truth = apart()
    terms = MSRMLoss(Spec(Boxes))(perfect(truth), Targets(boxes=truth))
    # corners differ by rounding only; their distance is kept off 0, where its root has no gradient
    assert all(term.item() < 1e-5 for term in terms.values()), terms


def test_smooth_l1_by_hand() -> None:
    truth = boxes([8.0, 0, 0, 4, 2, 1.5, 0])
    output = perfect(truth)
    for error, expected in ((0.05, 0.01125), (1.0, 0.944444)):
        residual = torch.zeros(3, 1, 7)
        residual[0, 0, 0] = error
        found = MSRMLoss(Spec(Boxes))(output.replace(residual=residual), Targets(boxes=truth))["box"]
        torch.testing.assert_close(found, torch.tensor(expected), atol=1e-5, rtol=0)


def test_a_box_may_point_either_way() -> None:
    box = random_boxes(6)
    turned = torch.cat([box[:, :6], box[:, 6:] + math.pi], 1)
    assert float(corner_distance(box, turned).max()) < 1e-5
    assert float(residuals(turned, box)[:, 6].abs().max()) < 1e-5


def test_without_foreground_no_box_loss_and_finite_gradients() -> None:
    truth = apart()
    output = perfect(truth)
    far = boxes([8.0, 7, 0, 4, 2, 1.5, 0])
    terms = MSRMLoss(Spec(Boxes))(output, Targets(boxes=far))
    assert float(terms["box"]) == float(terms["corner"]) == 0
    sum(terms.values()).backward()  # type: ignore[union-attr]
    assert output.residual.grad is not None
    assert bool(output.residual.grad.isfinite().all())


def test_regions_on_ignored_boxes_give_no_loss() -> None:
    truth = apart()
    targets = Targets(boxes=Boxes.empty(), ignored=truth)
    terms = MSRMLoss(Spec(Boxes))(perfect(truth), targets)
    assert float(terms["confidence"]) == 0
    assert float(MSRMLoss(Spec(Boxes))(perfect(truth), Targets(boxes=Boxes.empty()))["confidence"]) > 1


def test_training_lowers_every_term() -> None:
    truth = apart()
    moved = truth.replace(center=truth.center + 0.15, size=truth.size * 1.05)
    net, loss, features = head().train(), MSRMLoss(Spec(Boxes)), bev()
    optimizer = torch.optim.Adam(net.parameters(), lr=0.01)
    history = []
    for _ in range(60):
        terms = loss(net(moved, features, targets=Targets(boxes=truth)), Targets(boxes=truth))
        optimizer.zero_grad()
        sum(terms.values()).backward()  # type: ignore[union-attr]
        optimizer.step()
        history.append({name: float(term) for name, term in terms.items()})
    assert all(history[-1][name] < history[0][name] / 2 for name in history[0]), (history[0], history[-1])


def test_a_class_without_thresholds_is_named() -> None:
    with pytest.raises(ConfigError, match=r"foreground of Car is empty\n  fix: "):
        thresholds(["Car", "Truck"], 3, {"Car": []})
