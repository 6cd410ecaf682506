"""The KITTI dataset on files of the official layout: conventions, splits, broken files, real frames."""

from __future__ import annotations

import math
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
import torch

from lidarfw import kitti
from lidarfw.components.datasets.kitti import KittiDataset
from lidarfw.errors import DataError
from lidarfw.ops import points_in_boxes_mask
from lidarfw.testing.checks import run_checks
from lidarfw.types import Boxes, Camera, DataSpec, Points, Spec, collate

CAR, PEDESTRIAN, CYCLIST = 0, 1, 2


def test_frame_has_points_labels_and_calibration(kitti_root):
    dataset = KittiDataset(root=str(kitti_root), split="train", camera_view=False)
    frame = dataset[1]
    raw = np.fromfile(kitti_root / "training/velodyne/000001.bin", "<f4").reshape(-1, 4)
    assert torch.equal(frame.inputs["points"].xyz, torch.tensor(raw[:, :3]))
    assert torch.equal(frame.inputs["points"].features, torch.tensor(raw[:, 3:]))
    assert len(dataset) == 2
    assert (frame.meta.id, frame.meta.path) == ("000001", str(kitti_root / "training/velodyne/000001.bin"))
    assert frame.meta.images == {"image": str(kitti_root / "training/image_2/000001.png")}
    assert (frame.meta.cameras["image"].width, frame.meta.cameras["image"].height) == (1242, 375)
    assert [list(s) for s in dataset.sequences()] == [[0], [1]]


def test_boxes_in_the_lidar_frame(kitti_root):
    """Car of the labels: underside (-5, 1.6, 20) right, down, ahead of the camera; heading along the camera's x."""
    boxes = KittiDataset(root=str(kitti_root), split="train")[0].targets.boxes
    assert boxes.label.tolist() == [CAR, PEDESTRIAN, CYCLIST]
    assert boxes.center[0].tolist() == pytest.approx([20.33, 4.98, -1.66 + 0.75], abs=1e-5)
    assert boxes.size[0].tolist() == pytest.approx([4.0, 1.6, 1.5])
    assert boxes.yaw.tolist() == pytest.approx([-math.pi / 2, -math.pi / 2 - 0.3, -math.pi / 2 - 1.2], abs=1e-6)
    assert boxes.occlusion.tolist() == [0, 2, 0]
    assert boxes.truncation.tolist() == pytest.approx([0, 0.1, 0])
    assert boxes.box2d[0].tolist() == [300, 160, 400, 220]
    assert boxes.row.tolist() == [0, 2, 4]


def test_yaw_is_wrapped(kitti_root):
    path = kitti_root / "training/label_2/000000.txt"
    path.write_text("Car 0.00 0 0 300.00 160.00 400.00 220.00 1.50 1.60 4.00 -5.00 1.60 20.00 3.00\n")
    yaw = KittiDataset(root=str(kitti_root), split="train")[0].targets.boxes.yaw
    assert yaw.tolist() == pytest.approx([2 * math.pi - 3 - math.pi / 2], abs=1e-6)


def test_neutral_objects(kitti_root):
    ignored = KittiDataset(root=str(kitti_root), split="train")[0].targets.ignored
    assert ignored.label.tolist() == [CAR, PEDESTRIAN, -1]  # van, sitting person, DontCare
    assert ignored.size[2].tolist() == [0, 0, 0]
    assert ignored.box2d[2].tolist() == [900, 160, 950, 190]
    listed = KittiDataset(root=str(kitti_root), split="train", classes=("Car", "Van", "Truck"))[0].targets
    assert listed.boxes.label.tolist() == [0, 1, 2]
    assert listed.ignored.label.tolist() == [-1]


def test_camera_view_keeps_the_points_of_the_picture(kitti_root):
    points = KittiDataset(root=str(kitti_root), split="train")[0].inputs["points"]
    everything = KittiDataset(root=str(kitti_root), split="train", camera_view=False)[0].inputs["points"]
    x, y, z = everything.xyz.double().T
    depth = x - 0.33 + 0.005
    u = (720 * (-y - 0.02) + 610 * (x - 0.33) + 45) / depth
    v = (720 * (-z - 0.06) + 170 * (x - 0.33) - 0.3) / depth
    seen = (depth > 0) & (u >= -0.5) & (u < 1241.5) & (v >= -0.5) & (v < 374.5)
    assert torch.equal(points.xyz, everything.xyz[seen])
    assert 90 <= len(points) < len(everything)


