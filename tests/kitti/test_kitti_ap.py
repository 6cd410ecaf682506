"""The KITTI metric against numbers computed by hand and against plain loops over the same labels."""

from __future__ import annotations

import importlib.util
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarfw import kitti
from lidarfw.components.metrics.kitti_ap import LEVELS, LOOSE, STRICT, KittiAP, score_thresholds
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import Boxes, FrameMeta, Spec, Targets

_file = importlib.util.spec_from_file_location("kitti_ap_by_loops", Path(__file__).with_name("kitti_ap_by_loops.py"))
loops = importlib.util.module_from_spec(_file)
_file.loader.exec_module(loops)

CLASSES = ("Car", "Pedestrian", "Cyclist")
SPEC = Spec(Boxes, classes=CLASSES)
TILT = 0.02
CALIBRATION = kitti.Calibration(
    np.array([[720.0, 0, 610, 45], [0, 720, 170, -0.3], [0, 0, 1, 0.005]]),
    np.array([[math.cos(TILT), 0, math.sin(TILT)], [0, 1, 0], [-math.sin(TILT), 0, math.cos(TILT)]]),
    np.array([[0.0, -1, 0, -0.02], [0, 0, -1, -0.06], [1, 0, 0, -0.33]]),
)
META = FrameMeta("000000", cameras=CALIBRATION.cameras(1242, 375))


def car(x=0.0, z=20.0, score=None, kind="Car", box2d=(500.0, 150.0, 600.0, 200.0), **changes):
    label = kitti.Label(kind, 0.0, 0, 0.0, box2d, (1.5, 1.6, 4.0), (x, 1.6, z), 0.0, score)
    return replace(label, **changes)


def measure(frames, spec=SPEC):
    """The metric on (objects, detections) of several frames."""
    metric = KittiAP(spec)
    for objects, detections in frames:
        found, _ = kitti.boxes_from_labels(detections, CALIBRATION, spec.classes)
        boxes, ignored = kitti.boxes_from_labels(objects, CALIBRATION, spec.classes)
        metric.update(found, Targets(boxes=boxes, ignored=ignored), [META])
    return metric.compute()


def many(count, objects=lambda i: [car()], detections=lambda i: [car(score=0.5 + i / 1000)]):
    return [(objects(i), detections(i)) for i in range(count)]


def test_perfect_results_of_80_cars_score_1():
    figures = measure(many(80))
    for kind in ("2d", "aos", "bev", "3d", "bev_loose", "3d_loose"):
        for level in ("easy", "moderate", "hard"):
            assert figures[f"car_{kind}_r40_{level}"] == pytest.approx(1)
            assert figures[f"car_{kind}_r11_{level}"] == pytest.approx(1)
    assert figures["cyclist_3d_r40_moderate"] == 0
    assert figures["mean_3d_r40_moderate"] == pytest.approx(1 / 3)


def test_ten_perfect_cars_fill_ten_positions_only():
    """Positions 0 .. 9 of 41 have a threshold: R40 counts 1 .. 9, R11 counts 0, 4 and 8."""
    figures = measure(many(10))
    assert figures["car_3d_r40_easy"] == pytest.approx(9 / 40)
    assert figures["car_3d_r11_easy"] == pytest.approx(3 / 11)


def test_two_cars_and_a_false_detection_between_them():
    """Two of 41 positions have a threshold, and R40 leaves the first out; on the recall grid AP is 0.8333."""
    figures = measure([([car(), car(x=10.0)], [car(score=0.9), car(x=5.0, score=0.8), car(x=10.0, score=0.7)])])
    assert figures["car_3d_r40_easy"] == pytest.approx(0.016667, abs=1e-6)


def test_half_the_cars_found():
    """80 objects, 40 found: recall ends at 0.5, so positions 0 .. 20 hold precision 1."""
    frames = many(80, detections=lambda i: [car(score=0.5 + i / 1000)] if i % 2 else [])
    figures = measure(frames)
    assert figures["car_3d_r40_easy"] == pytest.approx(20 / 40)
    assert figures["car_3d_r11_easy"] == pytest.approx(6 / 11)


