"""Metric `nuscenes_tracking`."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch

from lidarfw.components.metrics.nuscenes_tracking import NuscenesTracking, score_thresholds
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import Boxes, FrameMeta, Poses, Spec, Targets, Tracks

pytestmark = pytest.mark.filterwarnings("ignore:The ``compute`` method of metric NuscenesTracking was called before")
CLASSES = ("car", "pedestrian")
SPEC = Spec(Tracks, classes=CLASSES)
Step = tuple[Tracks, Targets, FrameMeta]
KEYS = ("amota", "amotp", "mota", "motp", "recall", "ids", "frag", "mt", "ml", "tp", "fp", "fn")


def tracks_of(rows: list[tuple[int, float, float, float]], label: list[int] | None = None) -> Tracks:
    """Rows of id, x, y, score."""
    table = torch.tensor(rows, dtype=torch.float64).view(-1, 4)
    tensor = torch.cat([table[:, 1:3], torch.tensor([[0, 4, 2, 1.5, 0.0]]).double().expand(len(table), 5)], 1)
    labels = torch.zeros(len(rows)).long() if label is None else torch.tensor(label).long()
    return Tracks(Boxes.from_tensor(tensor, labels, table[:, 3]), table[:, 0].long())


def step(index: int, found: dict[int, float], known: dict[int, float], score: float = 0.5) -> Step:
    """Tracks and objects by id: their x."""
    tracks, truth = (tracks_of([(i, x, 0, score) for i, x in part.items()]) for part in (found, known))
    return tracks, Targets(tracks=truth), FrameMeta("", "a", index, index / 2)


def figures(*steps: Step, **options: object) -> dict[str, float]:
    metric = NuscenesTracking(SPEC, **options)
    for tracks, targets, meta in steps:
        metric.update(tracks, targets, [meta])
    return metric.compute()


def test_perfect() -> None:
    found = figures(*[step(i, {7: 10, 8: 20}, {1: 10, 2: 20}) for i in range(5)])
    expected = dict.fromkeys(("amota", "mota", "recall", "mt"), 1) | dict.fromkeys(
        ("amotp", "motp", "ids", "frag", "ml", "fp", "fn"), 0
    )
    assert found == {f"car_{key}": value for key, value in (expected | {"tp": 10}).items()} | {
        key: expected[key] for key in ("amota", "amotp", "mota", "motp", "recall")
    }


def test_recalls_that_are_not_reached() -> None:
    """Half of the objects are found, 0.5 m away: 18 of the 40 recalls lie in 0.1 ... 0.5."""
    found = figures(*[step(i, {7: 10.5}, {1: 10, 2: 30}) for i in range(6)])
    reached = sum(0.1 + 0.9 * k / 39 <= 0.5 + 1e-9 for k in range(40))
    assert found["amota"] == pytest.approx(reached / 40)
    assert found["amotp"] == pytest.approx((reached * 0.5 + (40 - reached) * 2) / 40)
    assert (found["mota"], found["motp"], found["recall"], found["car_ml"]) == pytest.approx((0.5, 0.5, 0.5, 0.5))


def test_false_tracks_and_switches() -> None:
    """Five frames, four matches that are no switch, one switch; one false box in each: MOTAR 0, MOTA 0.

    AMOTA takes false positives over matches that are no switch: 1 - 5/4 is below 0.
    """
    ids = [7, 7, 8, 8, 8]
    found = figures(*[step(i, {track: 10.0, 9: 40.0}, {1: 10}) for i, track in enumerate(ids)])
    assert [found[f"car_{key}"] for key in ("tp", "fp", "fn", "ids", "frag")] == [5, 5, 0, 1, 0]
    assert (found["amota"], found["mota"]) == (0, 0)
    clean = figures(*[step(i, {track: 10.0}, {1: 10}) for i, track in enumerate(ids)])
    assert clean["car_ids"] == 1
    assert clean["mota"] == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("ids", "false", "devkit", "definition", "mota"),
    [([7] * 5 + [8], 1, 0.8, 2 / 3, 0.4), ([7] * 8, 2, 0.75, 0.75, 0.6), ([7] * 4, 5, 0.0, 0.0, 0.0)],
    ids=["a switch", "none", "more false ones than right ones"],
)
def test_motar(ids: list[int], false: int, devkit: float, definition: float, mota: float) -> None:
    """Ten objects in ten frames; the devkit's formula does not see the switch. The same at every recall reached."""
    known = [{1: 10.0} for _ in range(10)]
    found = [{track: 10.0} for track in ids] + [{} for _ in range(10 - len(ids))]
    for frame in range(false):
        found[frame] |= {9: 40.0}
    steps = [step(i, tracks, objects) for i, (tracks, objects) in enumerate(zip(found, known, strict=True))]
    reached = sum(0.1 + 0.9 * k / 39 <= ids.count(7) / 10 + 1e-9 for k in range(40))
    for formula, motar in (("devkit", devkit), ("definition", definition)):
        result = figures(*steps, motar=formula)
        assert result["amota"] == pytest.approx(motar * reached / 40)
        assert result["mota"] == pytest.approx(mota)


