"""Backbone, scene coordinates and their loss: grids, known answers, degenerate input, and frames learned by heart."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from lidarfw.assembly import build, plan
from lidarfw.components.metrics.pose_error import pose_errors
from lidarfw.components.transforms.augmentation import RandomRotation
from lidarfw.config import compose
from lidarfw.errors import ConfigError
from lidarfw.ops import points_in_boxes_mask, transform
from lidarfw.testing.synthetic import SyntheticDataset, frames
from lidarfw.types import BEV, Batch, DataSpec, Frame, Points, Poses, SceneCoords, Spec, Targets, Voxels, collate
from torch import Tensor

from lidarfw_taco.backbones.taco import TacoBackbone
from lidarfw_taco.heads.regions import Regions
from lidarfw_taco.heads.scene_coord import CoordinateRegressor, SceneCoordBEVHead, SceneCoordHead, SceneCoordOutput
from lidarfw_taco.losses.scene_coord import SceneCoordLoss, true_places
from lidarfw_taco.necks.gated_fusion import averaged
from lidarfw_taco.transforms.random_shift import RandomShift

POINTS = Spec(Points, channels=1)
TINY = {"stem": 4, "blocks": ((4,), (4, 8), (8,)), "bev_channels": 8}


def pairs(world: Tensor, source: Tensor | None = None, weight: Tensor | None = None) -> SceneCoordOutput:
    source = torch.zeros_like(world) if source is None else source
    weight = torch.ones(len(world)) if weight is None else weight
    coords = SceneCoords(source, world, weight, torch.zeros(len(world), dtype=torch.long))
    grid = TacoBackbone(POINTS, **TINY).grid
    return SceneCoordOutput(coords, BEV(torch.zeros(1, 1, 1, 1), grid, 8))


def quarter_turn(x: float = 10.0) -> Tensor:
    """90 degrees to the left, then a shift along x."""
    return torch.tensor([[0.0, -1, 0, x], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def known(matrix: Tensor, ok: bool = True) -> Targets:
    return Targets(poses=Poses(matrix[None], torch.tensor([ok]), torch.ones(1)))


# the backbone


def test_grid_of_the_paper() -> None:
    backbone = TacoBackbone(POINTS, stem=1, blocks=((1,), (1,), (1,)), bev_channels=1, bev_stride=8)
    assert backbone.grid.shape() == (40, 600, 600)
    levels, bev = backbone.provides
    assert [spec.stride for spec in levels] == [2, 4, 8]
    assert backbone.grid.shape(bev.stride)[1:] == (75, 75)
    assert backbone.grid.cell[0] * bev.stride == pytest.approx(1.6)


def test_widths_of_the_paper() -> None:
    levels, bev = TacoBackbone(POINTS).provides
    assert [spec.channels for spec in levels] == [128, 256, 512]
    assert bev.stride == 4


def test_pooling_is_the_mean_over_points_and_not_over_voxels() -> None:
    # three points in one voxel and one in its neighbour: both lie in one cell of stride 2
    xyz = torch.tensor([[0.05, 0.05, 0.05]] * 3 + [[0.25, 0.05, 0.05]])
    scan = Points.from_scan(xyz, torch.zeros(4, 1))
    backbone = TacoBackbone(POINTS, **TINY).eval()
    seen = list[Voxels]()
    backbone.levels[0].register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    stem = list[Voxels]()
    backbone.stem.register_forward_hook(lambda module, inputs, output: stem.append(output))
    backbone(scan)
    expected = (3 * stem[0].features[0] + stem[0].features[1]) / 4
    torch.testing.assert_close(seen[0].features[0], expected)


def test_levels_cover_odd_grids() -> None:
    backbone = TacoBackbone(POINTS, lower=(0, 0, 0), upper=(2.2, 1.4, 1.0), cell=(0.2, 0.2, 0.2), **TINY).eval()
    corner = Points.from_scan(torch.tensor([[2.15, 1.35, 0.95]]), torch.zeros(1, 1))
    levels, bev = backbone(corner)
    for level, stride in zip(levels, (2, 4, 8), strict=True):
        assert level.shape == backbone.grid.shape(stride)
        assert level.index[0, 1:].tolist() == [size - 1 for size in level.shape]
    assert bev.features.shape[2:] == backbone.grid.shape(4)[1:]


def test_points_far_outside_give_an_empty_scan() -> None:
    levels, bev = TacoBackbone(POINTS, **TINY)(Points.from_scan(torch.full((5, 3), 500.0), torch.zeros(5, 1)))
    assert [len(level) for level in levels] == [0, 0, 0]
    assert bev.features.isfinite().all()


@pytest.mark.parametrize(("options", "message"), [({"bev_stride": 3}, "no level of stride 3"), ({"stem": 0}, "stem")])
def test_backbone_says_what_it_needs(options: dict[str, int], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TacoBackbone(POINTS, **options)


def test_finer_voxels_are_averaged_over_the_coarse_ones() -> None:
    levels, _ = TacoBackbone(POINTS, **TINY).eval()(frames(1)[0].inputs["points"])
    fine, coarse = levels[0].with_features(torch.ones(len(levels[0]), 2)), levels[2]
    torch.testing.assert_close(averaged(fine, coarse), torch.ones(len(coarse), 2))


# scene coordinates


def test_source_is_the_mean_of_the_points_of_a_voxel() -> None:
    frame = frames(1)[0]
    points = frame.inputs["points"]
    levels, _ = TacoBackbone(POINTS, **TINY).eval()(points)
    level = levels[2]
    output = SceneCoordHead(Spec(Voxels, 8, 8, level.grid), POINTS, hidden=8).eval()(level, points)
    cell, inside = level.grid.index(points.xyz)
    mine = inside & (cell // 8 == level.index[0, 1:]).all(1)
    torch.testing.assert_close(output.pairs.source[0], points.xyz[mine].mean(0))
    assert len(output.pairs) == len(level)


def test_columns_of_a_map_give_pairs_where_there_are_points() -> None:
    points = Points.from_scan(torch.tensor([[0.5, 0.5, 0.0], [0.7, 0.5, 3.0], [-30.0, 2.0, 1.0]]), torch.zeros(3, 1))
    grid = TacoBackbone(POINTS, **TINY).grid
    head = SceneCoordBEVHead(Spec(BEV, 4, 8, grid), POINTS, hidden=8).eval()
    output = head(BEV(torch.randn(1, 4, 75, 75), grid, 8), points)
    torch.testing.assert_close(output.pairs.source, torch.tensor([[0.6, 0.5, 1.5], [-30.0, 2.0, 1.0]]))
    assert int((output.tap.features.amax(1) > 0).sum()) <= 2


def test_tap_is_what_the_last_layer_reads() -> None:
    frame = frames(1)[0]
    levels, _ = TacoBackbone(POINTS, **TINY).eval()(frame.inputs["points"])
    head = SceneCoordHead(Spec(Voxels, 8, 8, levels[2].grid), POINTS, hidden=8).eval()
    before = head(levels[2], frame.inputs["points"])
    assert before.tap.features.min() >= 0
    with torch.no_grad():
        head.regressor.bottleneck.weight.zero_()
        head.regressor.bottleneck.bias.fill_(-1.0)  # a tap of zeros leaves nothing but the bias
    after = head(levels[2], frame.inputs["points"])
    assert after.tap.features.abs().sum() == 0
    assert after.pairs.world.std(0).max() < 1e-6


@pytest.mark.parametrize("target", ["absolute", "shift", "affine"])
def test_untrained_predictions_start_around_the_map(target: str) -> None:
    """Far map coordinates: origin and scale come from the training batches, and are kept with the weights."""
    far = quarter_turn(5000.0)
    frame = frames(1)[0]
    batch = collate([Frame(frame.inputs, known(far), frame.meta)])
    levels, _ = TacoBackbone(POINTS, **TINY)(batch.inputs["points"])
    head = SceneCoordHead(Spec(Voxels, 8, 8, levels[2].grid), POINTS, hidden=8, target=target)
    output = head.train()(levels[2], batch.inputs["points"], batch.targets)
    assert abs(float(output.pairs.world[:, 0].detach().mean()) - 5000) < 100
    other = SceneCoordHead(Spec(Voxels, 8, 8, levels[2].grid), POINTS, hidden=8, target=target)
    other.load_state_dict(head.state_dict())
    torch.testing.assert_close(other.regressor.origin, head.regressor.origin)


def test_calibration_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lidarfw_taco.heads.scene_coord.CALIBRATION", 2)
    head = SceneCoordHead(Spec(Voxels, 8, 8, TacoBackbone(POINTS, **TINY).grid), POINTS, hidden=8)
    source, batch = torch.randn(20, 3), torch.zeros(20, dtype=torch.long)
    for x in (0.0, 10.0, 1000.0):
        head.regressor.calibrate(source, batch, known(quarter_turn(x)).poses)
    mean = transform(quarter_turn(5.0), source).mean(0)
    torch.testing.assert_close(head.regressor.origin, mean, atol=1e-4, rtol=0)


def test_unknown_target_is_refused() -> None:
    with pytest.raises(ConfigError, match="absolute or shift or affine"):
        SceneCoordHead(Spec(Voxels, 8, 8, TacoBackbone(POINTS, **TINY).grid), POINTS, target="relative")


def test_true_place_of_a_point() -> None:
    source = torch.tensor([[1.0, 2.0, 3.0]])
    output = pairs(torch.zeros(1, 3), source)
    place = true_places(output.pairs, known(quarter_turn()).poses)
    torch.testing.assert_close(place, torch.tensor([[8.0, 1.0, 3.0]]))
    torch.testing.assert_close(place - torch.tensor([5.0, 0, 0]), torch.tensor([[3.0, 1.0, 3.0]]))
    torch.testing.assert_close(place - torch.tensor([5.0, 0, 0]) - source, torch.tensor([[2.0, -1.0, 0.0]]))


# regions


def poses_at(*places: float, ok: bool = True, turned: bool = False) -> Poses:
    matrix = torch.eye(4).repeat(len(places), 1, 1)
    matrix[:, 0, 3] = torch.tensor(places)
    if turned:
        matrix[:, :2, :2] = torch.tensor([[-1.0, 0], [0, -1]])
    return Poses(matrix, torch.full((len(places),), ok), torch.ones(len(places)))


def test_regions_are_founded_where_none_is_near() -> None:
    regions = Regions(4, 4, size=8.0)
    regions.found(poses_at(0.0, 5.0, 9.0, 14.0))
    regions.found(poses_at(1.0, turned=True))
    regions.found(poses_at(500.0, ok=False))
    assert int(regions.founded) == 3
    assert regions.poses[:3, 0, 3].tolist() == [0, 9, 1]
    assert regions.of(poses_at(4.0, 6.0, 100.0)).tolist() == [0, 1, 1]
    assert regions.of(poses_at(4.0, turned=True)).tolist() == [2]
    assert regions.of(poses_at(4.0, ok=False)).tolist() == [-1]
    regions.found(poses_at(100.0, 200.0, 300.0))
    assert int(regions.founded) == 4  # full
    logits = Regions(4, 4, size=8.0).eval()(torch.randn(5, 4), torch.tensor([0, 0, 0, 1, 1]), 2)
    assert logits.argmax(1).tolist() == [0, 0]  # nothing else is known yet


@pytest.mark.parametrize("target", ["absolute", "shift", "affine"])
def test_places_are_measured_from_the_region(target: str) -> None:
    regressor = CoordinateRegressor(4, 8, 8, target, regions=2, region_size=8.0).train()
    cells = SceneCoords(torch.randn(6, 3), torch.zeros(6, 3), torch.ones(6), torch.arange(6) // 3, 2)
    poses = Poses(torch.stack([torch.eye(4), quarter_turn(50.0)]), torch.ones(2, dtype=torch.bool), torch.ones(2))
    regressor.calibrate(cells.source, cells.batch, poses)
    torch.nn.init.zeros_(regressor.last.weight)
    torch.nn.init.zeros_(regressor.last.bias)
    found = regressor(torch.randn(6, 4), cells, poses)
    assert found.region is not None
    assert found.region.tolist() == [0, 1]
    local = torch.zeros_like(cells.source) if target == "absolute" else cells.source
    torch.testing.assert_close(found.world, transform(poses.matrix[cells.batch], local[:, None])[:, 0])


def test_the_loss_of_regions_counts_scans_with_a_pose() -> None:
    logits = torch.tensor([[0.0, 0.0], [5.0, 0.0]], requires_grad=True)
    output = dataclasses.replace(pairs(torch.zeros(1, 3)), region_logits=logits, region=torch.tensor([1, -1]))
    term = SceneCoordLoss(Spec(SceneCoords))(output, known(torch.eye(4)))["region"]
    assert term.item() == pytest.approx(math.log(2))
    none = dataclasses.replace(output, region=torch.tensor([-1, -1]))
    assert SceneCoordLoss(Spec(SceneCoords))(none, known(torch.eye(4)))["region"].item() == 0


@pytest.mark.parametrize("options", [{"regions": -1}, {"regions": 4, "region_size": 0.0}])
def test_regions_say_what_they_need(options: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="region_size"):
        SceneCoordHead(Spec(Voxels, 8, 8, TacoBackbone(POINTS, **TINY).grid), POINTS, hidden=8, **options)


# the loss


def test_loss_is_the_sum_over_the_axes_in_metres() -> None:
    output = pairs(torch.tensor([[8.5, 0.5, 4.0]]), torch.tensor([[1.0, 2.0, 3.0]]))
    loss = SceneCoordLoss(Spec(SceneCoords))(output, known(quarter_turn()))
    assert loss["l1"].item() == pytest.approx(2.0)


def test_weights_of_pairs() -> None:
    world = torch.tensor([[1.0, 0, 0], [0, 5.0, 0]])
    loss = SceneCoordLoss(Spec(SceneCoords))
    term = loss(pairs(world, weight=torch.tensor([1.0, 0.0])), known(torch.eye(4)))["l1"]
    assert term.item() == pytest.approx(1.0)
    term = SceneCoordLoss(Spec(SceneCoords), clamp=2.0)(pairs(world), known(torch.eye(4)))["l1"]
    assert term.item() == pytest.approx(1.5)


def test_moving_objects_can_be_left_out() -> None:
    frame = frames(1)[0]
    boxes = frame.targets.boxes
    assert boxes is not None
    moving = boxes.replace(moving=torch.arange(len(boxes)).remainder(2).to(torch.int8))
    output = pairs(torch.zeros(len(boxes), 3), boxes.center)
    targets = known(torch.eye(4)).replace(boxes=moving)
    kept = boxes.center[moving.moving != 1]  # type: ignore[union-attr]
    term = SceneCoordLoss(Spec(SceneCoords), moving_weight=0.0)(output, targets)["l1"]
    assert term.item() == pytest.approx(kept.abs().sum(1).mean().item(), rel=1e-5)
    with pytest.raises(ConfigError, match="what moves"):
        SceneCoordLoss(Spec(SceneCoords), moving_weight=0.0)(output, known(torch.eye(4)))


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("ok", [True, False])
def test_loss_on_almost_nothing(count: int, ok: bool) -> None:
    world = torch.zeros(count, 3, requires_grad=True)
    matrix = torch.eye(4) if ok else torch.full((4, 4), torch.nan)
    term = SceneCoordLoss(Spec(SceneCoords))(pairs(world), known(matrix, ok))["l1"]
    term.backward()
    assert term.item() == 0
    assert world.grad is not None
    assert world.grad.isfinite().all()


# augmentation


@pytest.mark.parametrize("change", [RandomShift(distance=2.0, probability=1.0), RandomRotation(angle=0.2)])
def test_augmentation_keeps_places_and_what_is_in_a_box(change: RandomShift | RandomRotation) -> None:
    frame = frames(1)[0]
    points, poses = frame.inputs["points"], frame.targets.poses
    assert poses is not None
    exact = frame.targets.replace(poses=poses.replace(matrix=poses.matrix.double()))
    frame = Frame({"points": points.replace(xyz=points.xyz.double())}, exact, frame.meta)
    for seed in range(5):
        moved = change(frame, np.random.default_rng(seed))
        places = [
            transform(f.targets.poses.matrix[0].double(), f.inputs["points"].xyz.double()) for f in (frame, moved)
        ]  # type: ignore[union-attr]
        torch.testing.assert_close(*places, atol=1e-5, rtol=0)
        inside = [
            points_in_boxes_mask(f.inputs["points"].xyz.double(), f.targets.boxes.tensor.double())
            for f in (frame, moved)
        ]  # type: ignore[union-attr]
        assert int((inside[0] != inside[1]).sum()) <= 2  # points on a face may change sides
        assert not torch.equal(moved.inputs["points"].xyz, frame.inputs["points"].xyz)


def test_shift_is_bounded() -> None:
    frame = frames(1)[0]
    shifts = [
        (
            RandomShift(probability=1.0)(frame, np.random.default_rng(s)).inputs["points"].xyz[0]
            - frame.inputs["points"].xyz[0]
        )
        for s in range(50)
    ]
    stacked = torch.stack(shifts)
    assert stacked[:, :2].abs().max() <= 1 + 1e-4
    assert stacked[:, :2].std() > 0.4
    assert stacked[:, 2].abs().max() < 1e-6
    with pytest.raises(ConfigError, match="distance"):
        RandomShift(distance=-1)


# the whole


def model_overrides(*more: str) -> list[str]:
    return [
        "dataset.synthetic.points=2048",
        "backbone=taco_small",
        "backbone.taco.lower=[0,-19.2,-2.4]",
        "backbone.taco.upper=[38.4,19.2,4.0]",
        "backbone.taco.stem=8",
        "backbone.taco.blocks=[[16],[16],[32]]",
        "backbone.taco.bev_channels=16",
        "neck=[bev_fpn_taco_small,gated_fusion]",
        "neck.bev_fpn.layers=[1,1]",
        "neck.bev_fpn.channels=[16,16]",
        "neck.bev_fpn.upsampled=[16,16]",
        "neck.gated_fusion.context=16",
        "head=[center_small,scene_coord_small]",
        "head.center.channels=16",
        "head.scene_coord.target=affine",
        "head.scene_coord.hidden=64",
        *more,
    ]


def learned(batch: Batch, overrides: list[str], steps: int, rate: float) -> tuple[dict[str, dict[str, Tensor]], object]:
    """The losses after so many steps on one batch, and the model."""
    torch.manual_seed(0)
    model = build(plan(compose(overrides))).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    for _ in range(steps):
        terms = model.losses(model(batch), batch)
        optimizer.zero_grad()
        torch.stack([value for values in terms.values() for value in values.values()]).sum().backward()
        optimizer.step()
        schedule.step()
    return terms, model


def test_eight_scans_are_learned_by_heart() -> None:
    """Scans of one drive: map coordinates within 0.3 m, poses within 0.3 m, every object a peak of the heat map."""
    dataset = SyntheticDataset(frames=8, sequence_length=8, points=2048)
    batch = collate([dataset[number] for number in range(8)])
    terms, model = learned(batch, model_overrides(), 100, 0.01)
    assert float(terms["scene_coord"]["l1"].detach()) < 0.3
    with torch.no_grad():
        results = model.eval().predict(batch)  # type: ignore[attr-defined]
    errors = pose_errors(
        torch.cat([r.of(Poses).matrix for r in results]),
        batch.targets.poses.matrix,  # type: ignore[union-attr]
    )
    assert float(errors[:, 0].median()) < 0.3
    for number, result in enumerate(results):
        truth = batch.targets.boxes.sample(number)  # type: ignore[union-attr]
        found = result.predictions["head.center"]
        apart = torch.cdist(truth.center[:, :2], found.center[:, :2])
        assert (apart.amin(1) < 1.0).all()


@pytest.mark.parametrize(
    "overrides",
    [
        ["backbone=second_small", "neck=[height_compression,bev_fpn_second_small]",
         "head=[center_small,scene_coord_small]"],
        ["backbone=taco_small", "neck=bev_fpn_taco_small", "head=anchor"],
        ["backbone=taco_small", "neck=[]", "head=anchor"],
        ["backbone=pillars_small", "neck=bev_fpn_small", "head=[center_small,scene_coord_bev]",
         "head.scene_coord_bev.hidden=32"],
        ["backbone=taco_small", "neck=gated_fusion", "head=scene_coord_small"],
    ],
)  # fmt: skip
def test_mixes_train(overrides: list[str]) -> None:
    batch = collate([SyntheticDataset(frames=2, points=1024)[number] for number in range(2)])
    terms, model = learned(batch, overrides, 2, 1e-3)
    assert all(value.isfinite() for values in terms.values() for value in values.values())
    with torch.no_grad():
        assert len(model.eval().predict(batch)) == 2  # type: ignore[attr-defined]


def test_a_scan_without_points_beside_another() -> None:
    """With context and regions: finite in training, and no influence on the other scan afterwards."""
    frame = SyntheticDataset(frames=1, points=1024)[0]
    nothing = Points.from_scan(torch.zeros(0, 3), frame.inputs["points"].features[:0])
    empty = Frame({"points": nothing}, frame.targets, frame.meta)
    batch = collate([empty, frame])
    overrides = model_overrides("head.scene_coord.regions=4", "dataset.synthetic.points=1024")
    terms, model = learned(batch, overrides, 2, 1e-3)
    assert float(terms["scene_coord"]["region"].detach()) >= 0
    assert all(value.isfinite() for values in terms.values() for value in values.values())
    learned(collate([empty]), overrides, 2, 1e-3)
    with torch.no_grad():
        model.eval()  # type: ignore[attr-defined]
        both, alone = model.predict(batch), model.predict(collate([frame]))  # type: ignore[attr-defined]
    assert not bool(both[0].of(Poses).ok)
    torch.testing.assert_close(both[1].of(Poses).matrix, alone[0].of(Poses).matrix, atol=1e-3, rtol=1e-3)


def test_small_backbone_takes_a_scan_all_around() -> None:
    assert math.isclose(compose(["backbone=taco_small"]).backbone.taco.upper[0], 38.4)
    assert DataSpec().sweeps == 1