def test_false_detections_surer_than_all_true_ones():
    """20 false ones of score 1 before 80 true ones: precision at position k is 2k / (2k + 20), rising to 80 / 100."""
    frames = many(80) + many(20, lambda i: [], lambda i: [car(score=1.0)])
    assert measure(frames)["car_3d_r40_easy"] == pytest.approx(80 / 100)


def test_difficulty_limits():
    """One object of each kind in 41 frames; it counts only where its height, occlusion and truncation allow."""
    high, low = (500.0, 150.0, 600.0, 191.0), (500.0, 150.0, 600.0, 190.0)
    cases = [
        ({"box2d": high}, (1, 1, 1)),
        ({"box2d": low}, (0, 1, 1)),  # 40 pixels are not more than 40
        ({"occlusion": 1}, (0, 1, 1)),
        ({"occlusion": 2}, (0, 0, 1)),
        ({"occlusion": 3}, (0, 0, 0)),
        ({"truncation": 0.15}, (1, 1, 1)),
        ({"truncation": 0.3}, (0, 1, 1)),
        ({"truncation": 0.5}, (0, 0, 1)),
        ({"truncation": 0.51}, (0, 0, 0)),
        ({"kind": "Van"}, (0, 0, 0)),
        ({"kind": "Truck"}, (0, 0, 0)),
    ]
    for changes, expected in cases:
        frames = many(41, lambda i, c=changes: [car(**c)], lambda i: [car(score=0.9)])
        figures = measure(frames)
        got = [figures[f"car_3d_r40_{level.name}"] for level in LEVELS]
        assert got == pytest.approx(expected), changes


def test_ignored_objects_and_regions_forgive_detections():
    perfect = many(41)
    van = (car(kind="Van", z=40.0), car(score=1.0, z=40.0))
    region = kitti.Label("DontCare", -1, -1, -10, (490.0, 140, 610, 210), (-1, -1, -1), (-1000, -1000, -1000), -10)
    tiny = car(score=1.0, z=60.0, box2d=(500.0, 150.0, 600.0, 174.0))
    assert measure([*perfect, *many(20, lambda i: [van[0]], lambda i: [van[1]])])["car_3d_r40_hard"] == pytest.approx(1)
    assert measure([*perfect, *many(20, lambda i: [], lambda i: [tiny])])["car_3d_r40_hard"] == pytest.approx(1)
    with_region = measure([*perfect, *many(20, lambda i: [region], lambda i: [car(score=1.0)])])
    assert with_region["car_2d_r40_hard"] == pytest.approx(1)  # DontCare is known in the picture only
    assert with_region["car_3d_r40_hard"] == pytest.approx(41 / 61)


def test_orientation_halves_aos_and_nothing_else():
    frames = many(80, detections=lambda i: [car(score=0.5 + i / 1000, alpha=math.pi / 2)])
    figures = measure(frames)
    assert figures["car_aos_r40_easy"] == pytest.approx(0.5)
    assert figures["car_2d_r40_easy"] == pytest.approx(1)


def test_loose_overlap():
    """Shifted by 1 m of 4 m: IoU 3/5 is over 0.5, not over 0.7."""
    frames = many(80, detections=lambda i: [car(x=1.0, score=0.5 + i / 1000)])
    figures = measure(frames)
    assert (figures["car_3d_r40_easy"], figures["car_3d_loose_r40_easy"]) == pytest.approx((0, 1))


