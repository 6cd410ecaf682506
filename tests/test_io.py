"""Scans and pictures of every format are read exactly; every broken file is a DataError that names it."""

from __future__ import annotations

import errno
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from lidarfw.errors import DataError
from lidarfw.io import Scan, read_image, read_points

RNG = np.random.default_rng(0)
POINTS = np.concatenate([RNG.normal(0, 20, (100, 3)), RNG.uniform(0, 1, (100, 1))], 1).astype(np.float32)
PLY = {
    "ply_ascii": ("ascii", lambda p: "\n".join(" ".join(f"{v!r}" for v in row.tolist()) for row in p).encode()),
    "ply_little": ("binary_little_endian", lambda p: p.astype("<f4").tobytes()),
    "ply_big": ("binary_big_endian", lambda p: p.astype(">f4").tobytes()),
}


def pack_lzf(data: bytes) -> bytes:
    """LZF by the book: literals, and a back reference wherever the last 3 bytes stood before."""
    out, literals, seen, at = bytearray(), bytearray(), {}, 0

    def flush() -> None:
        while literals:
            piece = bytes(literals[:32])
            del literals[:32]
            out.append(len(piece) - 1)
            out.extend(piece)

    while at < len(data):
        before = seen.get(data[at : at + 3], -1)
        seen[data[at : at + 3]] = at
        distance, length = at - before - 1, 0
        while before >= 0 and length < 264 and at + length < len(data) and data[before + length] == data[at + length]:
            length += 1
        if before < 0 or length < 3 or distance >= 1 << 13:
            literals.append(data[at])
            at += 1
            continue
        flush()
        code = length - 2
        out.append(min(code, 7) << 5 | distance >> 8)
        if code >= 7:
            out.append(code - 7)
        out.append(distance & 255)
        at += length
    flush()
    return bytes(out)


def pcd(points: np.ndarray, kind: str, body: bytes, **changes: str) -> bytes:
    header = {
        "VERSION": "0.7",
        "FIELDS": "x y z intensity",
        "SIZE": "4 4 4 4",
        "TYPE": "F F F F",
        "COUNT": "1 1 1 1",
        "WIDTH": str(len(points)),
        "HEIGHT": "1",
        "POINTS": str(len(points)),
        "DATA": kind,
    } | changes
    return "".join(f"{key} {value}\n" for key, value in header.items()).encode() + body


def encode(points: np.ndarray, name: str) -> tuple[str, bytes]:
    """File name and content of the points (N, 4) in a format."""
    little = points.astype("<f4").tobytes()
    if name == "bin":
        return "scan.bin", little
    if name == "pcd_ascii":
        return "scan.pcd", pcd(points, "ascii", PLY["ply_ascii"][1](points))
    if name == "pcd_binary":
        return "scan.pcd", pcd(points, "binary", little)
    if name == "pcd_compressed":
        packed = pack_lzf(points.astype("<f4").T.tobytes())
        sizes = np.array([len(packed), len(little)], "<u4").tobytes()
        return "scan.pcd", pcd(points, "binary_compressed", sizes + packed)
    kind, body = PLY[name]
    properties = "".join(f"property float {n}\n" for n in ("x", "y", "z", "intensity"))
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    return "scan.ply", head.encode() + body(points)


FORMATS = ["bin", "pcd_ascii", "pcd_binary", "pcd_compressed", *PLY]


def save(folder: Path, name: str, points: np.ndarray = POINTS) -> Path:
    if name in ("npy", "npz"):
        path = folder / f"scan.{name}"
        np.save(path, points) if name == "npy" else np.savez_compressed(path, points=points)
        return path
    file, content = encode(points, name)
    (folder / file).write_bytes(content)
    return folder / file


@pytest.mark.parametrize("name", [*FORMATS, "npy", "npz"])
@pytest.mark.parametrize("count", [1, 100])
def test_every_format_gives_the_same_numbers(tmp_path: Path, name: str, count: int) -> None:
    scan = read_points(save(tmp_path, name, POINTS[:count]))
    np.testing.assert_array_equal(scan.xyz, POINTS[:count, :3])
    np.testing.assert_array_equal(scan.features, POINTS[:count, 3:])
    assert scan.names == ("intensity",)
    assert scan.xyz.dtype == scan.features.dtype == np.float32


