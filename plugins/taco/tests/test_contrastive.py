"""Losses itcl, idcl, ilcl: the closed-form values of the specification, gradients, and inputs with nothing in them."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from lidarfw.assembly import build, plan
from lidarfw.config import compose
from lidarfw.errors import AssemblyError, ConfigError
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import BEV, Boxes, Grid, Spec, Targets, collate
from torch import Tensor

from lidarfw_taco.features import mean_similarity, object_features, occupied, top_cells
from lidarfw_taco.losses.contrastive import IDCL, ILCL, ITCL, motion_contrast

GRID = Grid((0.0, 0.0, -2.0), (8.0, 8.0, 2.0), (1.0, 1.0, 1.0))
CAR, PEDESTRIAN = 0, 1
MOVING, STATIC, UNKNOWN = 1, 0, -1


def bev(*samples: dict[tuple[int, int], list[float]], channels: int = 2, stride: int = 1) -> BEV:
    """Maps that are 0 but for vectors at cells (column, row)."""
    _, height, width = GRID.shape(stride)
    features = torch.zeros(max(len(samples), 1), channels, height, width)
    for number, cells in enumerate(samples):
        for (column, row), vector in cells.items():
            features[number, :, row, column] = torch.tensor(vector)
    return BEV(features.requires_grad_(), GRID, stride)


def boxes(*rows: tuple[float, float, int, int], batch: list[int] | None = None, size: float = 0.9) -> Boxes:
    """Boxes at x, y of class and motion state."""
    tensor = torch.tensor([[x, y, 0.0, size, size, 1.5, 0.0] for x, y, _, _ in rows]).view(-1, 7)
    label = torch.tensor([label for *_, label, _ in rows], dtype=torch.long)
    owner = torch.zeros(len(rows), dtype=torch.long) if batch is None else torch.tensor(batch)
    made = Boxes.from_tensor(tensor, label, batch=owner, batch_size=max([0, *(batch or [])]) + 1)
    return made.replace(moving=torch.tensor([moving for *_, moving in rows], dtype=torch.int8))


def itcl(detection: BEV, localization: BEV, found: Boxes | None, **options) -> Tensor:
    loss = ITCL(Spec(BEV, 2, 1, GRID), Spec(BEV, 2, 1, GRID), **options)
    return loss(detection, localization, Targets(found))["cosine"]


def ilcl(localization: BEV, found: Boxes | None, **options) -> Tensor:
    return ILCL(Spec(BEV, 2, 1, GRID), **options)(localization, Targets(found))["cosine"]


# --- G2, G3: inter-task


@pytest.mark.parametrize(
    ("place", "thing", "mode", "value"),
    [
        ([1, 0], [0, 1], "raw", 0), ([1, 0], [1, 0], "raw", 1), ([1, 0], [-1, 0], "raw", -1),
        ([1, 0], [-1, 0], "relu", 0), ([1, 0], [-1, 0], "square", 1), ([7, 0], [7, 7], "raw", math.sqrt(0.5)),
    ],
)  # fmt: skip
def test_cosine_of_one_cell_and_one_object(place, thing, mode, value):
    value_found = itcl(bev({(2, 2): thing}), bev({(6, 6): place}), boxes((2.5, 2.5, CAR, MOVING)), mode=mode)
    assert float(value_found.detach()) == pytest.approx(value, abs=1e-6)


def test_mean_over_pairs_and_samples():
    """{[1,0],[3,4]} x {[0,2]} is 0.4; with a sample that has no object, 0.2."""
    cells, thing = {(6, 6): [1, 0], (7, 6): [3, 4]}, {(2, 2): [0, 2]}
    found = boxes((2.5, 2.5, CAR, UNKNOWN))
    assert float(itcl(bev(thing), bev(cells), found)) == pytest.approx(0.4)
    two = boxes((2.5, 2.5, CAR, UNKNOWN), batch=[0]).replace(batch_size=2)
    assert float(itcl(bev(thing, thing), bev(cells, cells), two)) == pytest.approx(0.2)


def test_gradient_of_a_cosine():
    place, thing = bev({(6, 6): [1, 0]}), bev({(2, 2): [1, 1]})
    value = itcl(thing, place, boxes((2.5, 2.5, CAR, STATIC)))
    value.backward()
    assert float(value) == pytest.approx(0.70711, abs=1e-5)
    assert place.features.grad[0, :, 6, 6].tolist() == pytest.approx([0, 0.70711], abs=1e-5)
    assert int((place.features.grad != 0).sum()) == 1
    assert thing.features.grad[0, :, 2, 2].abs().sum() > 0


@pytest.mark.parametrize("side", ["localization", "detection"])
def test_a_side_can_be_detached(side):
    maps = {"localization": bev({(6, 6): [1, 0]}), "detection": bev({(2, 2): [1, 1]})}
    itcl(maps["detection"], maps["localization"], boxes((2.5, 2.5, CAR, STATIC)), detach=side).backward()
    other = "detection" if side == "localization" else "localization"
    assert not maps[side].features.grad.any()
    assert maps[other].features.grad.any()


def test_cells_on_objects_are_left_out_unless_told():
    found = boxes((2.5, 2.5, CAR, STATIC))
    place = bev({(2, 2): [9, 0], (6, 6): [0, 1]})
    assert float(itcl(bev({(2, 2): [1, 0]}), place, found)) == pytest.approx(0)
    assert float(itcl(bev({(2, 2): [1, 0]}), place, found, exclude_objects=False)) == pytest.approx(0.5)


def test_signed_taps_are_pointed_out_once():
    place, thing, found = bev({(6, 6): [-1, 0]}), bev({(2, 2): [1, 0]}), boxes((2.5, 2.5, CAR, STATIC))
    with pytest.warns(UserWarning, match="loss.itcl.mode=square"):
        itcl(thing, place, found)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        itcl(thing, place, found, mode="square")
        itcl(thing, bev({(6, 6): [1, 0]}), found)


# --- G4 to G6: intra-detection


def contrast(moving: list[tuple[int, list[float]]], static: list[tuple[int, list[float]]], temperature: float) -> float:
    both = [*moving, *static]
    states = torch.tensor([MOVING] * len(moving) + [STATIC] * len(static))
    vectors = torch.tensor([vector for _, vector in both], dtype=torch.float32)
    labels = torch.tensor([label for label, _ in both])
    return float(motion_contrast(vectors, labels, states, torch.zeros(len(both), dtype=torch.long), 1, temperature))


@pytest.mark.parametrize(("temperature", "value"), [(1, 0.313262), (0.5, 0.126928), (0.1, 4.53989e-5)])
def test_contrast_a(temperature, value):
    """The static car has positives only (0), the static pedestrian has none (left out)."""
    found = contrast([(CAR, [1, 0])], [(CAR, [1, 0]), (PEDESTRIAN, [0, 1])], temperature)
    assert found == pytest.approx(value, abs=1e-5)


def test_contrast_b():
    moving, static = [(CAR, [1, 0]), (PEDESTRIAN, [0, 1])], [(CAR, [0.6, 0.8]), (PEDESTRIAN, [1, 0])]
    assert contrast(moving, static, 1) == pytest.approx(2.097758, abs=1e-5)
    assert contrast(moving, static, 0.1) == pytest.approx(12.072729, abs=1e-4)
    assert contrast(static, moving, 1) == pytest.approx(2.097758, abs=1e-5)


@pytest.mark.parametrize(("temperature", "value"), [(1, 0.199052), (0.5, 0.089272)])
def test_contrast_c(temperature, value):
    """One anchor with two positives and a negative; the static cars see positives only, the pedestrian nothing."""
    static = [(CAR, [1, 0]), (CAR, [0.6, 0.8]), (PEDESTRIAN, [0, 1])]
    assert contrast([(CAR, [1, 0])], static, temperature) == pytest.approx(value, abs=1e-5)


def test_idcl_reads_the_map_and_averages_over_samples():
    cells = {(1, 1): [1, 0], (3, 3): [1, 0], (5, 5): [0, 1]}
    rows = [(1.5, 1.5, CAR, MOVING), (3.5, 3.5, CAR, STATIC), (5.5, 5.5, PEDESTRIAN, STATIC)]
    loss = IDCL(Spec(BEV, 2, 1, GRID), temperature=1.0)
    assert float(loss(bev(cells), Targets(boxes(*rows)))["nce"]) == pytest.approx(0.313262, abs=1e-5)
    two = boxes(*rows, batch=[0, 0, 0]).replace(batch_size=2)
    assert float(loss(bev(cells, cells), Targets(two))["nce"]) == pytest.approx(0.313262 / 2, abs=1e-5)


def test_scope_batch_pools_the_objects_of_all_samples():
    cells = {(1, 1): [1, 0], (3, 3): [1, 0], (5, 5): [0, 1]}
    rows = [(1.5, 1.5, CAR, MOVING), (3.5, 3.5, CAR, STATIC), (5.5, 5.5, PEDESTRIAN, STATIC)]
    apart = Targets(boxes(*rows, batch=[0, 1, 1]))
    maps = bev(cells, cells)
    assert float(IDCL(Spec(BEV, 2, 1, GRID), temperature=1.0)(maps, apart)["nce"]) == 0
    pooled = IDCL(Spec(BEV, 2, 1, GRID), temperature=1.0, scope="batch")(maps, apart)["nce"]
    assert float(pooled) == pytest.approx(0.313262, abs=1e-5)


def test_unknown_objects_play_no_part():
    cells = {(1, 1): [1, 0], (3, 3): [1, 0], (5, 5): [0, 1]}
    rows = [(1.5, 1.5, CAR, MOVING), (3.5, 3.5, CAR, STATIC), (5.5, 5.5, PEDESTRIAN, UNKNOWN)]
    loss = IDCL(Spec(BEV, 2, 1, GRID), temperature=1.0)
    assert float(loss(bev(cells), Targets(boxes(*rows)))["nce"]) == 0
    place = {(1, 1): [1, 1], (5, 5): [1, 0], (7, 7): [1, 0]}
    known, unknown = (boxes((1.5, 1.5, CAR, STATIC), (5.5, 5.5, CAR, state)) for state in (STATIC, UNKNOWN))
    assert float(ilcl(bev(place), known)) == pytest.approx((0.707107 + 1) / 2, abs=1e-5)
    assert float(ilcl(bev(place), unknown)) == pytest.approx(0.707107, abs=1e-5)


# --- G7: intra-localization


def test_ilcl():
    cells = {(6, 6): [1, 0], (7, 6): [0, 1], (2, 2): [1, 1]}
    assert float(ilcl(bev(cells), boxes((2.5, 2.5, CAR, STATIC)))) == pytest.approx(0.707107, abs=1e-6)
    assert float(ilcl(bev(cells), boxes((2.5, 2.5, CAR, MOVING)))) == 0
    assert float(ilcl(bev({(2, 2): [1, 1]}), boxes((2.5, 2.5, CAR, STATIC)))) == 0
    with_itself = ilcl(bev({(2, 2): [1, 1]}), boxes((2.5, 2.5, CAR, STATIC)), exclude_objects=False)
    assert float(with_itself) == pytest.approx(1)


def test_ilcl_with_every_cell_of_an_object():
    cells = {(6, 6): [1, 0], (2, 2): [1, 0], (3, 2): [0, 1], (2, 3): [0, 1], (3, 3): [0, 1]}
    large = boxes((3.0, 3.0, CAR, STATIC), size=1.8)
    assert float(ilcl(bev(cells), large, per_cell=True)) == pytest.approx(0.25)
    assert float(ilcl(bev(cells), large)) == pytest.approx(1 / math.sqrt(10), abs=1e-6)


@pytest.mark.parametrize("loss", ["itcl", "idcl", "ilcl"])
def test_order_and_scale_change_nothing(loss):
    generator = torch.Generator().manual_seed(1)
    features = torch.rand(2, 2, 8, 8, generator=generator)
    place = torch.rand(12, 2, generator=generator) * 8
    rows = [(float(x), float(y), (i // 4) % 2, (i // 2) % 2) for i, (x, y) in enumerate(place)]
    found = boxes(*rows, batch=[i % 2 for i in range(12)])

    def value(scale: float, order: Tensor) -> float:
        maps = BEV(features * scale, GRID)
        if loss == "itcl":
            return float(itcl(maps, maps, found[order]))
        made = IDCL(Spec(BEV, 2, 1, GRID)) if loss == "idcl" else ILCL(Spec(BEV, 2, 1, GRID))
        return float(sum(made(maps, targets=Targets(found[order])).values()))

    first = value(1, torch.arange(12))
    assert first != 0
    assert value(7, torch.arange(12)) == pytest.approx(first, abs=1e-5)
    assert value(1, torch.randperm(12, generator=generator)) == pytest.approx(first, abs=1e-5)


# --- G8 and the vectors


def test_top_cells():
    maps = bev({(0, 0): [3, 0], (1, 0): [0, 1], (2, 0): [3, 0], (3, 0): [2, 0]})
    assert top_cells(maps, 2)[2].tolist() == [[0, 2]]
    excluded = torch.zeros(1, 8, 8, dtype=torch.bool)
    excluded[0, 0, 0] = True
    assert top_cells(maps, 2, excluded)[2].tolist() == [[2, 3]]
    _, valid, index = top_cells(maps, 10)
    assert index[valid].tolist() == [0, 2, 3, 1]  # empty cells are none
    assert top_cells(maps, 1000)[0].shape == (1, 64, 2)


def test_vectors_of_objects():
    maps = bev({(2, 2): [1, 0], (3, 2): [0, 1], (2, 3): [2, 0], (3, 3): [0, 2]})
    large, small = boxes((3.0, 3.0, CAR, STATIC), size=1.8), boxes((3.2, 2.9, CAR, STATIC), size=0.1)
    assert object_features(maps, large)[0].tolist() == [[0.75, 0.75]]
    assert object_features(maps, small)[0].tolist() == [[0, 1]]  # covers no cell centre: the cell of its centre
    middle = object_features(maps, boxes((3.0, 2.5, CAR, STATIC)), "center")[0]
    assert middle.tolist() == [[0.5, 0.5]]
    assert object_features(maps, boxes((0.1, 0.1, CAR, STATIC)), "center")[0].tolist() == [[0, 0]]
    off = boxes((-0.1, 3, CAR, STATIC), (2.5, 2.5, CAR, STATIC), (8.0, 3, CAR, STATIC))
    assert object_features(maps, off)[1].tolist() == [1]


def test_a_turned_footprint_covers_the_cells_under_it():
    maps = BEV(torch.ones(1, 2, 8, 8), GRID)
    turned = boxes((4.0, 4.0, CAR, STATIC))
    turned = turned.replace(size=torch.tensor([[5.0, 0.8, 1.5]]), yaw=torch.tensor([math.pi / 4]))
    mask = occupied(maps, turned)[0]
    cells = {tuple(cell) for cell in mask.nonzero().tolist()}
    assert {(2, 2), (3, 3), (4, 4), (5, 5)} <= cells
    assert (2, 5) not in cells
    assert mask.sum() < 8


def test_zero_vectors_have_no_cosine():
    cells, valid = torch.zeros(1, 1, 2), torch.ones(1, 1, dtype=torch.bool)
    objects = torch.zeros(1, 2, requires_grad=True)
    value = mean_similarity(cells, valid, objects, torch.zeros(1, dtype=torch.long))
    value.sum().backward()
    assert value.tolist() == [0]
    assert objects.grad.isfinite().all()


# --- nothing there


NOTHING = {
    "no labels": None,
    "no boxes": boxes(),
    "no static": boxes((1.5, 1.5, CAR, MOVING)),
    "no moving": boxes((1.5, 1.5, CAR, STATIC)),
    "all unknown": boxes((1.5, 1.5, CAR, UNKNOWN), (3.5, 1.5, CAR, UNKNOWN)),
    "off the map": boxes((-50, 1.5, CAR, STATIC), (-50, 3.5, CAR, MOVING)),
    "one class": boxes((1.5, 1.5, CAR, STATIC), (4.5, 1.5, CAR, MOVING)),
    "no extent": boxes((1.5, 1.5, CAR, STATIC), (4.5, 1.5, CAR, MOVING), size=0.0),
}


@pytest.mark.parametrize("what", NOTHING)
@pytest.mark.parametrize("map_", ["empty", "one cell", "noise"])
@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_inputs_with_nothing_in_them(what, map_, samples, dtype):
    features = {"empty": torch.zeros, "noise": torch.rand}.get(map_, torch.zeros)(samples, 2, 8, 8)
    if map_ == "one cell":
        features[:, :, 7, 7] = 1
    features = features.to(dtype).requires_grad_()
    maps, found = BEV(features, GRID), NOTHING[what]
    found = None if found is None else found.replace(batch_size=samples)
    spec = Spec(BEV, 2, 1, GRID)
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=dtype == torch.bfloat16):
        terms = [
            itcl(maps, maps, found, mode="square"),
            ilcl(maps, found),
            IDCL(spec)(maps, Targets(found))["nce"],
            IDCL(spec, scope="batch")(maps, Targets(found))["nce"],
            ilcl(maps, found, per_cell=True),
        ]
    total = torch.stack([term.float() for term in terms]).sum()
    total.backward()
    assert bool(total.isfinite())
    assert bool(features.grad.isfinite().all())
    if what in ("no labels", "no boxes", "off the map", "no extent"):
        assert float(total) == 0


def test_16_bit_maps_do_not_overflow():
    maps = BEV(torch.full((1, 2, 8, 8), 300.0, dtype=torch.float16), GRID)
    assert float(itcl(maps, maps, boxes((2.5, 2.5, CAR, STATIC)))) == pytest.approx(1)


# --- options and wiring


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda s: ITCL(s, s, mode="cosine"), "loss.itcl.mode is 'cosine'; use one of: raw, relu, square"),
        (lambda s: ITCL(s, s, top=0), "loss.itcl.top must be above 0"),
        (lambda s: ITCL(s, s, detach="loc"), "use one of: none, localization, detection"),
        (lambda s: IDCL(s, temperature=0), "loss.idcl.temperature must be above 0"),
        (lambda s: IDCL(s, scope="all"), "use one of: sample, batch"),
        (lambda s: ILCL(s, pooling="max"), "use one of: mean, center"),
    ],
)
def test_wrong_options(make, text):
    with pytest.raises(ConfigError, match=text):
        make(Spec(BEV, 2, 1, GRID))


def test_taps_of_other_widths_are_refused():
    with pytest.raises(AssemblyError, match=r"detection has 64 channels and localization 32.\n  fix: equal widths"):
        ITCL(Spec(BEV, 64, 1, GRID), Spec(BEV, 32, 1, GRID))


@pytest.mark.parametrize("loss", [IDCL, ILCL])
def test_without_motion_states_the_transform_is_named(loss):
    found = boxes((1.5, 1.5, CAR, STATIC)).replace(moving=None)
    with pytest.raises(ConfigError, match="motion_state"):
        loss(Spec(BEV, 2, 1, GRID))(bev({}), targets=Targets(found))


COMMON = ["dataset.synthetic.frames=4", "dataset.synthetic.pose=true", "metric=box_ap"]
MIXES = {
    "pillars, anchor": [
        "backbone=pillars_small", "neck=bev_fpn_small", "head=[anchor,scene_coord_bev]",
        "head.scene_coord_bev.hidden=16", "loss=[anchor,idcl,ilcl]",
    ],
    "second, center": [
        "backbone=second_small", "neck=[height_compression,bev_fpn_second_small]", "head=[center,scene_coord]",
        "head.center.channels=16", "head.scene_coord.tap_channels=16", "head.scene_coord.hidden=16",
        "loss=[center,scene_coord,itcl,idcl,ilcl]",
    ],
}  # fmt: skip


@pytest.mark.parametrize("mix", MIXES)
def test_any_detector_and_any_localizer(mix):
    """The losses reach the taps of heads that know nothing of them, and their gradient every layer before."""
    config = compose([*COMMON, *MIXES[mix]])
    model = build(plan(config)).train()
    dataset = SyntheticDataset(frames=2, sequence_length=2, pose=True, points=2048)
    batch = collate([dataset[0], dataset[1]])
    terms = model.losses(model(batch), batch)
    own = {name: terms[name] for name in terms if name in ("itcl", "idcl", "ilcl")}
    assert len(own) >= 2
    torch.stack([term for each in own.values() for term in each.values()]).sum().backward()
    reached = {name for name, p in model.named_parameters() if p.grad is not None and p.grad.abs().sum() > 0}
    assert any(name.startswith("backbone") for name in reached)


def test_a_missing_head_is_named():
    overrides = [*COMMON, "backbone=pillars_small", "neck=bev_fpn_small", "head=center", "loss=[center,itcl]"]
    with pytest.raises(AssemblyError, match=r"head that predicts SceneCoords(?s:.*)loss=\[center\]"):
        plan(compose(overrides))


def test_ramp_and_weight_are_those_of_every_loss():
    config = compose([*COMMON, *MIXES["second, center"], "loss.itcl.weight=0.1", "loss.itcl.ramp=0.5"])
    model = build(plan(config)).eval()
    dataset = SyntheticDataset(frames=1, sequence_length=1, pose=True, points=2048)
    batch = collate([dataset[0]])
    outputs = model(batch)
    half, whole = (float(model.losses(outputs, batch, p)["itcl"]["cosine"]) for p in (0.25, 1.0))
    assert half == pytest.approx(whole / 2)