def random_frame(rng):
    """Labels with two decimals as KITTI's; detections near them, beside them, doubled, of wrong class, too low."""
    objects, detections = [], []
    kinds = ["Car", "Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Truck", "DontCare"]
    for _ in range(rng.integers(1, 9)):
        kind = str(rng.choice(kinds))
        left, top = rng.uniform(0, 900, 1)[0], rng.uniform(100, 200)
        box2d = np.round([left, top, left + rng.uniform(40, 200), top + rng.choice([20, 25, 30, 39, 40, 41, 90])], 2)
        size = np.round(rng.uniform([1.4, 0.6, 0.8], [2.0, 2.0, 4.5]), 2)
        place = np.round([rng.uniform(-12, 12), rng.uniform(1, 2), rng.uniform(6, 40)], 2)
        label = kitti.Label(
            kind, float(rng.choice([0, 0, 0.15, 0.2, 0.3, 0.4, 0.6])), int(rng.choice([0, 0, 0, 1, 2, 3])),
            round(float(rng.uniform(-3, 3)), 2), tuple(box2d), tuple(size), tuple(place),
            round(float(rng.uniform(-3.1, 3.1)), 2),
        )  # fmt: skip
        if kind == "DontCare":
            label = replace(label, size=(-1, -1, -1), location=(-1000, -1000, -1000), rotation_y=-10)
        objects.append(label)
        # a neutral or second object on top of it now and then, in either order of the file
        if kind in ("Car", "Van", "Pedestrian") and rng.random() < 0.3:
            twin = {"Car": "Van", "Van": "Car", "Pedestrian": "Person_sitting"}[kind]
            objects.append(replace(label, type=twin, box2d=tuple(np.round(np.array(label.box2d) + 2, 2))))
        for _ in range(rng.integers(0, 4)):
            detections.append(near(label if kind != "DontCare" else car(box2d=label.box2d), rng))
    return objects, detections


def near(label, rng):
    spread = rng.choice([0.02, 0.1, 0.5])
    kind = str(rng.choice(CLASSES)) if rng.random() < 0.2 or label.type not in CLASSES else label.type
    box2d = np.array(label.box2d) + rng.normal(0, 15 * spread, 4)
    box2d[2:] = np.maximum(box2d[2:], box2d[:2] + 5)
    return replace(
        label, type={"Van": "Car"}.get(kind, kind), truncation=-1, occlusion=-1,
        alpha=label.alpha + rng.normal(0, 0.5), box2d=tuple(box2d),
        size=tuple(np.array(label.size) * np.exp(rng.normal(0, spread / 5, 3))),
        location=tuple(np.array(label.location) + rng.normal(0, spread, 3)),
        rotation_y=label.rotation_y + rng.normal(0, spread),
        score=float(rng.integers(1, 64) / 64 if rng.random() < 0.5 else np.float32(rng.random())),
    )  # fmt: skip


@pytest.mark.parametrize(("seed", "count"), [(0, 6), (1, 40), (2, 120)])
def test_equals_plain_loops_on_random_results(seed, count):
    rng = np.random.default_rng(seed)
    frames = [random_frame(rng) for _ in range(count)]
    figures = measure(frames)
    by_loops = [loops.Frame(*frame) for frame in frames]
    seen = 0
    for name in CLASSES:
        for number, level in enumerate(LEVELS):
            cases = [("", m, limit) for m, limit in STRICT[name].items()]
            cases += [("_loose", m, limit) for m, limit in LOOSE[name].items()]
            for suffix, kind, limit in cases:
                r11, r40, aos11, aos40 = loops.average_precisions(by_loops, name, number, kind, limit)
                key = f"{name.lower()}_{kind}{suffix}"
                assert figures[f"{key}_r11_{level.name}"] == pytest.approx(r11, abs=1e-6), key
                assert figures[f"{key}_r40_{level.name}"] == pytest.approx(r40, abs=1e-6), key
                if kind == "2d":
                    assert figures[f"{name.lower()}_aos_r11_{level.name}"] == pytest.approx(aos11, abs=1e-6)
                    assert figures[f"{name.lower()}_aos_r40_{level.name}"] == pytest.approx(aos40, abs=1e-6)
                seen += 0 < r40 < 1
    assert seen > 20 or count < 40  # many figures are neither 0 nor 1