def test_camera_projects_exactly_as_p2(kitti_root):
    calibration = kitti.read_calibration(kitti_root / "training/calib/000000.txt")
    camera = calibration.cameras(1242, 375)["image"]
    xyz = torch.tensor([[20.0, 3.0, -1.0], [5.0, -2.0, 0.5], [60.0, -20.0, 1.0]], dtype=torch.float64)
    uv, depth, _ = camera.project(xyz)
    homogeneous = np.concatenate([xyz.numpy(), np.ones((3, 1))], 1)
    expected = homogeneous @ (calibration.p2 @ calibration.to_rectified).T
    assert np.allclose(uv.numpy(), expected[:, :2] / expected[:, 2:], atol=1e-9)
    assert np.allclose(depth.numpy(), expected[:, 2], atol=1e-9)


def test_picture_as_an_input(kitti_root):
    frame = KittiDataset(root=str(kitti_root), split="train", image=True)[0]
    image = frame.inputs["image"]
    assert image.features.shape == (1, 3, 384, 1248)
    assert (image.cameras[0].width, image.cameras[0].height) == (1248, 384)
    assert image.cameras[0].from_sensor == frame.meta.cameras["image"].from_sensor
    assert 0 < image.features[..., :375, :1242].max() <= 1
    assert image.features[..., 375:, :].abs().sum() == image.features[..., 1242:].abs().sum() == 0


def test_spec_needs_no_files_and_frames_fit_it(kitti_root):
    spec = KittiDataset(root="/nowhere", image=True).spec
    assert spec.targets == {Boxes}
    assert spec.classes == ("Car", "Pedestrian", "Cyclist")
    assert spec.inputs["points"] == Spec(Points, channels=1)
    assert isinstance(spec.inputs["image"].geometry, Camera)
    assert DataSpec.from_plain(spec.to_plain()) == spec
    batch = collate([KittiDataset(root=str(kitti_root), split=s, image=True)[0] for s in ("train", "val", "train")])
    assert batch.inputs["points"].features.shape[1] == 1
    assert batch.targets.ignored.batch.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]


@pytest.mark.parametrize("image", [False, True])
def test_keeps_the_rules_of_a_dataset(kitti_root, image, monkeypatch):
    """All checks of the conformance kit that need the files."""
    monkeypatch.setattr(KittiDataset, "example", {"root": str(kitti_root), "split": "all", "image": image}, False)
    results = run_checks(KittiDataset)
    assert [r for r in results if r.status == "failed"] == []
    passed = {r.check for r in results if r.status == "passed"}
    assert {"frames_match_the_spec", "frames_can_be_read_anywhere", "sequences_hold_every_frame_once"} <= passed