def test_an_object_keeps_its_track_while_that_is_near() -> None:
    """Another box comes nearer, but the first is still within 2 m; when it leaves there is a switch."""
    found = figures(
        step(0, {7: 10}, {1: 10}), step(1, {7: 11.5, 8: 10}, {1: 10}), step(2, {7: 12.5, 8: 10}, {1: 10}), max_range={}
    )
    assert (found["car_ids"], found["car_fp"]) == (1, 2)
    assert found["motp"] == pytest.approx(1.5 / 3)


def test_a_track_is_remembered_over_a_gap() -> None:
    """Both tracks are there to the end, so nothing is filled in; the object is missed in between."""
    far = {7: 30.0}
    known = [{1: 10.0}] * 5
    found = figures(
        *[step(i, f, k) for i, (f, k) in enumerate(zip([{7: 10.0}, far, far, far, {7: 10.0}], known, strict=True))]
    )
    assert [found[f"car_{key}"] for key in ("ids", "frag", "fn", "fp")] == [0, 1, 3, 3]
    found = figures(
        *[step(i, f, k) for i, (f, k) in enumerate(zip([{7: 10.0}, {}, {}, {}, {8: 10.0}], known, strict=True))]
    )
    assert [found[f"car_{key}"] for key in ("ids", "frag", "fn", "fp")] == [1, 1, 3, 0]


def test_gaps_are_filled() -> None:
    """Linear in time, for objects and for tracks; the devkit swaps the weights of the two sightings."""
    steps = [step(0, {7: 10}, {1: 10}), step(1, {}, {1: 13}), step(2, {7: 40}, {1: 40})]
    uneven = [(t, g, FrameMeta("", "a", m.index, time)) for (t, g, m), time in zip(steps, (0, 0.5, 5), strict=True)]
    assert [figures(*uneven, rules="clean")[f"car_{key}"] for key in ("tp", "fn", "fp")] == [3, 0, 0]
    assert [figures(*uneven)[f"car_{key}"] for key in ("tp", "fn", "fp")] == [2, 1, 1]  # at 37 instead
    assert [figures(*steps, rules="clean")[f"car_{key}"] for key in ("tp", "fn", "fp")] == [2, 1, 1]  # at 25
    frozen = [(t, g, FrameMeta("", "a", m.index)) for t, g, m in steps]  # no times: by the number of the frame
    assert figures(*frozen) == figures(*steps) == figures(*steps, rules="clean")
    hidden = [step(0, {7: 10}, {1: 10}), step(1, {7: 20}, {}), step(2, {7: 30}, {1: 30})]
    assert [figures(*hidden)[f"car_{key}"] for key in ("tp", "fn", "fp")] == [3, 0, 0]