def test_thresholds_lie_nearest_to_every_fortieth():
    assert score_thresholds(np.arange(80.0), 80).tolist() == [79.0, *np.arange(78.0, -1, -2)]
    assert len(score_thresholds(np.arange(1000.0), 1000)) == 41
    assert score_thresholds(np.zeros(0), 0).tolist() == []


def test_batches_and_order_of_frames_do_not_matter():
    rng = np.random.default_rng(3)
    frames = [random_frame(rng) for _ in range(7)]
    metric = KittiAP(SPEC)
    parts = []
    for objects, detections in reversed(frames):
        found, _ = kitti.boxes_from_labels(detections, CALIBRATION, CLASSES)
        parts.append((found, *kitti.boxes_from_labels(objects, CALIBRATION, CLASSES)))
    found, boxes, ignored = (Boxes.cat(part, as_batch=True) for part in zip(*parts, strict=True))
    metric.update(found, Targets(boxes=boxes, ignored=ignored), [META] * len(frames))
    assert metric.compute() == pytest.approx(measure(frames), abs=1e-12)
    metric.reset()
    assert set(metric.compute().values()) == {0.0}


def test_two_processes_make_one_metric():
    """Frames counted apart and merged, as after an exchange between processes; one of them may have seen nothing."""
    rng = np.random.default_rng(4)
    frames = [random_frame(rng) for _ in range(9)]
    parts = []
    for share in (frames[:4], [], frames[4:]):
        parts.append(KittiAP(SPEC))
        for objects, detections in share:
            found, _ = kitti.boxes_from_labels(detections, CALIBRATION, CLASSES)
            boxes, ignored = kitti.boxes_from_labels(objects, CALIBRATION, CLASSES)
            parts[-1].update(found, Targets(boxes=boxes, ignored=ignored), [META])
    whole = KittiAP(SPEC)
    for name in ("detections", "objects", "pairs", "frames"):
        setattr(whole, name, torch.cat([torch.cat(getattr(part, name)) for part in parts]))
    assert whole.compute() == pytest.approx(measure(frames), abs=1e-12)


def test_projected_rectangle_stands_in_for_a_missing_one():
    frames = many(80)
    metric = KittiAP(SPEC)
    for objects, _ in frames:
        boxes, ignored = kitti.boxes_from_labels(objects, CALIBRATION, CLASSES)
        rectangle = kitti.project_level_boxes(kitti.level_boxes(boxes, META.cameras), META.cameras)
        boxes.box2d = torch.tensor(rectangle, dtype=torch.float32)
        metric.update(boxes.replace(box2d=None, alpha=None), Targets(boxes=boxes, ignored=ignored), [META])
    assert metric.compute()["car_2d_r40_easy"] == pytest.approx(1)


def test_empty_everything_is_finite():
    metric = KittiAP(SPEC)
    metric.update(Boxes.empty(), Targets(boxes=Boxes.empty()), [META])
    metric.update(Boxes.empty(), Targets(), [META])
    objects, _ = kitti.boxes_from_labels([car()], CALIBRATION, CLASSES)
    metric.update(Boxes.empty(), Targets(boxes=objects), [META])
    metric.update(objects.replace(box2d=None), Targets(boxes=Boxes.empty()), [META])
    assert all(value == 0 for value in metric.compute().values())


def test_errors_say_what_is_missing():
    with pytest.raises(ConfigError, match="metric=box_ap"):
        KittiAP(Spec(Boxes, classes=("tram",)))
    boxes, _ = kitti.boxes_from_labels([car()], CALIBRATION, CLASSES)
    with pytest.raises(DataError, match="occlusion"):
        KittiAP(SPEC).update(boxes, Targets(boxes=boxes.replace(occlusion=None)), [META])
    with pytest.raises(DataError, match="rectified"):
        KittiAP(SPEC).update(boxes, Targets(boxes=boxes), [FrameMeta("7")])
