"""Metric `mot3d`, and the functions of `lidarfw.mot`."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarfw.components.datasets.kitti_tracking import KittiTrackingDataset
from lidarfw.components.metrics.mot3d import Mot3D
from lidarfw.errors import ConfigError, DataError
from lidarfw.mot import best_pairs, recall_thresholds, trajectory_figures
from lidarfw.types import Boxes, FrameMeta, Spec, Targets, Tracks, collate
from lidarfw.types.frame import Frame

pytestmark = pytest.mark.filterwarnings("ignore:The ``compute`` method of metric Mot3D was called before")
SPEC = Spec(Tracks, classes=("Car", "Pedestrian"))
Step = tuple[Tracks, Targets]


def boxes_of(x: list[float], score: list[float] | None = None, label: int = 0) -> Boxes:
    """Boxes 4 x 2 x 1.5 m along the x axis: shifted by d they have IoU (4 - d) / (4 + d)."""
    tensor = torch.tensor([[v, 0, 0, 4, 2, 1.5, 0] for v in x], dtype=torch.float64).view(-1, 7)
    scores = torch.ones(len(x)) if score is None else torch.tensor(score)
    return Boxes.from_tensor(tensor, torch.full((len(x),), label), scores.double())


def tracks_of(objects: dict[int, float], score: float = 1.0) -> Tracks:
    """Tracks by id: their x."""
    return Tracks(boxes_of(list(objects.values()), [score] * len(objects)), torch.tensor(list(objects)).long())


def step(found: dict[int, float], known: dict[int, float], ignored: Boxes | None = None) -> Step:
    return tracks_of(found), Targets(tracks=tracks_of(known), ignored=ignored)


def figures(*steps: Step, sequence: str = "0", **options: object) -> dict[str, float]:
    metric = Mot3D(SPEC, **options)
    for index, (tracks, targets) in enumerate(steps):
        metric.update(tracks, targets, [FrameMeta(f"{index}", sequence, index)])
    return metric.compute()


def one_trajectory(track: list[int], ignored: list[int] | None = None) -> tuple[float, float, float, float]:
    out = np.zeros(len(track), dtype=bool)
    out[ignored or []] = True
    found = trajectory_figures(np.zeros(len(track), dtype=np.int64), out, np.array(track))
    return found["ids"], found["frag"], found["mt"], found["ml"]


@pytest.mark.parametrize(
    ("track", "ignored", "expected"),
    [
        ([1, 1, 1, 1, 1], [], (0, 0, 1, 0)),
        ([1, 1, 2, 2, 2], [], (1, 1, 1, 0)),  # taken over: a switch and a fragmentation
        ([1, -1, 1, 1, 1], [], (0, 1, 0, 0)),  # a gap; 0.8 is not more than 0.8
        ([1, -1, 2, 2, 2], [], (0, 1, 0, 0)),  # another track after a gap is no switch
        ([1, -1, 1, -1, 1], [], (0, 1, 0, 0)),  # a lone frame counts only at the end
        ([-1, -1, -1, -1, 1], [], (0, 1, 0, 0)),  # first contact in the last frame
        ([-1, 1, 1, 1, 1], [], (0, 0, 0, 0)),  # a late start is none
        ([1, 1, 2, 2, 2], [2], (0, 0, 1, 0)),  # an ignored frame forgets the track before
        ([1, 2, 2, 2, 2], [0], (1, 1, 1, 0)),  # except the first one
        ([-1, -1, -1, -1, -1], [], (0, 0, 0, 1)),
        ([1, 1, 2, -1, 2], [0, 1, 2, 3, 4], (0, 0, 0, 0)),  # ignored all along
        ([], [], (0, 0, 0, 0)),
    ],
)
def test_switches_and_fragmentations(
    track: list[int], ignored: list[int], expected: tuple[float, float, float, float]
) -> None:
    assert one_trajectory(track, ignored) == expected


def test_trajectories_do_not_touch_each_other() -> None:
    """The last track of one trajectory is not the one before the first of the next."""
    tracks = [[1, 1, 2], [2, 3, 3], [-1, 3, 3], [4, 4, -1]]
    alone = np.array([one_trajectory(track) for track in tracks])
    count = len(tracks)
    found = trajectory_figures(np.repeat(np.arange(count), 3), np.zeros(12, dtype=bool), np.concatenate(tracks))
    assert [found["ids"], found["frag"]] == alone[:, :2].sum(0).tolist()
    assert [found["mt"], found["ml"]] == alone[:, 2:].mean(0).tolist()


def test_best_pairs_beat_greedy() -> None:
    """(0, 0) is the best single pair; (0, 1) and (1, 0) are the best set. Node 2 stands alone."""
    left, right = np.array([0, 0, 1, 2]), np.array([0, 1, 0, 2])
    assert sorted(best_pairs(left, right, np.array([0.9, 0.8, 0.7, 0.1])).tolist()) == [1, 2, 3]
    assert best_pairs(left[:0], right[:0], np.zeros(0)).tolist() == []


def test_recall_thresholds() -> None:
    points = recall_thresholds(np.linspace(0.8, 0.1, 8), 8)
    assert [score for score, _ in points] == pytest.approx([0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1])
    assert [recall for _, recall in points] == pytest.approx([0.025, 0.05, 0.075, 0.1, 0.125, 0.15, 0.175])
    dense = recall_thresholds(np.linspace(1, 0, 400), 400)
    assert len(dense) == 40
    assert dense[-1][1] == pytest.approx(1)
    assert recall_thresholds(np.zeros(0), 5) == []


def test_clear_mot_golden() -> None:
    """Two cars over 4 frames, one false box, one miss, one switch: MOTA 1 - (1 + 1 + 1) / 8."""
    known = {1: 0.0, 2: 20.0}
    found = figures(
        step({5: 0.0, 6: 20.0}, known),
        step({5: 1.0, 6: 20.0, 9: 50.0}, known),  # IoU 0.6
        step({5: 0.0}, known),
        step({7: 0.0, 6: 20.0}, known),
    )
    assert found["car_mota"] == pytest.approx(1 - 3 / 8)
    assert found["car_motp"] == pytest.approx((6 + 0.6) / 7)
    assert [found[f"car_{key}"] for key in ("tp", "fp", "fn", "ids", "frag")] == [7, 1, 1, 1, 2]
    assert (found["car_recall"], found["car_precision"]) == (7 / 8, 7 / 8)
    assert (found["car_mt"], found["car_ml"]) == (0.5, 0)  # 3 of 4 frames are not more than 0.8
    assert not any(key.startswith("pedestrian") for key in found)
    assert found["mean_mota"] == found["car_mota"]


def test_idf1_and_hota_golden() -> None:
    """One car over 4 frames, perfectly placed, under two ids of two frames each.

    IDF1 keeps one of them: 2 * 2 / (4 + 4). HOTA: DetA 1; each true positive has A = 2 / (4 + 2 - 2) = 1/2.
    """
    found = figures(*[step({track: 0.0}, {1: 0.0}) for track in (5, 5, 6, 6)])
    assert (found["car_idf1"], found["car_idp"], found["car_idr"]) == (0.5, 0.5, 0.5)
    assert (found["car_deta"], found["car_assa"], found["car_loca"]) == (1, 0.5, 1)
    assert found["car_hota"] == pytest.approx(0.5**0.5)
    # IoU 3.1 / 4.9 reaches 12 of the 19 thresholds
    found = figures(*[step({5: 0.9}, {1: 0.0}) for _ in range(4)])
    assert found["car_hota"] == pytest.approx(12 / 19)
    assert found["car_idf1"] == 1


def test_averages_of_perfect_tracks() -> None:
    """41 frames of one object fill all 40 recall points: sAMOTA 1 where every point reaches its recall."""
    steps = [(tracks_of({5: 0.0}, score=index / 64), step({}, {1: 0.0})[1]) for index in range(41)]
    found = figures(*steps)
    # one track is one score: each threshold keeps all of it
    assert (found["car_samota"], found["car_amota"], found["car_amotp"]) == (1, 1, 1)
    half = figures(*steps[:20], *[(tracks_of({}), targets) for _, targets in steps[20:40]])
    # 20 matches of 40 objects: points 1/40 ... 19/40 at MOTA 0.5, each of which no more can be asked
    assert half["car_samota"] == pytest.approx(19 / 40)
    assert half["car_amota"] == pytest.approx(19 / 40 * 0.5)


def test_figures_are_of_the_best_threshold() -> None:
    """A false track of low score costs nothing but where all tracks count."""
    tracks = Tracks(boxes_of([0, 40], [0.9, 0.1]), torch.tensor([5, 6]))
    found = figures(*[(tracks, step({}, {1: 0.0})[1])] * 4, rules="clean")
    assert (found["car_mota"], found["car_idf1"], found["car_hota"]) == (1, 1, 1)
    assert found["car_idf1_all"] == pytest.approx(2 * 4 / (4 + 8))
    assert found["car_hota_all"] == pytest.approx(0.5**0.5)


def test_overlap_threshold_by_class() -> None:
    moved = [step({5: 1.0}, {1: 0.0})] * 3
    assert figures(*moved, iou={"Car": 0.59})["car_recall"] == 1
    assert figures(*moved, iou={"Car": 0.61})["car_recall"] == 0
    with pytest.raises(ConfigError, match="iou names the class 'Van'"):
        Mot3D(SPEC, iou={"Van": 0.5})
    with pytest.raises(ConfigError, match="no rules 'ab3dmot'"):
        Mot3D(SPEC, rules="ab3dmot")


def test_as_many_pairs_as_possible() -> None:
    """The box between two objects goes to the one that is left, though the other is nearer."""
    found = figures(*[step({5: 1.0, 6: 1.9}, {1: 0.0, 2: 2.6})] * 3)
    assert found["car_tp"] == 6


def test_what_is_ignored() -> None:
    van, region = boxes_of([40.0]), boxes_of([0.0], label=-1)
    region.size[:] = 0
    ignored = Boxes.cat([b.replace(box2d=torch.tensor([[100.0, 100, 200, 200]])) for b in (van, region)])
    tracks = tracks_of({1: 0.0, 2: 40.0, 3: 60.0, 4: 80.0, 5: 90.0})
    rectangles = [[0, 0, 90, 90], [0, 0, 90, 90], [0, 0, 90, 25], [110, 110, 150, 190], [150, 110, 290, 190]]
    low = tracks.replace(boxes=tracks.boxes.replace(box2d=torch.tensor(rectangles).double()))
    found = figures((low, Targets(tracks=tracks_of({1: 0.0}), ignored=ignored)))
    # the van is a match that is not asked for, the third box is low, the fourth lies in DontCare, the fifth does not
    assert [found[f"car_{key}"] for key in ("tp", "fp", "fn")] == [2, 1, 0]
    assert found["car_idf1"] == pytest.approx(2 / 3)
    found = figures((tracks, Targets(tracks=tracks_of({1: 0.0}))))
    assert [found[f"car_{key}"] for key in ("tp", "fp")] == [1, 4]


def test_objects_beyond_the_limits_are_not_asked_for() -> None:
    known = tracks_of({1: 0.0, 2: 20.0, 3: 40.0})
    boxes = known.boxes.replace(occlusion=torch.tensor([2, 3, 0]), truncation=torch.tensor([0, 0, 0.1]))
    found = figures((tracks_of({1: 0.0}), Targets(tracks=known.replace(boxes=boxes))))
    assert (found["car_fn"], found["car_mota"]) == (0, 1)


def test_neutral_pedestrians_are_known_to_the_clean_rules_only() -> None:
    tracks = Tracks(boxes_of([0, 20], label=1), torch.tensor([1, 2]))
    targets = Targets(tracks=Tracks(boxes_of([0], label=1), torch.tensor([1])))
    targets.ignored = boxes_of([20], label=1)
    assert figures((tracks, targets), rules="clean")["pedestrian_fp"] == 0
    assert figures((tracks, targets), rules="devkit")["pedestrian_fp"] == 1


@pytest.mark.parametrize("rules", ["devkit", "clean"])
def test_nothing_is_finite(rules: str) -> None:
    zero = dict.fromkeys([f"mean_{key}" for key in ("samota", "amota", "amotp", "mota", "hota", "idf1")], 0.0)
    assert figures(rules=rules) == zero
    assert figures((tracks_of({1: 0.0}), Targets()), rules=rules) == zero
    assert figures(step({1: 0.0}, {}), rules=rules) == zero
    found = figures(step({}, {1: 0.0}), rules=rules)
    assert (found["car_mota"], found["car_hota"], found["car_ml"], found["mean_samota"]) == (0, 0, 1, 0)


def test_an_id_occurs_once_in_a_frame() -> None:
    twice = Tracks(boxes_of([0, 20]), torch.tensor([3, 3]))
    with pytest.raises(DataError, match="frame 0: an id occurs twice in the tracks"):
        figures((twice, Targets(tracks=tracks_of({1: 0.0}))))
    with pytest.raises(DataError, match="twice in the labels"):
        figures((tracks_of({1: 0.0}), Targets(tracks=twice)))


def noisy_sequence(seed: int, frames: int = 40) -> list[Step]:
    """Two classes that drive along x, with noise, gaps, swapped ids and false boxes; a fifth is occluded."""
    random = np.random.RandomState(seed)  # a stream that numpy promises never to change
    count, steps = 8, []
    start, speed = random.uniform(0, 60, count), random.uniform(-1, 1, count)
    shift = np.zeros(count, dtype=int)
    for index in range(frames):
        x, alive = start + speed * index, random.uniform(size=count) < 0.9
        occlusion, place = np.where(random.uniform(size=count) < 0.2, 3, 0), x + random.normal(0, 0.6, count)
        shift += 100 * (random.uniform(size=count) < 0.03)
        found = random.uniform(size=count) < 0.8
        score = random.uniform(size=count + 2) * 0.5 + np.append(np.arange(count) / 16, [0, 0.1])
        false = random.uniform(0, 60, 2)
        boxes = boxes_of([*place[found], *false], [*score[:count][found], *score[count:]])
        ids = np.append((np.arange(count) + shift)[found], [901 + index // 10, 951])
        label = np.append((np.arange(count) % 2)[found], [0, 1])
        truth = boxes_of(x[alive].tolist()).replace(
            label=torch.from_numpy((np.arange(count) % 2)[alive]), occlusion=torch.from_numpy(occlusion[alive])
        )
        known = Tracks(truth, torch.from_numpy(np.flatnonzero(alive)))
        steps.append(
            (Tracks(boxes.replace(label=torch.from_numpy(label)), torch.from_numpy(ids)), Targets(tracks=known))
        )
    return steps


KEYS = ("samota", "amota", "amotp", "mota", "motp", "ids", "frag", "mt", "ml", "hota", "idf1")


@pytest.mark.parametrize(
    ("seed", "rules", "name", "expected"),
    [
        (0, "devkit", "car", (0.5334633362, 0.1997727273, 0.6264740579, 0.4181818182, 0.7822480116, 4, 14, 0, 0,
                              0.3636715764, 0.4859813084)),
        (0, "devkit", "pedestrian", (0.6388352642, 0.2463362069, 0.7084824771, 0.5344827586, 0.8227760043, 6, 9, 0.25,
                                     0.25, 0.4294821851, 0.5638297872)),
        (0, "clean", "car", (0.609329696, 0.2343181818, 0.6275681635, 0.4545454545, 0.7753222752, 3, 10, 0, 0.25,
                             0.3288673927, 0.4581005587)),
        (0, "clean", "pedestrian", (0.692083528, 0.280387931, 0.7056597467, 0.5344827586, 0.8227760043, 6, 9, 0.25,
                                    0.25, 0.4294821851, 0.5638297872)),
        (1, "devkit", "car", (0.5177981613, 0.2513274336, 0.567414698, 0.4601769912, 0.798592932, 8, 13, 0.75, 0.25,
                              0.3931211477, 0.5185185185)),
        (1, "devkit", "pedestrian", (0.6157451986, 0.2325892857, 0.6783074867, 0.4553571429, 0.8043292207, 4, 8, 0,
                                     0.25, 0.4016961591, 0.5513513514)),
        (1, "clean", "car", (0.6949859685, 0.2862831858, 0.7138546815, 0.4601769912, 0.798592932, 8, 13, 0.75, 0.25,
                             0.3931211477, 0.5185185185)),
        (1, "clean", "pedestrian", (0.6363390194, 0.240625, 0.6770748773, 0.4553571429, 0.8043292207, 4, 8, 0, 0.25,
                                    0.4016961591, 0.5513513514)),
    ],
)  # fmt: skip
def test_equals_an_independent_evaluator(seed: int, rules: str, name: str, expected: tuple[float, ...]) -> None:
    """Golden figures of a separate program that reads KITTI files; with its rounding of scores under `devkit`."""
    found = figures(*noisy_sequence(seed), rules=rules)
    assert [found[f"{name}_{key}"] for key in KEYS] == pytest.approx(expected, abs=1e-8)


def test_a_batch_counts_as_its_frames_in_any_order() -> None:
    steps = noisy_sequence(0, 12)
    batches = Mot3D(SPEC)
    for rows in ([6, 7, 8, 9, 10, 11], [0, 1, 2, 3, 4, 5]):
        frames = [
            Frame({"tracks": steps[row][0]}, Targets(tracks=steps[row][1].tracks), FrameMeta("", "0", row))
            for row in rows
        ]
        batch = collate(frames)
        known = Tracks(batch.targets.tracks.boxes, batch.targets.tracks.id)  # type: ignore[union-attr]
        batches.update(batch.inputs["tracks"], Targets(tracks=known), batch.meta)
    assert batches.compute() == pytest.approx(figures(*steps))


def test_sequences_do_not_share_identities() -> None:
    steps = noisy_sequence(1, 10)
    metric = Mot3D(SPEC)
    for name in ("a", "b"):
        for index, (tracks, targets) in enumerate(steps):
            metric.update(tracks, targets, [FrameMeta("", name, index)])
    one, two = figures(*steps), metric.compute()
    assert two["car_tp"] == 2 * one["car_tp"]
    assert two["car_ids"] == 2 * one["car_ids"]
    assert two["car_hota_all"] == pytest.approx(one["car_hota_all"])


def test_reset_and_pickle() -> None:
    steps, metric = noisy_sequence(0, 8), Mot3D(SPEC)
    for _ in range(2):
        for index, (tracks, targets) in enumerate(steps):
            metric.update(tracks, targets, [FrameMeta("", "0", index)])
        assert pickle.loads(pickle.dumps(metric)).compute() == metric.compute()
        assert metric.compute() == figures(*steps)
        metric.reset()
    assert metric.compute()["mean_samota"] == 0.0


def test_a_process_without_frames_takes_part_in_the_exchange() -> None:
    busy, idle = Mot3D(SPEC), Mot3D(SPEC)
    for index, (tracks, targets) in enumerate(noisy_sequence(0, 6)):
        busy.update(tracks, targets, [FrameMeta("", "0", index)])
    names = ("objects", "boxes", "pairs", "counts")
    states = [[torch.cat(getattr(metric, name)) for name in names] for metric in (idle, busy)]
    for metric in (busy, idle):
        gathered: list[torch.Tensor] = []

        def gather(tensor: torch.Tensor, group: object, gathered: list[torch.Tensor] = gathered) -> list[torch.Tensor]:
            gathered.append(tensor)
            return [state[len(gathered) - 1] for state in states]

        metric.dist_sync_fn, metric.distributed_available_fn = gather, lambda: True
        assert metric.compute() == pytest.approx(figures(*noisy_sequence(0, 6)))
        assert len(gathered) == len(names)


def test_real_labels_as_tracks(real_data: Callable[[str], Path]) -> None:
    """Labels of a real drive, in the LiDAR frame, with its cameras: perfect, and lost where they are moved."""
    dataset = KittiTrackingDataset(
        root=str(real_data("kitti_tracking")), split="0000", poses="", classes=("Car", "Cyclist")
    )
    spec = Spec(Tracks, classes=("Car", "Cyclist"))
    right, wrong = Mot3D(spec), Mot3D(spec)
    for number in range(0, len(dataset), 4):
        frame = dataset[number]
        known = frame.targets.tracks
        assert known is not None
        aside = known.boxes.replace(center=known.boxes.center + torch.tensor([0, 0, 3.0]))
        right.update(known, frame.targets, [frame.meta])
        wrong.update(Tracks(aside, known.id), frame.targets, [frame.meta])
    found = right.compute()
    names = [name for name in ("car", "cyclist") if f"{name}_mota" in found]
    assert names
    for name in names:
        assert [found[f"{name}_{key}"] for key in ("mota", "idf1", "hota", "fp", "fn")] == pytest.approx(
            [1, 1, 1, 0, 0]
        )
    assert wrong.compute()["mean_mota"] <= 0