def test_import_and_spec_do_not_import_torch():
    code = (
        "import sys; from lidarfw.components.datasets.kitti import KittiDataset as K; K(root='x').spec; "
        "import lidarfw.components.transforms.ground_truth_sampling, lidarfw.components.transforms.augmentation; "
        "import lidarfw.components.transforms.crop, lidarfw.commands.prepare; sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# splits


def test_splits(kitti_root):
    def ids(split):
        return KittiDataset(root=str(kitti_root), split=split).ids

    assert ids("val") == ["000002"]
    assert ids("all") == ["000000", "000001", "000002"]
    assert KittiDataset(root=str(kitti_root), split="test")[0].targets.boxes is None
    (kitti_root / "ImageSets" / "all.txt").write_text("000001")
    assert ids("all") == ["000001"]
    with pytest.raises(DataError, match=r"splits\.train=all"):
        ids("trainval")


def test_root_must_be_set_and_right(tmp_path):
    with pytest.raises(DataError, match=r"dataset\.kitti\.root is not set"):
        len(KittiDataset())
    with pytest.raises(DataError, match="training"):
        len(KittiDataset(root=str(tmp_path), split="all"))
    (tmp_path / "training" / "velodyne").mkdir(parents=True)
    with pytest.raises(DataError, match="no frames"):
        len(KittiDataset(root=str(tmp_path), split="all"))


def test_prepare_finds_gaps(kitti_root):
    dataset = KittiDataset(root=str(kitti_root), split="train", image=True)
    dataset.prepare()
    (kitti_root / "training/image_2/000001.png").unlink()
    with pytest.raises(DataError, match=r"image_2: 1 of the 2 frames.*000001\.png"):
        dataset.prepare()
    KittiDataset(root=str(kitti_root), split="train").prepare()  # pictures are not needed then
    (kitti_root / "training/calib/000000.txt").unlink()
    with pytest.raises(DataError, match="calib"):
        dataset.prepare()


def test_no_pictures_means_the_usual_size_and_a_warning(kitti_root):
    (kitti_root / "training/image_2/000000.png").unlink()
    with pytest.warns(UserWarning, match="1242 x 375"):
        frame = KittiDataset(root=str(kitti_root), split="train")[0]
    assert frame.meta.cameras["image"].width == 1242
    assert frame.meta.images == {}
    with pytest.raises(DataError, match=r"000000\.png"), pytest.warns(UserWarning, match="lacks pictures"):
        _ = KittiDataset(root=str(kitti_root), split="train", image=True)[0]


# broken files: the message names the file, the place, what was expected and what was found


def label(**changes):
    columns = {
        "type": "Car", "truncation": "0.00", "occlusion": "0", "alpha": "-1.57", "left": "300", "top": "160",
        "right": "400", "bottom": "220", "height": "1.5", "width": "1.6", "length": "4", "x": "-5", "y": "1.6",
        "z": "20", "rotation_y": "0",
    }  # fmt: skip
    return " ".join((columns | changes).values()) + "\n"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (label(length="0"), ["line 2", "positive", "0.0"]),
        (label(height="-1.5"), ["line 2", "positive", "-1.5"]),
        (label(x="nan"), ["line 2", "x", "finite", "'nan'"]),
        (label(z="inf"), ["line 2", "z", "finite", "'inf'"]),
        (label(alpha="left"), ["line 2", "alpha", "'left'"]),
        (label(rotation_y="1e6"), ["line 2", "rotation_y", "radians", "degrees"]),
        (label(type="Lorry"), ["line 2", "type", "Car, Van", "'Lorry'"]),
        (label(occlusion="7"), ["line 2", "occlusion", "7"]),
        (label(occlusion="0.5"), ["line 2", "occlusion", "0.5"]),
        (label(left="500"), ["line 2", "left <= right"]),
        ("Car 0.00 0 -1.57 300\n", ["line 2", "15 columns", "5"]),
    ],
)
def test_broken_labels(kitti_root, line, words):
    path = kitti_root / "training/label_2/000000.txt"
    path.write_text(label() + line)
    with pytest.raises(DataError) as caught:
        _ = KittiDataset(root=str(kitti_root), split="train")[0]
    for word in [str(path), *words]:
        assert word in str(caught.value)
    assert len(str(caught.value).splitlines()) <= 10


def test_unknown_classes_of_ones_own_are_read(kitti_root):
    (kitti_root / "training/label_2/000000.txt").write_text(label(type="Lorry"))
    frame = KittiDataset(root=str(kitti_root), split="train", classes=("Car", "Lorry"))[0]
    assert frame.targets.boxes.label.tolist() == [1]


def test_a_frame_without_objects_is_fine(kitti_root):
    (kitti_root / "training/label_2/000000.txt").write_text("")
    frames = [KittiDataset(root=str(kitti_root), split="train")[i] for i in range(2)]
    assert len(frames[0].targets.boxes) == len(frames[0].targets.ignored) == 0
    batch = collate(frames)
    assert batch.targets.boxes.batch.tolist() == [1, 1, 1]
    assert batch.targets.boxes.occlusion.tolist() == [0, 2, 0]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("P2:", "P9:", ["no key P2"]),
        ("R0_rect:", "R9_rect:", ["no key R0_rect"]),
        ("R0_rect: 1 0 0", "R0_rect: 1 0", ["R0_rect", "3 x 3", "8"]),
        ("R0_rect: 1 0 0", "R0_rect: 2 0 0", ["R0_rect", "rotation"]),
        ("R0_rect: 1 0 0", "R0_rect: nan 0 0", ["R0_rect", "finite"]),
        ("Tr_velo_to_cam: 0 -1 0", "Tr_velo_to_cam: 0 1 0", ["Tr_velo_to_cam", "rotation"]),
        ("P2: 720", "P2: 0", ["P2", "fx"]),
    ],
)
def test_broken_calibration(kitti_root, old, new, words):
    path = kitti_root / "training/calib/000000.txt"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DataError) as caught:
        _ = KittiDataset(root=str(kitti_root), split="train")[0]
    for word in [str(path), *words]:
        assert word in str(caught.value)


