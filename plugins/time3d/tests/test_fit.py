"""Learning the confidence from made-up drives: real cars are seen again and again, false boxes once."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from lidarfw.files import write_text

from lidarfw_time3d import fit
from lidarfw_time3d.confidence import FEATURES, Confidence

CALIBRATION = """P0: 700 0 600 0 0 700 180 0 0 0 1 0
P2: 700 0 600 45 0 700 180 0.2 0 0 1 0.003
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
"""
NAMES = ("0000", "0001", "0002", "0003")


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four drives of 25 frames: three cars each, and a false box in every frame; scores tell them apart only partly."""
    folder, rng = tmp_path_factory.mktemp("drives"), np.random.default_rng(0)
    for name in NAMES:
        found, known = [], []
        for t in range(25):
            for car in range(3):
                box = f"1.5 1.7 4.1 {-6 + 6 * car} 1.6 {15 + 5 * car + 0.3 * t:.3f} -1.57"
                known.append(f"{t} {car} Car 0 0 0 400 150 500 220 {box}")
                score = rng.normal(2, 1)
                found.append(f"{t},2,400,150,500,220,{score:.3f},{box.replace(' ', ',')},0")
            x, z = rng.uniform(-15, 15), rng.uniform(60, 90)
            found.append(f"{t},2,400,150,500,220,{rng.normal(0, 1):.3f},1.5,1.7,4.1,{x:.2f},1.6,{z:.2f},1.0,0")
        write_text(folder / "det/Car" / f"{name}.txt", "\n".join(found))
        write_text(folder / "label_02" / f"{name}.txt", "\n".join(known))
        write_text(folder / "calib" / f"{name}.txt", CALIBRATION)
        write_text(folder / "poses" / f"{name}.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 25)
    return folder


def _read(drives: Path) -> list[fit.Labelled]:
    return fit.read(drives / "det", drives / "label_02", drives / "calib", drives / "poses", ("Car",))


def test_boxes_are_judged_by_the_rules_of_the_benchmark(drives: Path) -> None:
    entry = _read(drives)[0]
    frame, targets = entry.sequence.frames[0], entry.targets[0]
    right, counts = fit.judge(frame.boxes, np.zeros(4, dtype=bool), targets, frame)
    assert right.tolist() == [True, True, True, False]
    # 1.5 m at 60 to 90 m is 12 to 18 pixels: too low to be an error
    assert counts.tolist() == [True, True, True, False]
    twice = frame.boxes[[0, 0]]
    right, _ = fit.judge(twice, np.array([True, False]), targets, frame)
    assert right.tolist() == [False, True]  # the detected one goes before the coasted one


def test_what_is_learnt_tells_cars_from_clutter(drives: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(fit, "_STEPS", 40)
    monkeypatch.setattr(fit, "_BATCH", 256)
    data = _read(drives)
    learnt = fit.fit(data, ("Car",), view=1.6)
    assert learnt["calibration"]["Car"][0] > 0.3
    assert fit.fit(data, ("Car",), view=1.6) == learnt  # the seeds decide everything
    path = tmp_path / "w.json"
    write_text(path, json.dumps(learnt))
    samples = fit.record(data[0], fit.make_tracker(("Car",), 1.6, learnt["calibration"]))
    chance = Confidence.load(str(path)).probability(samples.features, samples.label, ("Car",))
    long = samples.features[:, 4] > np.log(5)  # seen for five frames
    assert chance[samples.right & long].mean() > 0.6
    assert chance[samples.right].mean() > chance[~samples.right].mean() + 0.2


def test_cross_validation_tracks_what_was_not_learnt_from(drives: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit, "_STEPS", 40)
    monkeypatch.setattr(fit, "_BATCH", 256)
    variants = {
        "all": fit.Variant(),
        "rule": fit.Variant(rule=True),
        "blind": fit.Variant({"min_unseen": 2.0}, posed=False),
    }
    found = fit.cross_validate(_read(drives), ("Car",), 1.6, 2, variants)
    assert set(found) == set(variants)
    assert set(found["all"]) == {"devkit", "clean"}
    for name in variants:
        assert found[name]["clean"]["car_samota"] > 0.9
        assert found[name]["clean"]["car_ids"] == 0


def test_the_rule_shows_what_was_hit_three_times() -> None:
    values = np.zeros((5, len(FEATURES)))
    rows = {"hits": np.log([1, 2, 3, 3, 1]), "missed": np.log1p([0, 0, 0, 3, 0]), "begin": [2, 2, 2, 2, 0]}
    for name, column in rows.items():
        values[:, FEATURES.index(name)] = column
    chance = fit.HitRule().probability(values, np.zeros(5), ("Car",))
    assert chance.tolist() == [0, 0, 0.5, 0, 0.5]  # the last one is in the first frame of a sequence


def test_the_command_says_what_is_missing(drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rest = ["--calib", str(drives / "calib"), "-o", str(tmp_path / "weights.json")]
    (tmp_path / "empty").mkdir()
    for found, labels, wrong in (
        (drives / "nowhere", drives / "label_02", "nowhere: there is no such folder of detections"),
        (tmp_path / "empty", drives / "label_02", "empty: has no detections, expected CLASS/SEQUENCE.txt"),
        (drives / "det", tmp_path / "empty", "has no labels of the sequences that have detections, 0000, 0001"),
    ):
        assert fit.main([str(found), "--labels", str(labels), *rest]) == 2
        assert wrong in capsys.readouterr().err