def test_repetitive_data_is_unpacked(tmp_path: Path) -> None:
    """Back references that overlap their own output (runs) and long ones."""
    points = np.repeat(POINTS[:3], 700, 0)
    np.testing.assert_array_equal(read_points(save(tmp_path, "pcd_compressed", points)).xyz, points[:, :3])


def test_an_archive_of_several_arrays_is_read_by_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "scan.npz", other=np.zeros((4, 4)), points=POINTS)
    np.testing.assert_array_equal(read_points(tmp_path / "scan.npz").xyz, POINTS[:, :3])


def test_structured_numpy_goes_by_names(tmp_path: Path) -> None:
    table = np.zeros(2, [("ring", "u2"), ("z", "f8"), ("y", "f8"), ("x", "f8"), ("intensity", "u1")])
    table["x"], table["ring"], table["intensity"] = [1, 2], [5, 6], [7, 8]
    np.save(tmp_path / "a.npy", table)
    scan = read_points(tmp_path / "a.npy")
    assert scan.names == ("intensity", "ring")
    assert scan.features.tolist() == [[7, 5], [8, 6]]
    assert scan.xyz.tolist() == [[1, 0, 0], [2, 0, 0]]


def test_nuscenes_files_have_five_columns_and_others_can_be_told(tmp_path: Path) -> None:
    five = np.concatenate([POINTS, np.ones((100, 1), np.float32)], 1)
    for name, columns in (("a.pcd.bin", None), ("a.bin", 5)):
        (tmp_path / name).write_bytes(five.tobytes())
        scan = read_points(tmp_path / name, columns=columns)
        assert scan.names == ("intensity", "ring")
        np.testing.assert_array_equal(scan.features[:, 1], 1)


def test_pcd_paddings_colours_and_order_of_fields(tmp_path: Path) -> None:
    dtype = [("p", "u1", 4), ("z", "<f4"), ("y", "<f4"), ("x", "<f8"), ("rgb", "<f4"), ("ring", "<u2"), ("i", "<f4")]
    table = np.zeros(3, dtype)
    table["x"], table["i"], table["ring"], table["rgb"] = [1, 2, 3], [0.5, 0.25, 0], [7, 8, 9], np.nan
    changes = {
        "FIELDS": "_ z y x rgb ring intensity",
        "SIZE": "1 4 4 8 4 2 4",
        "TYPE": "U F F F F U F",
        "COUNT": "4 1 1 1 1 1 1",
    }
    (tmp_path / "a.pcd").write_bytes(pcd(table, "binary", table.tobytes(), **changes))
    scan = read_points(tmp_path / "a.pcd")
    assert scan.names == ("intensity", "ring")
    assert scan.xyz[:, 0].tolist() == [1, 2, 3]
    assert scan.features.tolist() == [[0.5, 7], [0.25, 8], [0, 9]]


def test_ply_elements_around_the_vertices(tmp_path: Path) -> None:
    head = (
        b"ply\nformat binary_little_endian 1.0\ncomment x\nelement camera 2\nproperty double f\nelement vertex 1\n"
        b"property float x\nproperty float y\nproperty float z\nelement face 1\n"
        b"property list uchar int vertex_indices\nend_header\n"
    )
    body = np.zeros(2, "<f8").tobytes() + np.array([1, 2, 3], "<f4").tobytes() + b"\x01\x00\x00\x00\x00"
    (tmp_path / "a.ply").write_bytes(head + body)
    scan = read_points(tmp_path / "a.ply")
    assert scan.xyz.tolist() == [[1, 2, 3]]
    assert scan.features.shape == (1, 0)


def test_five_million_points(tmp_path: Path) -> None:
    points = np.ones((5_000_000, 4), np.float32)
    assert read_points(save(tmp_path, "bin", points)).xyz.shape == (5_000_000, 3)


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_cut_at_any_place_is_an_error(tmp_path: Path, name: str) -> None:
    path = save(tmp_path, name)
    whole = path.read_bytes()
    end = len(whole) - (1 if name == "bin" else 20)  # a text file may end in the middle of its last number
    for cut in np.unique(np.random.default_rng(1).integers(0, end, 30)):
        cut = cut + 1 if name == "bin" and cut % 16 == 0 else cut  # a table without header is whole at each record
        path.write_bytes(whole[:cut])
        with pytest.raises(DataError, match=path.name):
            read_points(path)


