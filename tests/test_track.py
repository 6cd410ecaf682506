"""`lidarfw track`: files of detections in, official result files out."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lidarfw import cli, kitti
from lidarfw.components.metrics.mot3d import Mot3D
from lidarfw.detections import make_tracker, mean_scores, read_kitti, run
from lidarfw.types import Boxes, Spec, Targets, Tracks

CALIBRATION = """P0: 700 0 600 0 0 700 180 0 0 0 1 0
P2: 700 0 600 45 0 700 180 0.2 0 0 1 0.003
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
"""
STEP = 1.0  # metres that the camera drives in a frame


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A parked car and one that drives ahead of the camera, seen in 8 frames; in frame 4 the first one is missed."""
    for name in ("calib", "poses", "det/Car", "det/Pedestrian"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "calib/0000.txt").write_text(CALIBRATION)
    rows, poses = [], []
    for t in range(8):
        for x, z, turn in ((-3.0, 25 - STEP * t, 1.57), (0.0, 15.0, -1.57)):
            if not (t == 4 and x < 0):
                rows.append(f"{t},2,100,150,200,200,{5 - 0.1 * t},1.5,1.7,4.1,{x},1.6,{z},{turn},0.1")
        poses.append(f"1 0 0 0 0 1 0 0 0 0 1 {STEP * t}")
    (tmp_path / "det/Car/0000.txt").write_text("\n".join(rows))
    (tmp_path / "det/Pedestrian/0000.txt").write_text("")
    (tmp_path / "poses/0000.txt").write_text("\n".join(poses))
    return tmp_path


def track(drive: Path, *more: str) -> int:
    return cli.main(["track", str(drive / "det"), "--calib", str(drive / "calib"), "-o", str(drive / "out"), *more])


def test_kitti_results_have_ids_boxes_and_one_score_per_track(drive: Path) -> None:
    assert track(drive, "--poses", str(drive / "poses"), "--tracker", "greedy") == 0
    rows = kitti.read_tracks(drive / "out/0000.txt")
    assert [row.frame for row in rows] == sorted(row.frame for row in rows)
    assert len({row.id for row in rows}) == 2
    for number in {row.id for row in rows}:
        scores = {row.label.score for row in rows if row.id == number}
        assert len(scores) == 1
        (score,) = scores
        assert score is not None
        assert score * 1024 == round(score * 1024)
    first = rows[0].label
    assert first.type == "Car"
    np.testing.assert_allclose(first.location, (-3, 1.6, 25), atol=1e-4)
    np.testing.assert_allclose((*first.size, first.rotation_y), (1.5, 1.7, 4.1, 1.57), atol=1e-4)
    left, top, right, bottom = first.box2d
    assert left < 600 + 700 * (-3 / 25) < right  # the box is projected into the picture
    assert top < bottom


