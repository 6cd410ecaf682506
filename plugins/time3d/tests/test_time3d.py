"""The network of Time3D, its losses and its tracker: the golden numbers of its equations, and what must never break."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import pytest
import torch
from lidarfw.errors import ConfigError, DataError
from lidarfw.ops import box_corners
from lidarfw.plain import from_plain, to_plain
from lidarfw.types import Boxes, FrameMeta, FrameResult, Poses, Spec, Targets, Tracks

from lidarfw_time3d.flow import CueEmbedding, SpatialFlow, TemporalFlow, association, masked, refine, unimodal
from lidarfw_time3d.losses import (
    AssociationLoss,
    TemporalConsistencyLoss,
    association_loss,
    consistency,
    identities,
)
from lidarfw_time3d.time3d import Slots, Time3D, Time3DOutput, assign

SPEC = Spec(Boxes, classes=("Car", "Pedestrian"))
H1 = torch.tensor([[2.0, 0, 0], [0, 1, 0], [0, 0, 0]])


def boxes(rows: list[tuple[float, float]], score: float = 0.9, label: int = 0) -> Boxes:
    table = torch.tensor([(x, y, 0.0, 4.0, 1.8, 1.5, 0.1) for x, y in rows]).reshape(-1, 7)
    return Boxes.from_tensor(table, torch.full((len(rows),), label), torch.full((len(rows),), score))


def small(**options: Any) -> Time3D:
    torch.manual_seed(0)
    return Time3D(SPEC, **{"width": 32, "layers": 1, "heads": 4, **options}).eval()


def follow(tracker: Time3D, sequence: list[Boxes], poses: list[torch.Tensor] | None = None) -> list[Tracks]:
    state = tracker.start()
    return [step(tracker, state, index, found, None if poses is None else poses[index])
            for index, found in enumerate(sequence)]  # fmt: skip


@torch.no_grad()
def step(tracker: Time3D, state: Any, index: int, found: Boxes, pose: torch.Tensor | None = None) -> Tracks:
    meta = FrameMeta(str(index), "s", index, index / 10)
    known = None if pose is None else Poses(pose[None], torch.tensor([True]), torch.ones(1))
    (result,) = tracker.step(state, FrameResult(meta), found, [meta], known)
    assert result.tracks is not None
    return result.tracks


def test_association_matrix_h1() -> None:
    row, column = association(H1)
    np.testing.assert_allclose(row.exp()[0], [0.786986, 0.106507, 0.106507], atol=1e-6)
    np.testing.assert_allclose(row.exp()[1], [0.211942, 0.576117, 0.211942], atol=1e-6)
    torch.testing.assert_close(column, row.T)
    expected = [[0.619347, 0.022573, 0.035502], [0.022573, 0.331911, 0.070647], [0.035502, 0.070647, 0.111111]]
    np.testing.assert_allclose(unimodal(H1), expected, atol=1e-6)


def test_association_loss_h1() -> None:
    one = torch.tensor([[10, 11]])
    literal: dict[str, Any] = {"none": "product", "symmetric": False}
    assert float(association_loss(H1[None], one, one, **literal)) * 2 == pytest.approx(1.5819790, abs=1e-6)
    newborn = torch.tensor([[10, 12]])
    assert float(association_loss(H1[None], one, newborn, **literal)) * 2 == pytest.approx(3.1291465, abs=1e-6)
    single = association_loss(H1[None], one, newborn, none="single", symmetric=False)
    assert float(single) * 2 == pytest.approx(2.0305342, abs=1e-6)


def test_empty_places_change_nothing_h2() -> None:
    block = torch.tensor([[3.0, -1], [-1, 2]])
    whole = torch.zeros(1, 5, 5)
    whole[0, :2, :2] = block
    mask = torch.tensor([[True, True, False, False]])
    found = unimodal(masked(whole, mask, mask))[0]
    expected = [[0.876544, 0.000720, 0.015538], [0.000720, 0.711990, 0.038065], [0.015538, 0.038065, 0.111111]]
    np.testing.assert_allclose(found[[0, 1, 4]][:, [0, 1, 4]], expected, atol=1e-6)
    assert found[2:4].abs().max() == 0
    assert found[:, 2:4].abs().max() == 0


@pytest.mark.parametrize(("count", "floor"), [(1, 0.0), (2, 1.3862944), (3, 3.2958369), (5, 8.0471896)])
def test_the_literal_loss_of_newborns_has_a_floor_h3(count: int, floor: float) -> None:
    logits = torch.full((1, 1, count + 1), 50.0)
    logits[..., -1] = -50
    past, now = torch.zeros(1, 0, dtype=torch.long), torch.arange(count)[None]
    literal = association_loss(logits, past, now, none="product", symmetric=False)
    assert float(literal) * count == pytest.approx(floor, abs=1e-5)
    assert float(association_loss(logits, past, now)) == pytest.approx(0, abs=1e-6)


def _corners(x: float, yaw: float = 0.0) -> torch.Tensor:
    return box_corners(torch.tensor([[x, 0, 0, 4, 2, 1.5, yaw]], dtype=torch.float64))


def test_consistency_h4() -> None:
    should = _corners(11) - _corners(10)
    assert float(consistency(should, should)) == pytest.approx(0, abs=1e-9)
    assert float(consistency(_corners(11.5) - _corners(10.5), should)) == pytest.approx(0, abs=1e-9)
    assert float(consistency(_corners(10.5) - _corners(10.5), should)) == pytest.approx(1, abs=1e-5)
    assert float(consistency(_corners(9) - _corners(10), should)) == pytest.approx(0, abs=1e-9)
    assert float(consistency(_corners(9) - _corners(10), should, vector=True)) == pytest.approx(2)
    assert float(consistency(_corners(11, 0.1) - _corners(10), should)) == pytest.approx(0.0978909, abs=1e-6)
    still = torch.zeros(1, 8, 3, requires_grad=True)
    consistency(still, torch.zeros(1, 8, 3)).backward()  # type: ignore[no-untyped-call]
    assert still.grad is not None
    assert still.grad.isfinite().all()


def test_corners_h5() -> None:
    corners = box_corners(torch.tensor([[10.0, 0, 0, 4, 2, 1.5, 0]]))[0]
    expected = {(x, y, z) for x in (12, 8) for y in (1, -1) for z in (0.75, -0.75)}
    assert {tuple(corner) for corner in corners.tolist()} == expected


def test_assignment_with_a_lost_option_h7() -> None:
    track = assign(np.array([[4.2, 0.3], [0.2, 0.4]]), np.array([0.5, 1.5]))
    assert track.tolist() == [0, -1]


def test_products_of_attention_h10() -> None:
    flow = TemporalFlow(2, 1)
    for layer in (flow.query, flow.key):
        torch.nn.init.eye_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    now, past = torch.tensor([[[1.0, 0], [0, 1]]]), torch.tensor([[[1.0, 0], [1, 1]]])
    product = flow._products(past, now)[0, 0].T
    np.testing.assert_allclose(product.detach(), [[0.7071068, 0.7071068], [0, 0.7071068]], atol=1e-6)
    np.testing.assert_allclose(product.softmax(1).detach(), [[0.5, 0.5], [0.3302385, 0.6697615]], atol=1e-6)


@pytest.mark.parametrize("heads", [1, 4])
def test_like_boxes_have_the_higher_logits_before_any_training(heads: int) -> None:
    torch.manual_seed(0)
    boxes, there = torch.randn(1, 6, 64), torch.ones(1, 6, dtype=torch.bool)
    logits = TemporalFlow(64, heads)(boxes, boxes, there, there, torch.zeros(1))[0][0, :6, :6]
    assert (logits.argmax(0) == torch.arange(6)).all()
    assert (logits.argmax(1) == torch.arange(6)).all()


def test_order_of_boxes_permutes_the_affinity_h12() -> None:
    torch.manual_seed(0)
    flow = TemporalFlow(16, 4).eval()
    past, now, there = torch.randn(1, 3, 16), torch.randn(1, 4, 16), torch.ones(1, 4, dtype=torch.bool)
    logits = flow(past, now, there[:, :3], there, torch.ones(1))[0][0]
    rows, columns = torch.tensor([2, 0, 1]), torch.tensor([3, 1, 0, 2])
    mixed = flow(past[:, rows], now[:, columns], there[:, :3], there, torch.ones(1))[0][0]
    torch.testing.assert_close(mixed[:3, :4], logits[rows][:, columns])
    torch.testing.assert_close(mixed[-1], logits[-1][[*columns.tolist(), 4]])


@pytest.mark.parametrize("affinity", ["learned", "geometric"])
def test_where_the_drive_is_does_not_matter_h12(affinity: str) -> None:
    """The same sequence in a map that is turned and moved gives the same ids."""
    tracker = small(affinity=affinity)
    sequence = [boxes([(10 + t, 0), (30 - t, 6), (22, -5 + 0.1 * t)]) for t in range(6)]
    turn = torch.eye(4, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[math.cos(2), -math.sin(2)], [math.sin(2), math.cos(2)]])
    turn[:3, 3] = torch.tensor([500.0, -300, 2])
    drive = [torch.eye(4, dtype=torch.float64) for _ in sequence]
    for t, pose in enumerate(drive):
        pose[0, 3] = 0.5 * t
    one, two = follow(tracker, sequence, drive), follow(tracker, sequence, [turn @ pose for pose in drive])
    assert [tracks.id.tolist() for tracks in one] == [tracks.id.tolist() for tracks in two]


def test_crossing_cars_keep_their_ids_h13() -> None:
    sequence = [boxes([(20 + t, 0), (32, -12 + t)]) for t in range(24)]
    out = follow(small(affinity="geometric"), sequence)
    ids = [dict(zip(map(tuple, tracks.boxes.center[:, :2].int().tolist()), tracks.id.tolist())) for tracks in out]
    apart = [frame for t, frame in enumerate(ids) if t != 12]
    assert all(set(frame.values()) == {1, 2} for frame in apart)
    assert all(frame[20 + t, 0] == ids[0][20, 0] for t, frame in enumerate(ids) if t != 12)


def test_memory_of_five_frames_h14() -> None:
    """Similarities .8 .9 .9 .7 .9 add up to 4.2 or average .84; a sixth frame does not count."""
    values = [0.8, 0.9, 0.9, 0.7, 0.9]
    wide = [torch.tensor([[math.log(v / (1 - v)) / 2, -50], [-50, 50]]) for v in values]
    tracker, state, seen = small(), None, {}

    def keep(score: np.ndarray, lost: np.ndarray) -> np.ndarray:
        seen["score"] = score
        return assign(score, lost)

    import lidarfw_time3d.time3d as module

    original, module.assign = module.assign, keep
    try:
        for similarity in ("sum", "mean", "last"):
            tracker.similarity = similarity
            state = tracker.start()
            step(tracker, state, 0, boxes([(10, 0)]))
            slots = state.memory[0]
            state.memory = [Slots(slots.boxes, slots.pose, 0.0, slots.track) for _ in values]
            state.time = 0.1
            tables = []
            for table, v in zip(wide, values):
                table = torch.tensor([[0.0, -100], [-100, 0]])
                table[0, 0] = -100 + 100  # row and column softmax of this entry are both sqrt(v)
                other = math.log(1 / math.sqrt(v) - 1)
                table[0, 1] = table[1, 0] = other
                tables.append(table)
            tracker._assign(state, boxes([(10, 0)]), tables)
            expected = {"sum": 4.2, "mean": 0.84, "last": 0.9}[similarity]
            assert float(seen["score"][0, 0]) == pytest.approx(expected, abs=1e-5)
    finally:
        module.assign = original
    tracker.similarity = "sum"
    state = tracker.start()
    for index in range(9):
        step(tracker, state, index, boxes([(10, 0)]))
    assert len(state.memory) == 5


def test_lidar_boxes_need_no_picture_h15() -> None:
    torch.manual_seed(0)
    cues = CueEmbedding(2, 32, 8).eval()
    table, label, score = torch.rand(1, 3, 7) + 1, torch.tensor([[0, 1, 0]]), torch.rand(1, 3)
    assert cues(table, label, score, None, None).shape == (1, 3, 32)
    assert not torch.equal(cues(table, label, score, torch.rand(1, 3, 4), None), cues(table, label, score, None, None))
    cues.train()
    cues.dropout = 1.0  # every optional cue dropped: the same as absent
    dropped = cues(table, label, score, torch.rand(1, 3, 4), torch.rand(1, 3, 8))
    torch.testing.assert_close(dropped, cues.eval()(table, label, score, None, None))


def test_heading_shows_in_the_embedding() -> None:
    torch.manual_seed(0)
    cues = CueEmbedding(2, 32, 0).eval()
    there = torch.tensor([[[10.0, 0, 0, 4, 2, 1.5, 0.3]]])
    back = there + torch.tensor([0.0] * 6 + [math.pi])
    label, score = torch.tensor([[0]]), torch.tensor([[0.5]])
    assert (cues(there, label, score, None, None) - cues(back, label, score, None, None)).abs().max() > 1e-3


def test_saved_in_the_middle_it_goes_on_bit_for_bit_h16() -> None:
    tracker = small()
    sequence = [boxes([(10 + t, 0), (30 - t, 6)]) for t in range(10)]
    whole = follow(tracker, sequence)
    state = tracker.start()
    for index in range(4):
        step(tracker, state, index, sequence[index])
    classes = {"state": type(state), "slots": Slots}
    file = io.BytesIO()
    torch.save(to_plain(state, classes), file)
    state = from_plain(torch.load(io.BytesIO(file.getvalue()), weights_only=True), classes)
    for index in range(4, 10):
        found = step(tracker, state, index, sequence[index])
        assert torch.equal(found.id, whole[index].id)
        assert torch.equal(found.boxes.tensor, whole[index].boxes.tensor)


def test_nothing_at_all() -> None:
    """Section 12: no box now, before, or ever; all new, all lost."""
    for affinity in ("learned", "geometric"):
        tracker = small(affinity=affinity)
        counts = [len(tracks.id) for tracks in follow(tracker, [boxes([]), boxes([]), boxes([(10, 0)]), boxes([])])]
        assert counts == [0, 0, 1, 0]
        ids = [tracks.id.tolist() for tracks in follow(tracker, [boxes([(10, 0)]), boxes([(70, 30)])])]
        assert ids == [[1], [2]]
    assert SpatialFlow(32, 1, 4)(torch.zeros(2, 0, 32), torch.zeros(2, 0, dtype=torch.bool)).shape == (2, 0, 32)


def test_time_must_grow() -> None:
    tracker = small()
    state = tracker.start()
    step(tracker, state, 3, boxes([(10, 0)]))
    with pytest.raises(DataError, match="order of time"):
        step(tracker, state, 3, boxes([(10, 0)]))


def test_more_boxes_than_places_keep_the_best() -> None:
    found = boxes([(10 + 5 * k, 0) for k in range(6)]).replace(score=torch.linspace(0.4, 0.9, 6))
    out = follow(small(slots=4), [found, found])
    assert len(out[-1].id) == 4
    assert out[-1].boxes.score.min() > 0.55


def test_unknown_words_are_refused() -> None:
    for options in (
        {"affinity": "psychic"}, {"similarity": "median"}, {"affinity": "appearance"}, {"cues": ("smell",)},
        {"geometry": "flat"}, {"spatial_flow": "none"}, {"attributes": True, "affinity": "geometric"},
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=next(iter(options))):
            small(**options)
    with pytest.raises(ConfigError, match="single"):
        AssociationLoss(SPEC, none="double")


def test_refinement_names_its_numbers() -> None:
    change = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]])  # x, y, z, w, h, l
    found = refine(torch.tensor([[1.0, 2, 3, 4, 2, 1.5, 0.7]]), change)
    torch.testing.assert_close(found, torch.tensor([[1.1, 2.2, 3.3, 4.6, 2.4, 2.0, 0.7]]))


def _batch(tracker: Time3D, shift: float = 0.0) -> tuple[Time3DOutput, Targets]:
    """Two frames of two cars that drive on, one of them gone in the second, where another is new."""
    truth = [boxes([(10, 0), (20, 5)]), boxes([(11, 0), (40, -5)])]
    seen = Boxes.cat([b.replace(center=b.center + shift) for b in truth], as_batch=True)
    known = Boxes.cat(truth, as_batch=True)
    meta = [FrameMeta(str(t), "s", t, t / 10) for t in range(2)]
    output = tracker(seen, meta)
    return output, Targets(boxes=known, tracks=Tracks(known, torch.tensor([5, 6, 5, 7])))


def test_training_learns_who_is_who_and_how_boxes_move() -> None:
    torch.manual_seed(0)
    tracker = Time3D(SPEC, width=32, layers=1, heads=4).train()
    losses = torch.nn.ModuleList([AssociationLoss(SPEC), TemporalConsistencyLoss(SPEC)])
    optimizer = torch.optim.AdamW(tracker.parameters(), 3e-3)
    history = []
    for _ in range(120):
        output, targets = _batch(tracker, 0.3)
        terms = {name: value for loss in losses for name, value in loss(output, targets).items()}
        history.append({name: float(value.detach()) for name, value in terms.items()})
        optimizer.zero_grad()
        torch.stack(list(terms.values())).sum().backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    assert set(history[0]) == {"association", "consistency", "anchor", "velocity", "attribute"}
    assert history[-1]["association"] < 0.3 * history[0]["association"]
    assert history[-1]["anchor"] < 0.7 * history[0]["anchor"]
    assert history[-1]["velocity"] < 0.5 * history[0]["velocity"]
    with torch.no_grad():
        table = unimodal(_batch(tracker.eval(), 0.3)[0].logits)[0]
    assert table.argmax(1)[:2].tolist() == [0, 2]  # the car that drove on; the one that is lost
    assert table.argmax(0)[:2].tolist() == [0, 2]  # the car that drove on; the newborn


@pytest.mark.parametrize(
    "options",
    [{"cues": ("appearance",)}, {"cues": ("box2d", "category")}, {"geometry": "raw"}, {"geometry": "unordered"},
     {"spatial_flow": "mlp", "temporal_flow": "mlp"}, {"attributes": True, "refine": True}],
    ids=str,
)  # fmt: skip
def test_every_cue_and_flow_can_be_left_out(options: dict[str, Any]) -> None:
    """Trained for a step and run on boxes with and without appearance and rectangle."""
    torch.manual_seed(0)
    tracker = Time3D(Spec(Boxes, 8, classes=SPEC.classes), width=32, layers=1, heads=4, **options)
    frames = [found.replace(embedding=torch.randn(2, 8), box2d=torch.rand(2, 4) * 100)
              for found in (boxes([(10, 0), (20, 5)]), boxes([(11, 0), (40, -5)]))]  # fmt: skip
    for sequence in (frames, [boxes([(10, 0), (20, 5)]), boxes([(11, 0), (40, -5)])]):
        output = tracker.train()(
            Boxes.cat(sequence, as_batch=True), [FrameMeta(str(t), "s", t, t / 10) for t in (0, 1)]
        )
        assert output.logits.isfinite().all()
        assert [len(tracks.id) for tracks in follow(tracker.eval(), sequence)] == [2, 2]


def test_motion_attributes_are_learned() -> None:
    """From `Boxes.moving` of the labels: the one that drives on, and the parked ones."""
    torch.manual_seed(0)
    tracker, loss = Time3D(SPEC, width=32, layers=1, heads=4).train(), TemporalConsistencyLoss(SPEC, attribute=1.0)
    truth = [boxes([(10 + t, 0), (20, 5)]) for t in range(3)]
    known = Boxes.cat(truth, as_batch=True).replace(moving=torch.tensor([1, 0] * 3, dtype=torch.int8))
    targets = Targets(boxes=known, tracks=Tracks(known, torch.tensor([5, 6] * 3)))
    meta = [FrameMeta(str(t), "s", t, t / 10) for t in range(3)]
    optimizer = torch.optim.AdamW(tracker.parameters(), 3e-3)
    values = []
    for _ in range(60):
        term = loss(tracker(known, meta), targets)["attribute"]
        values.append(float(term.detach()))
        optimizer.zero_grad()
        term.backward()
        optimizer.step()
    assert values[0] > 0.8
    assert values[-1] < 0.2
    unknown = known.replace(moving=torch.full((6,), -1, dtype=torch.int8))
    assert float(loss(tracker(known, meta), Targets(tracks=Tracks(unknown, targets.tracks.id)))["attribute"]) == 0


def test_boxes_of_pictures_are_matched_by_their_rectangles() -> None:
    """Depth from a picture may be metres off: a box 6 m too far still stands for its object."""
    truth = boxes([(20, 0)]).replace(box2d=torch.tensor([[100.0, 50, 160, 90]]))
    far = boxes([(26, 0)]).replace(box2d=torch.tensor([[102.0, 51, 161, 91]]))
    targets = Targets(tracks=Tracks(truth, torch.tensor([5])))
    assert identities(far, targets).tolist() == [5]
    assert identities(far.replace(box2d=None), targets).tolist() == [-1]
    assert identities(far.replace(box2d=far.box2d + 200), targets).tolist() == [-1]


def test_of_a_cascade_the_last_stage_is_learned_from() -> None:
    found = [boxes([(10, 0), (10.1, 0), (20, 5), (20.1, 5)]).replace(stage=torch.tensor([0, 1, 0, 1]))] * 2
    output = small().train()(Boxes.cat(found, as_batch=True), [FrameMeta(str(t), "s", t, t / 10) for t in range(2)])
    assert output.boxes.center[:, 0].tolist() == pytest.approx([10.1, 20.1] * 2)
    assert output.logits.shape == (1, 3, 3)


def test_losses_without_pairs_labels_or_boxes_are_zero() -> None:
    tracker = small().train()
    output, targets = _batch(tracker)
    for given, known in (
        (output, Targets()),
        (tracker(boxes([(10, 0)]), [FrameMeta("0", "s", 0, 0.0)]), targets),
        (tracker(Boxes.empty(2), [FrameMeta(str(t), "s", t, t / 10) for t in range(2)]), Targets()),
    ):
        for loss in (AssociationLoss(SPEC), TemporalConsistencyLoss(SPEC)):
            for name, value in loss(given, known).items():
                assert float(value.detach()) == 0, name
                assert value.requires_grad


def test_moving_is_told_from_standing() -> None:
    out = follow(small(affinity="geometric"), [boxes([(10 + t, 0), (40, 8)]) for t in range(8)])
    assert out[-1].moving is not None
    moving = dict(zip(out[-1].boxes.center[:, 1].int().tolist(), out[-1].moving.tolist()))
    assert moving[0] > 2
    assert moving[8] < -2


def test_two_boxes_at_one_place_are_two_tracks_and_ties_go_to_the_first() -> None:
    """Section 12: one-to-one, the second starts a track of its own; equal boxes keep their ids frame by frame."""
    twins = boxes([(10, 0), (10, 0)])
    out = follow(small(affinity="geometric"), [boxes([(10, 0)]), twins, twins, twins])
    assert [tracks.id.tolist() for tracks in out] == [[1], [1, 2], [1, 2], [1, 2]]


def test_lost_objects_end_when_no_frame_in_memory_has_them() -> None:
    car = [(10, 0)]
    out = follow(small(affinity="geometric", memory=3), [boxes(car)] * 2 + [boxes([])] * 2 + [boxes(car)])
    assert out[-1].id.tolist() == [1]
    out = follow(small(affinity="geometric", memory=3), [boxes(car)] * 2 + [boxes([])] * 3 + [boxes(car)])
    assert out[-1].id.tolist() == [2]


def test_the_state_stays_small_over_many_frames() -> None:
    """Objects come and go: only five frames and the tracks in them are kept."""
    tracker, rng = small(affinity="geometric"), np.random.default_rng(0)
    state, sizes = tracker.start(), []
    for index in range(600):
        step(
            tracker, state, index, boxes([(10 + 5 * k + index % 150, 3.0 * k) for k in range(3) if rng.random() < 0.8])
        )
        sizes.append(len(state.id))
    assert state.next_id > 10
    assert max(sizes) < 8
    assert len(state.memory) == 5