@pytest.mark.parametrize("name", [*FORMATS, "npy", "npz"])
def test_random_damage_is_an_error_or_gives_finite_points(tmp_path: Path, name: str) -> None:
    path = save(tmp_path, name)
    whole, rng = bytearray(path.read_bytes()), np.random.default_rng(2)
    for _ in range(100):
        broken = bytearray(whole)
        for at in rng.integers(0, len(whole), 3):
            broken[at] = rng.integers(0, 256)
        path.write_bytes(broken)
        try:
            scan = read_points(path)
        except DataError:
            continue
        assert np.isfinite(scan.xyz).all()
        assert np.isfinite(scan.features).all()


def bad_points(row: int, column: int, value: float) -> np.ndarray:
    points = POINTS.copy()
    points[row, column] = value
    return points


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (bad_points(3, 0, np.nan), "1 with x, y, z not finite, of 100 points"),
        (bad_points(3, 2, np.inf), "1 with x, y, z not finite"),
        (bad_points(5, 1, 1e30), "1 with x, y, z beyond 100 km"),
        (bad_points(5, 3, np.nan), "1 with a feature not finite"),
    ],
)
def test_bad_points_are_counted_and_can_be_dropped(tmp_path: Path, points: np.ndarray, message: str) -> None:
    path = save(tmp_path, "bin", points)
    with pytest.raises(DataError, match=message):
        read_points(path)
    assert len(read_points(path, repair=True).xyz) == 99


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_scan_without_a_usable_point_is_an_error_even_repaired(tmp_path: Path, value: float) -> None:
    with pytest.raises(DataError, match="no point is usable"):
        read_points(save(tmp_path, "bin", np.full((50, 4), value, np.float32)), repair=True)


def _broken_files() -> dict[str, tuple[str, bytes, str]]:
    good = pcd(POINTS, "binary", POINTS.tobytes())
    ply = encode(POINTS, "ply_ascii")[1]
    return {
        "empty": ("a.bin", b"", "0 bytes"),
        "wrong columns": ("a.bin", POINTS[:99].tobytes() + bytes(4 * 99), "fits 5 columns|multiple of 16"),
        "suffix": ("a.xyz", b"1 2 3", "no scan format"),
        "not pcd": ("a.pcd", b"hello\n" * 3, "no PCD header"),
        "pcd kind": ("a.pcd", good.replace(b"DATA binary", b"DATA morse"), "morse"),
        "pcd fields": ("a.pcd", good.replace(b"SIZE 4 4 4 4", b"SIZE 4 4 4"), "do not fit together"),
        "pcd type": ("a.pcd", good.replace(b"TYPE F F F F", b"TYPE F F F Q"), "TYPE Q"),
        "pcd count": ("a.pcd", good.replace(b"POINTS 100", b"POINTS -1"), "whole number"),
        "pcd no z": ("a.pcd", good.replace(b"x y z", b"x y w"), "no field z"),
        "pcd twice": ("a.pcd", good.replace(b"x y z intensity", b"x y z z"), "not a readable .pcd file: field 'z'"),
        "pcd negative": ("a.pcd", good.replace(b"COUNT 1 1 1 1", b"COUNT 1 1 1 -1"), "not a readable .pcd file"),
        "pcd too many": ("a.pcd", pcd(POINTS, "ascii", b"1 2 3 4").replace(b"S 100", b"S 1" + b"0" * 25), "too large"),
        "pcd no points": ("a.pcd", pcd(POINTS[:0], "binary", b""), "no points"),
        "not ply": ("a.ply", b"plx", "no PLY header"),
        "ply format": ("a.ply", ply.replace(b"ascii", b"cuneiform"), "cuneiform"),
        "ply type": ("a.ply", ply.replace(b"float z", b"quad z"), "quad"),
        "ply text": ("a.ply", ply.replace(b"0.", b"zero.", 1), "not a number"),
        "ply no vertex": ("a.ply", ply.replace(b"vertex", b"corner"), "no element `vertex`"),
        "ply too many": ("a.ply", ply.replace(b"vertex 100", b"vertex 1" + b"0" * 25), "not a readable .ply file"),
        "ply list": ("a.ply", ply.replace(b"property float x", b"property list uchar float x"), "list"),
        "npy": ("a.npy", b"\x93NUMPY nothing", "not a readable .npy"),
        "npz": ("a.npz", b"PK\x03\x04 nothing", "not a readable .npz"),
    }