def test_without_poses_it_says_so(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert track(drive) == 0
    assert "no poses" in capsys.readouterr().out


def test_a_page_to_look_through(drive: Path) -> None:
    assert track(drive, "--poses", str(drive / "poses"), "--pictures") == 0
    page = (drive / "out/0000.html").read_text()
    assert "http" not in page
    data = json.loads(page.partition("const D = ")[2].partition(", TAIL")[0])
    assert len(data["frames"]) == 8
    assert len(data["frames"][0]) == 2
    assert data["poses"][3][:2] == [3 * STEP, 0]


def test_the_page_shows_the_pictures_of_the_camera(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With the tracks drawn on them; frames without a picture have none."""
    folder = drive / "images/0000"
    folder.mkdir(parents=True)
    for number in (0, 5):
        Image.new("RGB", (1242, 375), (10, 20, 30)).save(folder / f"{number:06d}.png")
    assert track(drive, "--poses", str(drive / "poses"), "--pictures", "--images", str(drive / "images")) == 0
    page = (drive / "out/0000.html").read_text()
    shots = json.loads(page.partition("const D = ")[2].partition(", TAIL")[0])["pictures"]
    assert [bool(shot) for shot in shots] == [True, False, False, False, False, True, False, False]
    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(shots[0]))))
    assert shown.shape[1] == 880
    assert (np.abs(shown.astype(int) - (10, 20, 30)).max(2) > 60).sum() > 50  # lines and numbers
    assert track(drive, "--pictures", "--images", str(drive / "nothing")) == 2
    assert "no picture" in capsys.readouterr().err
    assert track(drive, "--images", str(drive / "images")) == 2
    assert "--pictures" in capsys.readouterr().err


def test_errors_name_file_and_fix(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["track", str(drive / "det")]) == 2
    assert "--calib" in capsys.readouterr().err
    assert cli.main(["track", str(drive / "nothing")]) == 2
    error = capsys.readouterr().err
    assert "there are no detections" in error
    assert "det/Car/0000.txt" in error
    assert track(drive, "--tracker", "greedi") == 2
    assert "greedy" in capsys.readouterr().err
    (drive / "poses/0000.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    assert track(drive, "--poses", str(drive / "poses")) == 2
    assert "1 poses" in capsys.readouterr().err
    (drive / "det/Car/0000.txt").write_text("0,2,1,2,3\n")
    assert track(drive) == 2
    assert "Car/0000.txt, line 1: expected 15 columns" in capsys.readouterr().err
    assert not list((drive / "out").glob("*"))


def test_what_predict_wrote_can_be_tracked(tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    for t in range(4):
        row = {"class": "car", "score": 0.9, "center": [10 + t, 2, 0], "size": [4, 2, 1.5], "yaw": 0.0}
        plain = {
            "id": f"{t:03d}",
            "classes": ["car"],
            "predictions": {"head.center": {"kind": "Boxes", "boxes": [row]}},
        }
        (folder / f"{t:03d}.json").write_text(json.dumps(plain))
    assert cli.main(["track", str(folder), "--format", "json", "-o", str(tmp_path / "out")]) == 0
    found = [json.loads((tmp_path / f"out/{t:03d}.json").read_text())["tracks"] for t in range(4)]
    assert [[row["id"] for row in rows] for rows in found] == [[1]] * 4


def write_detections(folder: Path, count: int, **changes: object) -> None:
    """Files 1.json, 2.json, ... with a car that drives along; `changes` are of the box of the last."""
    folder.mkdir()
    for t in range(1, count + 1):
        row: dict[str, object] = {"class": "car", "score": 0.9, "center": [10 + t, 2, 0], "size": [4, 2, 1.5], "yaw": 0}
        row |= changes if t == count else {}
        plain = {"classes": ["car"], "predictions": {"head.center": {"kind": "Boxes", "boxes": [row]}}}
        (folder / f"{t}.json").write_text(json.dumps(plain))


def test_files_are_taken_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    write_detections(tmp_path / "scans", 12)
    assert cli.main(["track", str(tmp_path / "scans"), "--format", "json", "-o", str(tmp_path / "out")]) == 0
    found = [json.loads((tmp_path / f"out/{t}.json").read_text())["tracks"] for t in range(1, 13)]
    assert [[row["id"] for row in rows] for rows in found] == [[1]] * 12


@pytest.mark.parametrize(
    ("changes", "text"),
    [({"yaw": float("nan")}, "expected finite numbers"), ({"size": [4, -2, 1.5]}, "size must be above 0"),
     ({"center": [1, 2]}, "2.json: expected boxes with"), ({"velocity": [1]}, "2.json"), ({"class": "bus"}, "'bus'")],
)  # fmt: skip
def test_broken_boxes_are_refused(
    changes: dict[str, object], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_detections(tmp_path / "scans", 2, **changes)
    assert cli.main(["track", str(tmp_path / "scans"), "--format", "json", "-o", str(tmp_path / "out")]) == 2
    assert text in capsys.readouterr().err


def test_what_no_format_reads_is_refused(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_detections(tmp_path / "scans", 1)
    for option in ("--sequences", "--calib", "--poses", "--root"):
        assert cli.main(["track", str(tmp_path / "scans"), "--format", "json", option, str(drive)]) == 2
        assert f"{option} is for --format" in capsys.readouterr().err
    (tmp_path / "scans/1.json").write_text('{"classes": ["car"], "predictions": [1]}')
    assert cli.main(["track", str(tmp_path / "scans"), "--format", "json"]) == 2
    assert "1.json: expected boxes with" in capsys.readouterr().err
    assert cli.main(["track", str(tmp_path / "scans/1.json"), "--calib", str(drive)]) == 2
    assert "1.json is a file" in capsys.readouterr().err
    assert cli.main(["track", str(tmp_path / "scans"), "--format", "nuscenes", "--root", str(drive)]) == 2
    assert "scans is a folder" in capsys.readouterr().err


def test_nuscenes_submission(tmp_path: Path) -> None:
    tables = tmp_path / "v1.0-mini"
    tables.mkdir()
    quarter = [0.7071067811865476, 0, 0, 0.7071067811865476]  # the vehicle heads along y
    samples = [{"token": f"s{t}", "scene_token": "a", "timestamp": 500_000 * t} for t in range(3)]
    data = [
        {"sample_token": f"s{t}", "ego_pose_token": f"e{t}", "calibrated_sensor_token": "c", "timestamp": 500_000 * t,
         "is_key_frame": True, "filename": "x", "width": 0, "height": 0} for t in range(3)
    ]  # fmt: skip
    egos = [{"token": f"e{t}", "translation": [100, 5.0 * t, 0], "rotation": quarter} for t in range(3)]
    mounted = [{"token": "c", "sensor_token": "l", "translation": [0, 0, 1.8], "rotation": [1, 0, 0, 0],
                "camera_intrinsic": []}]  # fmt: skip
    for name, rows in (("sample", samples), ("sample_data", data), ("ego_pose", egos), ("calibrated_sensor", mounted),
                       ("sensor", [{"token": "l", "channel": "LIDAR_TOP"}])):  # fmt: skip
        (tables / f"{name}.json").write_text(json.dumps(rows))
    found = {
        f"s{t}": [{"sample_token": f"s{t}", "translation": [103, 20 + 4.0 * t, 1], "size": [1.8, 4.2, 1.5],
                   "rotation": quarter, "velocity": [0, 8.0], "detection_name": "car", "detection_score": 0.8}]
        for t in range(3)
    }  # fmt: skip
    (tmp_path / "det.json").write_text(json.dumps({"meta": {"use_lidar": True}, "results": found}))
    command = ["track", str(tmp_path / "det.json"), "--format", "nuscenes", "-o", str(tmp_path)]
    assert cli.main(command) == 2  # without the tables
    assert cli.main([*command, "--root", str(tables)]) == 0
    result = json.loads((tmp_path / "tracking_result.json").read_text())
    assert result["meta"] == {"use_lidar": True}
    rows = [result["results"][f"s{t}"][0] for t in range(3)]
    assert len({row["tracking_id"] for row in rows}) == 1
    for t, row in enumerate(rows):
        np.testing.assert_allclose(row["translation"], [103, 20 + 4.0 * t, 1], atol=1e-6)
        np.testing.assert_allclose(row["rotation"], quarter, atol=1e-6)
        np.testing.assert_allclose(row["velocity"], [0, 8], atol=1e-6)
        assert row["size"] == [1.8, 4.2, 1.5]
        assert row["tracking_name"] == "car"


def test_figures_on_a_real_drive(real_data: Callable[[str], Path]) -> None:
    """Sequence 0003, cars: the learned confidence is ahead of the baseline by points."""
    pytest.importorskip("lidarfw_time3d")
    folder, classes = real_data("kitti_tracking/training"), ("Car",)
    sequence = read_kitti(folder / "det_pointrcnn", "0003", classes, folder / "pose_orbslam3", folder / "calib")
    targets = _targets(folder, classes, len(sequence.frames))
    figures = {}
    for name, kept in (("ab3dmot_kitti", "classes"), ("kalman_confidence_pointrcnn", "gate")):
        part = name.removesuffix("_kitti").removesuffix("_pointrcnn")
        more = [f"~tracker.{part}.{kept}.{other}" for other in ("Pedestrian", "Cyclist")]
        if kept == "gate":
            more += [f"~tracker.{part}.calibration.{other}" for other in ("Pedestrian", "Cyclist")]
        metric = Mot3D(Spec(Tracks, classes=classes), default_iou=0.25)
        frames = list(run(make_tracker([f"tracker={name}", *more], classes), sequence))
        mean = mean_scores([tracks for _, tracks in frames])
        for (frame, tracks), target in zip(frames, targets, strict=True):
            score = tracks.boxes.score.new_tensor([mean[number] for number in tracks.id.tolist()])
            metric.update(tracks.replace(boxes=tracks.boxes.replace(score=score)), target, [frame.meta])
        figures[part] = {key: float(value) for key, value in metric.compute().items()}
    base, best = figures["ab3dmot"], figures["kalman_confidence"]
    assert base["car_samota"] > 0.8
    assert best["car_samota"] > base["car_samota"] + 0.01
    assert best["car_mota"] > base["car_mota"] + 0.01
    assert best["car_ids"] <= 1


def _targets(folder: Path, classes: tuple[str, ...], count: int) -> list[Targets]:
    import torch

    from lidarfw.detections import upright

    calibration = upright(kitti.read_calibration(folder / "calib/0003.txt"))
    lines = [kitti.as_object(line) for line in kitti.read_tracks(folder / "label_02/0003.txt")]
    made = []
    for index in range(count):
        here = [line for line in lines if line.frame == index]
        boxes, ignored = kitti.boxes_from_labels([line.label for line in here], calibration, classes)
        ids = torch.tensor([line.id for line in here], dtype=torch.long)
        assert isinstance(boxes, Boxes)
        assert boxes.row is not None
        made.append(Targets(boxes=boxes, ignored=ignored, tracks=Tracks(boxes, ids[boxes.row])))
    return made