def test_gaps_are_filled_in_the_map() -> None:
    """The sensor drives 10 m and turns; the object stands. Without poses it would be looked for at the wrong place."""
    steps = []
    for index, (x, yaw) in enumerate([(0.0, 0.0), (10.0, 1.5), (20.0, 0.0)]):
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:2, :2] = torch.tensor([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        matrix[0, 3] = x
        seen = torch.linalg.inv(matrix) @ torch.tensor([15.0, 5, 0, 1]).double()
        known = tracks_of([(1, float(seen[0]), float(seen[1]), 1)])
        found = tracks_of([(7, float(seen[0]), float(seen[1]), 0.5)] if index != 1 else [])
        pose = Poses(matrix[None], torch.tensor([True]), torch.ones(1))
        steps.append((found, Targets(tracks=known, poses=pose), FrameMeta("", "a", index, index / 2)))
    assert figures(*steps)["recall"] == 1
    blind = [(found, Targets(tracks=targets.tracks), meta) for found, targets, meta in steps]
    assert figures(*blind)["recall"] < 1


def test_tracks_are_judged_by_their_mean_score() -> None:
    """The false track has one box of high score, but a low mean; thresholds above that mean drop all of it."""
    steps = []
    for index in range(10):
        found = tracks_of([(7, 10, 0, 0.5), (9, 40, 0, 0.9 if index == 0 else 0.0)])
        steps.append((found, Targets(tracks=tracks_of([(1, 10, 0, 1)])), FrameMeta("", "a", index, index / 2)))
    assert (figures(*steps)["amota"], figures(*steps)["car_fp"]) == (1, 0)


def test_score_thresholds() -> None:
    found = score_thresholds(np.array([0.2, 0.9, 0.5, 0.4]), 5)
    assert found[0] == 0.9  # recall 0.1 lies before the first match
    assert np.isnan(found[-1])
    assert score_thresholds(np.array([0.5, 0.9]), 2)[-1] == 0.5
    assert np.isnan(score_thresholds(np.zeros(0), 3)).all()


def test_range_and_user_errors() -> None:
    far = [step(i, {7: 60}, {1: 60}) for i in range(3)]
    assert figures(*far) == {"amota": 0, "amotp": 2, "mota": 0, "motp": 2, "recall": 0}
    assert figures(*far, max_range={"car": 70})["amota"] == 1
    with pytest.raises(ConfigError, match="max_range names the class 'van'"):
        NuscenesTracking(SPEC, max_range={"van": 1})
    with pytest.raises(ConfigError, match="no rules 'kitti'"):
        NuscenesTracking(SPEC, rules="kitti")
    with pytest.raises(ConfigError, match="no motar 'paper'"):
        NuscenesTracking(SPEC, motar="paper")
    with pytest.raises(DataError, match="an id occurs twice"):
        figures((tracks_of([(1, 0, 0, 1), (1, 5, 0, 1)]), Targets(tracks=tracks_of([])), FrameMeta("")))


def test_nothing_is_finite() -> None:
    nothing = {"amota": 0, "amotp": 2, "mota": 0, "motp": 2, "recall": 0}
    assert figures() == nothing
    assert figures(step(0, {7: 10}, {})) == nothing
    assert figures((tracks_of([]), Targets(), FrameMeta(""))) == nothing
    lost = figures(step(0, {}, {1: 10}), step(1, {7: 40}, {1: 10}))
    assert lost["car_fn"] == 2
    assert {key: lost[key] for key in nothing} == nothing


def noisy_sequences(seed: int, sequences: int = 3, frames: int = 20) -> list[Step]:
    """Objects that drive close to each other, with noise, gaps, swapped ids and false tracks."""
    random = np.random.RandomState(seed)  # a stream that numpy promises never to change
    steps, count = [], 8
    for name in range(sequences):
        start, speed = random.uniform(-12, 12, (count, 2)), random.normal(0, 1.5, (count, 2))
        shift, time, quality = np.zeros(count, dtype=int), 0.0, random.uniform(0.2, 0.8, count)
        for index in range(frames):
            time += random.uniform(0.4, 0.6)
            place = start + speed * time / 2
            shift += 100 * (random.uniform(size=count) < 0.08)
            seen, found = random.uniform(size=(2, count)) < np.array([[0.9], [0.75]])
            guess, score = place + random.normal(0, 0.7, (count, 2)), quality + random.normal(0, 0.1, count)
            known = [(int(i), *place[i].tolist(), 1.0) for i in np.flatnonzero(seen)]
            rows = [(int(i + shift[i]), *guess[i].tolist(), float(score[i])) for i in np.flatnonzero(found)]
            rows += [(9000 + index // 4, *random.uniform(-12, 12, 2).tolist(), float(random.uniform(0.1, 0.6)))]
            label = [i % 2 for i, *_ in known], [i % 100 % 2 if i < 9000 else i % 2 for i, *_ in rows]
            targets = Targets(tracks=tracks_of(known, label[0]))
            steps.append((tracks_of(rows, label[1]), targets, FrameMeta("", f"s{name}", index, time)))
    return steps


@pytest.mark.parametrize(
    ("seed", "rules", "name", "expected"),
    [
        (0, "devkit", "car", (0.7270239127, 1.0260383678, 0.6382978723, 0.8067213905, 0.8085106383, 15, 12, 0.75,
                              0.0833333333, 190, 25, 45)),
        (0, "devkit", "pedestrian", (0.7633608125, 1.0816446654, 0.718487395, 0.8295441941, 0.8277310924, 14, 10,
                                     0.9166666667, 0.0833333333, 197, 12, 41)),
        (1, "devkit", "car", (0.7375906095, 0.9921713409, 0.7280334728, 0.8391404411, 0.9330543933, 9, 4,
                              0.8333333333, 0, 223, 40, 16)),
        (1, "devkit", "pedestrian", (0.7794720614, 1.0198816293, 0.743697479, 0.8072687848, 0.9117647059, 15, 10,
                                     0.9166666667, 0, 217, 25, 21)),
        (0, "clean", "car", (0.73218957, 1.0303845244, 0.6553191489, 0.8147252363, 0.8170212766, 15, 11, 0.8333333333,
                             0.0833333333, 192, 23, 43)),
        (0, "clean", "pedestrian", (0.7906086449, 1.0406608244, 0.7478991597, 0.808084286, 0.8445378151, 14, 6,
                                    0.9166666667, 0.0833333333, 201, 9, 37)),
        (4, "clean", "car", (0.6805180514, 1.0604929673, 0.6244725738, 0.7731926156, 0.8734177215, 17, 16,
                             0.9166666667, 0, 207, 42, 30)),
        (4, "clean", "pedestrian", (0.8286744365, 0.9797376369, 0.7838983051, 0.7711830048, 0.9406779661, 15, 10, 1, 0,
                                    222, 22, 14)),
    ],
)  # fmt: skip
def test_equals_the_devkit(seed: int, rules: str, name: str, expected: tuple[float, ...]) -> None:
    """Golden figures of nuscenes-devkit 1.2.0 with motmetrics 1.4.0; for `clean` with its interpolation set right.

    Here `tp` counts switches too, there it does not.
    """
    found = figures(*noisy_sequences(seed), rules=rules)
    assert [found[f"{name}_{key}"] for key in KEYS] == pytest.approx(expected, abs=1e-9)


def test_order_of_frames_does_not_matter() -> None:
    steps = noisy_sequences(0)
    order = np.random.RandomState(1).permutation(len(steps))
    assert figures(*[steps[i] for i in order]) == pytest.approx(figures(*steps))


def test_sequences_do_not_touch_each_other() -> None:
    steps = noisy_sequences(1, 1)
    again = [(t, g, FrameMeta("", "again", m.index, m.time)) for t, g, m in steps]
    one, two = figures(*steps), figures(*steps, *again)
    assert two["car_tp"] == 2 * one["car_tp"]
    assert (two["amota"], two["amotp"]) == pytest.approx((one["amota"], one["amotp"]), abs=0.05)


def test_reset_and_pickle() -> None:
    steps, metric = noisy_sequences(2, 1), NuscenesTracking(SPEC)
    for _ in range(2):
        for tracks, targets, meta in steps:
            metric.update(tracks, targets, [meta])
        assert pickle.loads(pickle.dumps(metric)).compute() == metric.compute() == figures(*steps)
        metric.reset()
    assert metric.compute()["amota"] == 0