@pytest.mark.parametrize("case", _broken_files())
def test_broken_files(tmp_path: Path, case: str) -> None:
    name, content, message = _broken_files()[case]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        read_points(tmp_path / name)
    assert name in str(caught.value)
    assert len(str(caught.value).splitlines()) <= 10


def test_numpy_files_with_objects_or_wrong_shapes_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "object.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.save(tmp_path / "flat.npy", np.zeros(30))
    np.save(tmp_path / "text.npy", np.array([["a", "b", "c"]]))
    np.save(tmp_path / "words.npy", np.array([("a", "b", "c")], [("x", "U1"), ("y", "U1"), ("z", "U1")]))
    np.savez(tmp_path / "two.npz", first=np.zeros((5, 3)), second=np.zeros((5, 3)))
    for name, message in {
        "object.npy": "not a readable",
        "flat.npy": r"shape \(30,\)",
        "text.npy": "expected numbers",
        "words.npy": "not a readable .npy file: could not convert string to float",
        "two.npz": "expected an array `points`",
    }.items():
        with pytest.raises(DataError, match=message):
            read_points(tmp_path / name)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_points(tmp_path / "none.bin")
    (tmp_path / "folder.bin").mkdir()
    with pytest.raises(DataError, match="is a folder"):
        read_points(tmp_path / "folder.bin")


def test_a_file_that_may_not_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> bytes:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refuse)  # a superuser may read what is forbidden to others
    with pytest.raises(DataError, match=r"scan.bin: cannot be read: Permission denied"):
        read_points(tmp_path / "scan.bin")


def test_pictures(tmp_path: Path) -> None:
    picture = np.zeros((20, 30, 3), np.uint8)
    picture[:, :15] = (255, 0, 0)
    for name in ("a.png", "a.jpg"):
        cv2.imwrite(str(tmp_path / name), picture[..., ::-1])
        assert np.abs(read_image(tmp_path / name).astype(int) - picture).mean() < 8
        content = (tmp_path / name).read_bytes()
        for cut in (0, 1, len(content) // 2, len(content) - 20):
            (tmp_path / name).write_bytes(content[:cut])
            with pytest.raises(DataError, match=name):
                read_image(tmp_path / name)
    cv2.imwrite(str(tmp_path / "grey.png"), picture[..., 0])
    assert read_image(tmp_path / "grey.png").shape == (20, 30, 3)


def test_pictures_that_claim_too_many_pixels(tmp_path: Path) -> None:
    png, tiff = (bytes(cv2.imencode(suffix, np.zeros((4, 4, 3), np.uint8))[1]) for suffix in (".png", ".tiff"))
    head = b"IHDR" + struct.pack(">II", 100_000, 100_000) + png[24:29]
    width = struct.pack("<HHI", 256, 4, 1)  # the tag, as uint32, of one value
    files = {
        "a.png": png[:12] + head + struct.pack(">I", zlib.crc32(head)) + png[33:],
        "a.tiff": tiff.replace(struct.pack("<HHII", 256, 3, 1, 4), width + struct.pack("<I", 2**20 + 1)),
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=f"{name}: cannot be decoded .* too many pixels"):
            read_image(tmp_path / name)


def test_real_scans(real_data: Callable[[str], Path]) -> None:
    scan: Scan = read_points(real_data("kitti_object/training/velodyne/000001.bin"))
    assert scan.names == ("intensity",)
    assert scan.features.min() >= 0
    assert scan.features.max() <= 1
    picture = read_image(real_data("kitti_object/training/image_2/000001.jpg"))
    assert picture.shape == (375, 1242, 3)