def _column(value, row, column):
    def change(data):
        table = np.frombuffer(data, "<f4").reshape(-1, 4).copy()
        table[row, column] = value
        return table.tobytes()

    return change


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda data: b"", "empty"),
        (lambda data: data[:-3], "multiple of 16"),
        (lambda data: bytes(len(data)), "origin"),
        (_column(np.nan, 5, 0), "1 with x, y, z not finite"),
        (_column(np.inf, 5, 1), "not finite"),
        (_column(1e30, 5, 2), "beyond"),
        (_column(np.nan, 5, 3), "feature not finite"),
        (_column(200, 5, 3), "remission: expected 0..1"),
    ],
)
def test_broken_scans(kitti_root, change, word):
    path = kitti_root / "training/velodyne/000000.bin"
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(DataError) as caught:
        _ = KittiDataset(root=str(kitti_root), split="train")[0]
    assert str(path) in str(caught.value)
    assert word in str(caught.value)


def test_missing_files_and_folders_in_their_place(kitti_root):
    scan = kitti_root / "training/velodyne/000000.bin"
    scan.unlink()
    with pytest.raises(DataError, match="no such file"):
        _ = KittiDataset(root=str(kitti_root), split="train")[0]
    scan.mkdir()
    with pytest.raises(DataError, match="folder"):
        _ = KittiDataset(root=str(kitti_root), split="train")[0]
    labels = kitti_root / "training/label_2/000001.txt"
    labels.unlink()
    with pytest.raises(DataError, match=r"label_2/000001\.txt"):
        _ = KittiDataset(root=str(kitti_root), split="train")[1]
    labels.write_bytes(b"\xff\xfe\x00Car")
    with pytest.raises(DataError, match="UTF-8"):
        _ = KittiDataset(root=str(kitti_root), split="train")[1]


@pytest.mark.parametrize("size", [0, 100, 20000])
def test_broken_pictures(kitti_root, size):
    path = kitti_root / "training/image_2/000000.png"
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(DataError, match=r"000000\.png"):
        _ = KittiDataset(root=str(kitti_root), split="train", image=True)[0]


def test_a_picture_that_claims_too_many_pixels(kitti_root):
    path = kitti_root / "training/image_2/000000.png"
    content = path.read_bytes()
    head = b"IHDR" + struct.pack(">II", 100_000, 100_000) + content[24:29]
    path.write_bytes(content[:12] + head + struct.pack(">I", zlib.crc32(head)) + content[33:])
    with pytest.raises(DataError, match=r"000000\.png: is not a readable picture: Image size"):
        _ = KittiDataset(root=str(kitti_root), split="train")[0]


def test_road_plane_in_the_lidar_frame(kitti_root):
    """The camera stands 1.6 m over the ground, the scanner 0.06 m higher."""
    dataset = KittiDataset(root=str(kitti_root), split="train")
    assert dataset.road_plane("000000").tolist() == pytest.approx([0, 0, 1, 1.66])
    (kitti_root / "training/planes/000001.txt").write_text("# Matrix\n")
    with pytest.raises(DataError, match="line 4"):
        dataset.road_plane("000001")


# results


def test_results_are_the_labels_again(kitti_root, tmp_path):
    """Boxes -> result lines -> boxes: what the exporter writes is what the labels said."""
    frame = KittiDataset(root=str(kitti_root), split="train")[0]
    classes = ("Car", "Pedestrian", "Cyclist")
    labels = kitti.labels_from_boxes(frame.targets.boxes, classes, frame.meta.cameras)
    kitti.write_results(tmp_path / "out" / "000000.txt", labels)
    original = kitti.read_labels(kitti_root / "training/label_2/000000.txt")
    written = kitti.read_labels(tmp_path / "out" / "000000.txt")
    for new, old in zip(written, (original[i] for i in frame.targets.boxes.row), strict=True):
        assert (new.type, new.truncation, new.occlusion, new.score) == (old.type, -1, -1, 1)
        assert new.size == pytest.approx(old.size, abs=1e-4)
        assert new.location == pytest.approx(old.location, abs=1e-4)
        assert new.rotation_y == pytest.approx(old.rotation_y, abs=1e-4)
        assert new.alpha == pytest.approx(old.rotation_y - math.atan2(old.location[0], old.location[2]), abs=1e-4)
    kitti.write_results(tmp_path / "empty.txt", [])
    assert kitti.read_labels(tmp_path / "empty.txt") == []


