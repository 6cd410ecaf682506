"""The trackers on made-up objects whose motion is known."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Tracker
from lidarfw.plain import from_plain, to_plain
from lidarfw.types import Boxes, FrameMeta, FrameResult, Poses, Spec, Tracks

from lidarfw_time3d import kalman_confidence
from lidarfw_time3d.ab3dmot import AB3DMOT
from lidarfw_time3d.assignment import gated_hungarian, greedy, hungarian
from lidarfw_time3d.bench import measure
from lidarfw_time3d.confidence import FEATURES, Confidence, log_odds
from lidarfw_time3d.dataset import KittiDetections
from lidarfw_time3d.kalman import Motion, Noise
from lidarfw_time3d.kalman_confidence import KalmanConfidence, KalmanConfidenceState
from lidarfw_time3d.kalman_offline import KalmanOffline, Moment, smooth

CLASSES = ("Car", "Pedestrian", "Cyclist")
SPEC = Spec(Boxes, classes=CLASSES)


def boxes(rows: list[tuple[float, float, float]], score: float = 0.95, label: int = 0) -> Boxes:
    """Cars at x, y, yaw."""
    table = [(x, y, 0.0, 4.0, 1.8, 1.5, yaw) for x, y, yaw in rows]
    tensor = torch.tensor(table, dtype=torch.float64).reshape(-1, 7)
    return Boxes.from_tensor(tensor, torch.full((len(rows),), label), torch.full((len(rows),), score).double())


def follow(tracker: Tracker, sequence: list[Boxes], poses: list[np.ndarray] | None = None) -> list[Tracks]:
    state = tracker.start()
    return list(_steps(tracker, state, sequence, poses, 0))


def _steps(
    tracker: Tracker, state: Any, sequence: list[Boxes], poses: list[np.ndarray] | None, first: int
) -> Iterator[Tracks]:
    for index, found in enumerate(sequence, first):
        frame = FrameResult(FrameMeta(str(index), "s", index, index / 10))
        pose = {} if poses is None else {"pose": known(poses[index])}
        (result,) = tracker.step(state, frame, found, **pose)
        assert result.tracks is not None
        yield result.tracks


def known(matrix: np.ndarray) -> Poses:
    return Poses(torch.from_numpy(matrix)[None], torch.tensor([True]), torch.ones(1))


def make(name: str, **options: Any) -> Tracker:
    return AB3DMOT(SPEC, min_hits=1, **options) if name == "ab3dmot" else KalmanConfidence(SPEC, **options)


TRACKERS = ("ab3dmot", "kalman_confidence")


def test_the_filter_is_the_one_with_matrices() -> None:
    noise = Noise(measured=0.3, place=0.2, shape=0.1, velocity=0.5, first=2.0, first_velocity=7.0)
    rng = np.random.default_rng(0)
    box = rng.normal(size=(1, 7))
    motion = Motion.start(box, noise)
    mean, covariance = np.concatenate([box[0], np.zeros(3)]), np.diag([2.0] * 7 + [7.0] * 3)
    move = np.eye(10)
    move[[0, 1, 2], [7, 8, 9]] = 0.1
    see = np.eye(7, 10)
    process = np.diag([0.2] * 3 + [0.1] * 4 + [0.5] * 3)
    for _ in range(5):
        motion.predict(0.1, 1.0, noise)
        mean, covariance = move @ mean, move @ covariance @ move.T + process
        measured = np.concatenate([mean[:7] + rng.normal(0, 0.1, 7)])[None]
        motion.update(np.array([0]), measured, noise)
        gain = covariance @ see.T @ np.linalg.inv(see @ covariance @ see.T + 0.3 * np.eye(7))
        mean, covariance = mean + gain @ (measured[0] - see @ mean), (np.eye(10) - gain @ see) @ covariance
    turn = np.angle(np.exp(1j * (motion.box[0, 3] - mean[3])))
    assert abs(turn) < 1e-9
    np.testing.assert_allclose(np.delete(motion.box[0], 3), np.delete(mean[:7], 3), atol=1e-9)
    np.testing.assert_allclose(motion.velocity[0], mean[7:], atol=1e-9)


def test_a_reversed_heading_turns_the_track() -> None:
    motion = Motion.start(np.array([[0, 0, 0, 0.1, 4, 2, 1.5]], dtype=float), Noise())
    motion.update(np.array([0]), np.array([[0, 0, 0, 0.1 + math.pi, 4, 2, 1.5]]), Noise())
    assert abs(abs(motion.box[0, 3]) - (math.pi - 0.1)) < 1e-9


def test_assignments() -> None:
    cost = np.array([[0.1, 0.2], [0.15, 9.0]])
    assert sorted(map(tuple, hungarian(cost, 1.0).tolist())) == [(0, 1), (1, 0)]
    assert sorted(map(tuple, gated_hungarian(cost, 1.0).tolist())) == [(0, 1), (1, 0)]
    assert greedy(cost, 1.0).tolist() == [[0, 0]]
    # the first leaves the pair beyond the limit in the assignment and strikes it off, the second never makes it
    far = np.array([[0.5, 1.4], [0.6, 5.0]])
    assert hungarian(far, 1.0).tolist() == [[1, 0]]
    assert len(gated_hungarian(far, 1.0)) == 1
    for match in (hungarian, gated_hungarian, greedy):
        assert match(np.zeros((0, 3)), 1.0).shape == (0, 2)
        assert match(np.full((2, 2), np.inf), 1.0).shape == (0, 2)


@pytest.mark.parametrize("name", TRACKERS)
def test_crossing_cars_keep_their_ids(name: str) -> None:
    """Two cars that cross at right angles, H13."""
    sequence = [boxes([(-10 + t, 0, 0), (2, -12 + t, math.pi / 2)]) for t in range(24)]
    for found in sequence[1:]:
        found.center[:, 0] += 30
    sequence[0].center[:, 0] += 30
    out = follow(make(name), sequence)
    assert all(tracks.id.tolist() == [1, 2] for tracks in out[3:])


@pytest.mark.parametrize("name", TRACKERS)
def test_the_motion_of_the_sensor_does_not_matter(name: str) -> None:
    """Still cars seen from a sensor that drives and turns fast: one id each, at rest in the map, H12."""
    poses, seen = [], []
    world = np.array([[20.0, 5, 0.3], [30, -8, 2.0], [15, -3, -1.0]])
    for t in range(20):
        turn = 0.06 * t
        pose = np.eye(4)
        pose[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
        pose[:2, 3] = (0.6 * t, 0.02 * t * t)
        places = (world[:, :2] - pose[:2, 3]) @ pose[:2, :2]
        poses.append(pose)
        seen.append(boxes([(x, y, yaw - turn) for (x, y), yaw in zip(places.tolist(), world[:, 2].tolist())]))
    out = follow(make(name), seen, poses)
    assert [tracks.id.tolist() for tracks in out[5:]] == [[1, 2, 3]] * 15
    assert out[-1].boxes.velocity is not None
    assert out[-1].boxes.velocity.abs().max() < 0.3
    torch.testing.assert_close(out[-1].boxes.center, seen[-1].center, atol=0.05, rtol=0)
    turned = (out[-1].boxes.yaw - seen[-1].yaw + math.pi) % (2 * math.pi) - math.pi
    assert turned.abs().max() < 0.02


@pytest.mark.parametrize("name", TRACKERS)
def test_nothing_new_nothing_lost_nothing_there(name: str) -> None:
    empty = boxes([])
    assert [len(tracks.id) for tracks in follow(make(name), [empty] * 3)] == [0, 0, 0]
    apart = [boxes([(10, 0, 0)]), boxes([(60, 20, 0)]), empty]
    ids = [set(tracks.id.tolist()) for tracks in follow(make(name), apart)]
    assert ids[0] == {1}
    assert 2 in ids[1]


@pytest.mark.parametrize("name", TRACKERS)
def test_two_detections_at_one_place_are_two_tracks(name: str) -> None:
    out = follow(make(name), [boxes([(10, 0, 0), (10, 0, 0)])] * 2)
    assert len(set(out[-1].id.tolist())) == len(out[-1].id)


@pytest.mark.parametrize("name", TRACKERS)
def test_order_of_detections_does_not_matter(name: str) -> None:
    rows = [(12.0 + 6 * k, 4.0 - 3 * k, 0.1 * k) for k in range(5)]
    sequence = [boxes([(x + 0.5 * t, y, yaw) for x, y, yaw in rows]) for t in range(8)]
    mixed = [found[torch.randperm(5, generator=torch.Generator().manual_seed(t))] if t else found
             for t, found in enumerate(sequence)]  # fmt: skip
    one, two = (follow(make(name), each)[-1] for each in (sequence, mixed))
    assert one.id.tolist() == two.id.tolist()
    torch.testing.assert_close(one.boxes.center, two.boxes.center, atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", TRACKERS)
def test_saved_in_the_middle_it_goes_on_bit_for_bit(name: str) -> None:
    """H16."""
    rng = np.random.default_rng(1)
    sequence = [boxes([(10 + 5 * k + t + rng.normal(0, 0.1), 3 * k, 0.2) for k in range(6) if rng.random() < 0.8])
                for t in range(20)]  # fmt: skip
    tracker = make(name)
    whole = follow(tracker, sequence)
    state = tracker.start()
    list(_steps(tracker, state, sequence[:9], None, 0))
    classes = {"state": type(state), "motion": Motion}
    if isinstance(state, KalmanConfidenceState):
        classes["evidence"] = type(state.evidence)
    file = io.BytesIO()
    torch.save(to_plain(state, classes), file)
    again = from_plain(torch.load(io.BytesIO(file.getvalue()), weights_only=True), classes)
    rest = list(_steps(tracker, again, sequence[9:], None, 9))
    for expected, found in zip(whole[9:], rest, strict=True):
        assert torch.equal(expected.id, found.id)
        assert torch.equal(expected.boxes.tensor, found.boxes.tensor)
        assert torch.equal(expected.boxes.score, found.boxes.score)


def test_ab3dmot_shows_and_ends_tracks_as_the_paper_says() -> None:
    tracker = AB3DMOT(SPEC, min_hits=3, max_age=2)
    seen = [boxes([(10, 0, 0)])] * 5 + [boxes([(10, 0, 0), (40, 0, 0)])] * 3 + [boxes([(10, 0, 0)])] * 3
    out = [tracks.id.tolist() for tracks in follow(tracker, seen)]
    assert out[:5] == [[1]] * 5  # at the start of a sequence at once
    assert out[5:8] == [[1], [1], [1, 2]]  # later with the third detection
    assert out[8:] == [[1, 2], [1], [1]]  # one frame more on its own, then gone


def test_ab3dmot_refuses_what_it_does_not_know() -> None:
    for options, text in (
        ({"classes": {"Lorry": {}}}, "Lorry"),
        ({"classes": {"Car": {"max_agee": 3}}}, "max_agee"),
        ({"measure": "cosine"}, "giou_3d"),
    ):
        with pytest.raises(ConfigError, match=text):
            AB3DMOT(SPEC, **options)  # type: ignore[arg-type]


def test_confidence_grows_with_evidence_and_falls_without() -> None:
    seen = [boxes([(15 + 0.5 * t, 0, 0)], 0.8) for t in range(12)]
    out = follow(KalmanConfidence(SPEC, min_unseen=0.01), seen + [boxes([])] * 6)
    score = [float(tracks.boxes.score[0]) if len(tracks.id) else 0.0 for tracks in out]
    assert score[0] < score[11]
    assert score[11] > 0.8
    assert 0 < score[12] < score[11]  # coasted: moved on, with less confidence
    assert abs(float(out[12].boxes.center[0, 0]) - (15 + 0.5 * 12)) < 0.3
    assert score[17] < score[12]


def test_a_lost_object_is_found_again_under_its_id() -> None:
    seen = [boxes([(15 + 0.5 * t, 0, 0)] if t not in range(10, 16) else []) for t in range(20)]
    out = follow(KalmanConfidence(SPEC), seen)
    assert out[9].id.tolist() == out[16].id.tolist() == out[19].id.tolist() == [1]


def test_the_velocity_that_a_detector_gives_starts_a_track() -> None:
    """At two frames a second a car that drives 8 m between them is found again only by its velocity."""
    drive = [boxes([(10 + 8.0 * t, 0, 0)]) for t in range(6)]
    told = [found.replace(velocity=torch.tensor([[16.0, 0]], dtype=torch.float64)) for found in drive]
    ids = {}
    for name, sequence in (("told", told), ("not told", drive)):
        tracker = KalmanConfidence(SPEC, frame_time=0.5)
        state, ids[name] = tracker.start(), set()
        for index, found in enumerate(sequence):
            frame = FrameResult(FrameMeta(str(index), "s", index, index / 2))
            tracker.step(state, frame, found)
            ids[name] |= set(state.id.tolist())
    assert ids["told"] == {1}
    assert len(ids["not told"]) > 1


def test_weak_detections_do_not_take_the_track_of_strong_ones() -> None:
    strong = boxes([(20, 0, 0)], 0.9)
    both = Boxes.cat([boxes([(20.1, 0, 0)], 0.2), boxes([(20.4, 0, 0)], 0.9)]).replace(batch=torch.zeros(2).long())
    both = both.replace(batch_size=1)
    tracker = KalmanConfidence(SPEC)
    state = tracker.start()
    list(_steps(tracker, state, [strong] * 5, None, 0))
    list(_steps(tracker, state, [both], None, 5))
    assert state.evidence.last[0] == pytest.approx(math.log(9))


def test_scores_that_are_no_probabilities_are_refused_with_the_fix() -> None:
    with pytest.raises(DataError, match="calibration"):
        follow(KalmanConfidence(SPEC), [boxes([(10, 0, 0)], 7.3)])
    scaled = log_odds(np.array([2.0, 4.0]), np.array([0, 1]), np.array([[1.0, -2], [0.5, 1]]))
    assert scaled.tolist() == [0.0, 3.0]


def test_calibrated_scores_are_the_same_as_probabilities() -> None:
    """A detector that gives log-odds plus one, halved, with its calibration, is the detector that gives chances."""
    chance = [boxes([(15 + 0.5 * t, 0, 0)], 0.7) for t in range(6)]
    raw = [found.replace(score=(torch.logit(found.score) + 1) / 2) for found in chance]
    one = follow(KalmanConfidence(SPEC), chance)
    two = follow(KalmanConfidence(SPEC, calibration={"Car": [2.0, -1.0]}), raw)
    for first, second in zip(one, two, strict=True):
        torch.testing.assert_close(first.boxes.score, second.boxes.score)


def test_classes_without_a_network_of_their_own_have_the_general_one() -> None:
    tracker = KalmanConfidence(Spec(Boxes, classes=("forklift",)))
    out = follow(tracker, [boxes([(15, 0, 0)], 0.9)] * 5)
    assert out[-1].id.tolist() == [1]


def test_weights_fit_the_features() -> None:
    confidence = Confidence.load()
    values = np.zeros((3, len(FEATURES)))
    chance = confidence.probability(values, np.array([0, 1, 2]), CLASSES)
    assert chance.shape == (3,)
    assert chance[1] == chance[2] != chance[0]
    assert len(confidence.probability(values[:0], np.zeros(0, dtype=np.int64), CLASSES)) == 0


def test_a_broken_file_of_weights_is_named(tmp_path: Any) -> None:
    path = tmp_path / "w.json"
    path.write_text('{"general": {"features": ["score"], "layers": []}, "special": {}}')
    with pytest.raises(DataError, match=r"w\.json"):
        Confidence.load(str(path))
    with pytest.raises(DataError, match=r"none\.json"):
        Confidence.load(str(tmp_path / "none.json"))


def test_the_state_stays_small_over_many_frames() -> None:
    """Objects come and go: the state holds only what is alive."""
    tracker, rng = KalmanConfidence(SPEC), np.random.default_rng(0)
    state, sizes = tracker.start(), []
    for index in range(1500):
        rows = [(10 + 5 * k + index % 200, 3.0 * k, 0.0) for k in range(3) if rng.random() < 0.8]
        next(_steps(tracker, state, [boxes(rows)], None, index))
        sizes.append(len(state.id))
    assert state.next_id > 20
    assert max(sizes) < 15


def test_the_bench_measures_every_tracker() -> None:
    for name in ("kalman_confidence", "ab3dmot", "time3d_small"):
        spent, held = measure(name, 4, 12)
        assert len(spent) == 6
        assert len(held) == 12
        assert min(spent) > 0


def test_the_smoother_is_the_best_line_through_all_that_was_seen() -> None:
    """The backward pass gives the least-squares solution of the whole sequence, computed with matrices."""
    rng, count, noise = np.random.default_rng(0), 12, kalman_confidence.NOISE
    seen = 0.1 * np.arange(count) * 8 + rng.normal(0, 0.3, count)
    motion, moments = Motion.start(np.zeros((1, 7)), noise), []
    motion.box[0, 0] = seen[0]
    for t in range(count):
        if t:
            motion.predict(0.1, 1.0, noise)
            motion.update(np.array([0]), np.array([[seen[t], 0, 0, 0, 0, 0, 0]]), noise)
        kept = Motion(*(values.copy() for values in vars(motion).values()))
        moments.append(Moment(np.array([1]), kept, np.zeros(1), np.eye(4), 0.1))
    found = smooth(moments, 0.1)
    # unknowns x_0, v_0, x_1, v_1, ...; each row weighted by the inverse of its standard deviation
    rows, right = [], []

    def add(values: dict[int, float], goal: float, variance: float) -> None:
        row = np.zeros(2 * count)
        for place, value in values.items():
            row[place] = value
        rows.append(row / math.sqrt(variance))
        right.append(goal / math.sqrt(variance))

    add({0: 1}, seen[0], float(noise.first))
    add({1: 1}, 0, float(noise.first_velocity))
    for t in range(1, count):
        add({2 * t: 1, 2 * t - 2: -1, 2 * t - 1: -0.1}, 0, float(noise.place))
        add({2 * t + 1: 1, 2 * t - 1: -1}, 0, float(noise.velocity))
        add({2 * t: 1}, seen[t], float(noise.measured))
    best = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    np.testing.assert_allclose([m.box[0, 0] for m in found], best[::2], atol=1e-8)
    np.testing.assert_allclose([m.velocity[0, 0] for m in found], best[1::2], atol=1e-7)


def test_offline_tracks_are_the_same_but_smoother_and_go_through_gaps() -> None:
    rng = np.random.default_rng(0)
    true = [10 + 0.8 * t + 0.02 * t * t for t in range(30)]
    sequence = [boxes([(x + rng.normal(0, 0.3), 0, 0)] if t not in (14, 15, 16) else []) for t, x in enumerate(true)]
    drive = [np.eye(4) for _ in sequence]
    for t, pose in enumerate(drive):
        pose[0, 3] = 0.3 * t
    online, tracker = follow(KalmanConfidence(SPEC), sequence, drive), KalmanOffline(SPEC)
    state = tracker.start()
    frames = [FrameResult(FrameMeta(str(t), "s", t, t / 10)) for t in range(30)]
    for frame, found, pose in zip(frames, sequence, drive, strict=True):
        assert tracker.step(state, frame, found, pose=known(pose)) == []
    offline = [result.tracks for result in tracker.flush(state)]
    assert [tracks.id.tolist() for tracks in online] == [tracks.id.tolist() for tracks in offline]
    error = {}
    for name, out in (("online", online), ("offline", offline)):
        error[name] = np.array(
            [float(tracks.boxes.center[0, 0]) - true[t] for t, tracks in enumerate(out) if len(tracks.id)]
        )
        assert all(torch.equal(a.boxes.score, b.boxes.score) for a, b in zip(online, out, strict=True))
    assert np.abs(error["offline"]).mean() < 0.8 * np.abs(error["online"]).mean()
    assert np.abs(np.diff(error["offline"], 2)).mean() < 0.5 * np.abs(np.diff(error["online"], 2)).mean()
    assert tracker.flush(tracker.start()) == []


def test_calibrations_are_two_numbers_of_classes_of_the_data() -> None:
    for given, wrong in (({"Car": [0.8]}, r"of Car is \[0.8\], expected scale and offset"), ({"car": [1, 0]}, "'Car'")):
        with pytest.raises(ConfigError, match=wrong):
            KalmanConfidence(Spec(Boxes, classes=("Car", "Pedestrian")), calibration=given)
        with pytest.raises(ConfigError, match=wrong):
            KittiDetections(root="nowhere", calibration=given)