def test_2d_box_of_a_projected_box_by_hand(kitti_root):
    """A cube of 2 m, 10 m ahead of camera 2 on its axis: its near face is 9 m away, so 720 * 1 / 9 = 80 pixels."""
    calibration = kitti.read_calibration(kitti_root / "training/calib/000000.txt")
    cameras = calibration.cameras(1242, 375)
    shift = np.linalg.solve(calibration.p2[:, :3], calibration.p2[:, 3])
    x, y, z = np.array([0, 0, 10.0]) - shift
    cube = kitti.Label("Car", 0, 0, 0, (0, 0, 0, 0), (2, 2, 2), (x, y + 1, z), 0.0)
    boxes, _ = kitti.boxes_from_labels([cube], calibration, ["Car"])
    assert kitti.labels_from_boxes(boxes, ["Car"], cameras)[0].box2d == pytest.approx((530, 90, 690, 250), abs=1e-3)


def test_2d_boxes_at_and_behind_the_edge(kitti_root):
    cameras = kitti.read_calibration(kitti_root / "training/calib/000000.txt").cameras(1242, 375)
    level = np.array(
        [
            [0.5, 0, -1, 6, 2, 1.5, 0.0],  # reaches from behind the camera to 3.5 m ahead, under it
            [-20, 0, 0, 4, 2, 1.5, 0.0],  # behind
            [10, 60, 0, 4, 2, 1.5, 0.0],  # far to the left of the picture
            [10, 8.4, 0, 4, 2, 1.5, 0.0],  # cut by the left edge
        ]
    )
    under, behind, left, cut = kitti.project_level_boxes(level, cameras)
    assert under.tolist() == [0, pytest.approx(170 + 720 * 0.25 / 3.505, abs=0.5), 1241, 374]
    assert behind.tolist() == left.tolist() == [0, 0, 0, 0]
    assert cut[0] == 0 < cut[2] < 300


def test_results_without_calibration_say_so():
    with pytest.raises(DataError, match="read_calibration"):
        kitti.labels_from_boxes(Boxes.empty(), ["Car"], {})


# real frames


def test_real_frames_and_their_labels_fit_together(real_data):
    """Near, little occluded objects hold points; projected boxes of cars lie on the labelled rectangles."""
    dataset = KittiDataset(root=str(real_data("kitti_object")), split="all")
    counts, overlaps = [], []
    for i in range(len(dataset)):
        frame = dataset[i]
        boxes = frame.targets.boxes
        inside = points_in_boxes_mask(frame.inputs["points"].xyz, boxes.tensor).sum(0)
        counts += inside[(boxes.center.norm(dim=1) < 25) & (boxes.occlusion == 0)].tolist()
        projected = kitti.project_level_boxes(kitti.level_boxes(boxes, frame.meta.cameras), frame.meta.cameras)
        a, b = torch.tensor(projected), boxes.box2d.double()
        common = (torch.minimum(a[:, 2:], b[:, 2:]) - torch.maximum(a[:, :2], b[:, :2])).clamp(min=0).prod(1)
        union = (a[:, 2:] - a[:, :2]).prod(1) + (b[:, 2:] - b[:, :2]).prod(1) - common
        overlaps += (common / union)[boxes.label == CAR].tolist()
    assert len(dataset) == 12
    assert len(overlaps) == 26
    assert len(counts) > 15
    assert min(counts) >= 10
    assert np.median(overlaps) > 0.95


def test_real_labels_survive_the_round_trip(real_data):
    root = real_data("kitti_object")
    dataset = KittiDataset(root=str(root), split="all")
    for i in range(len(dataset)):
        frame = dataset[i]
        written = kitti.labels_from_boxes(frame.targets.boxes, dataset.classes, frame.meta.cameras)
        original = kitti.read_labels(root / "training" / "label_2" / f"{frame.meta.id}.txt")
        for new, row in zip(written, frame.targets.boxes.row.tolist(), strict=True):
            assert new.type == original[row].type
            assert new.location == pytest.approx(original[row].location, abs=1e-4)
            turn = abs(new.rotation_y - original[row].rotation_y) % (2 * math.pi)
            assert min(turn, 2 * math.pi - turn) < 1e-5
            assert abs(new.alpha - original[row].alpha) < 0.05
