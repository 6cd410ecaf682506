"""Reading scans (.bin, .pcd, .ply, .npy, .npz) and pictures. A broken file is a DataError that says what is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarfw.errors import DataError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
FARTHEST = 1e5  # metres; float32 has no centimetres beyond, and no sensor looks as far
_INTENSITY = ("intensity", "i", "reflectance", "reflectivity", "remission", "scalar_intensity")
_COLOURS = ("rgb", "rgba")  # bytes packed in a float, not numbers
_BIN_NAMES = {3: (), 4: ("intensity",), 5: ("intensity", "ring")}  # after x, y, z: KITTI 4, nuScenes 5


@dataclass(frozen=True)
class Scan:
    """The points of a file, in the frame and units of the file."""

    xyz: np.ndarray  # (N, 3) float32, metres
    features: np.ndarray  # (N, C) float32, as in the file; intensity comes first
    names: tuple[str, ...]  # of the features, length C


def read_points(path: str | Path, columns: int | None = None, repair: bool = False) -> Scan:
    """The scan in a file; the suffix says the format.

    `columns` of a .bin file: float32 values per point, by default 4 (KITTI), or 5 for .pcd.bin (nuScenes).
    `repair` drops points that are not finite, or farther than 100 km, which else are an error.
    Raises DataError for a file that is missing, unreadable, empty, cut off or of another format.
    """
    return _checked(Path(path), _read(Path(path), columns), repair)


def usable_points(path: str | Path, columns: int | None = None) -> np.ndarray:
    """(N,) which points of a file `repair` keeps. DataError as `read_points`."""
    return _usable(_read(Path(path), columns))


def _read(path: Path, columns: int | None) -> Scan:
    reader = SCAN_READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(f"{path}: no scan format has the suffix {path.suffix!r}; there are {', '.join(SCAN_READERS)}")
    data = _read_bytes(path)
    try:
        return _read_bin(path, data, columns) if reader is _read_bin else reader(path, data)
    except (ValueError, TypeError, OverflowError) as error:  # numpy refuses what the header says in many ways
        raise DataError(
            f"{path}: is not a readable {path.suffix} file: {error}.\n  fix: copy it again, or write it anew"
        ) from error


def read_image(path: str | Path) -> np.ndarray:
    """A picture as (H, W, 3) uint8 RGB; grey becomes RGB. The rotation tag is ignored: calibration knows only pixels.

    Raises DataError for a file that is missing, unreadable, cut off or no picture.
    """
    import cv2

    path = Path(path)
    data = _read_bytes(path)
    if data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < len(data) // 2:
        raise DataError(f"{path}: the JPEG is cut off, it has no end marker in its {len(data)} bytes; copy it again")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise DataError(
            f"{path}: cannot be decoded as a picture ({len(data)} bytes); does its header claim too many pixels?\n"
            f"  OpenCV: {error.err}\n  fix: copy it again"
        ) from error
    if picture is None:
        raise DataError(
            f"{path}: cannot be decoded as a picture ({len(data)} bytes); it is cut off or of no known format"
        )
    return np.ascontiguousarray(picture[..., ::-1])


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise DataError(f"{path}: no such file" + ("" if path.parent.is_dir() else ", nor its folder")) from None
    except IsADirectoryError:
        raise DataError(f"{path}: is a folder, expected a file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not data:
        raise DataError(f"{path}: the file is empty (0 bytes)")
    return data


def _checked(path: Path, scan: Scan, repair: bool) -> Scan:
    """The scan, or DataError if points are unusable and not to be repaired."""
    if not len(scan.xyz):
        raise DataError(f"{path}: the scan has no points")
    good = _usable(scan)
    if not good.all():
        if not repair:
            raise DataError(_describe_bad(path, scan))
        scan = Scan(scan.xyz[good], scan.features[good], scan.names)
    if not scan.xyz.any():
        raise DataError(f"{path}: no point is usable: all {len(good)} are at the origin, not finite or beyond 100 km")
    return scan


def _near(scan: Scan) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        near: np.ndarray = (np.abs(scan.xyz) < FARTHEST).all(1)  # False for NaN
    return near


def _usable(scan: Scan) -> np.ndarray:
    usable: np.ndarray = _near(scan) & np.isfinite(scan.features).all(1)
    return usable


def _describe_bad(path: Path, scan: Scan) -> str:
    near, finite = _near(scan), np.isfinite(scan.xyz).all(1)
    counts = {
        "x, y, z not finite": (~finite).sum(),
        "x, y, z beyond 100 km": (finite & ~near).sum(),
        "a feature not finite": (near & ~np.isfinite(scan.features).all(1)).sum(),
    }
    found = ", ".join(f"{count} with {what}" for what, count in counts.items() if count)
    return f"{path}: {found}, of {len(near)} points. Fix: repair the file, or drop these points with --repair"


def _from_fields(path: Path, fields: dict[str, np.ndarray]) -> Scan:
    """Scan from named columns (N,): x, y, z are needed, intensity is moved to the front of the rest."""
    lower = {name.lower(): values for name, values in fields.items()}
    missing = [axis for axis in "xyz" if axis not in lower]
    if missing:
        raise DataError(f"{path}: has no field {', '.join(missing)}; its fields are {', '.join(fields) or 'none'}")
    names = [name for name in lower if name not in ("x", "y", "z", *_COLOURS)]
    names.sort(key=lambda name: name not in _INTENSITY)
    with np.errstate(over="ignore"):
        xyz = np.stack([lower[axis].astype(np.float32) for axis in "xyz"], 1)
        features = [lower[name].astype(np.float32) for name in names]
    return Scan(xyz, np.stack(features, 1) if names else np.zeros((len(xyz), 0), np.float32), tuple(names))


def _from_table(path: Path, table: np.ndarray) -> Scan:
    """Scan from (N, C >= 3) numbers x, y, z, then features; a structured array goes by its field names."""
    if table.dtype.names:
        return _from_fields(path, {name: table[name].ravel() for name in table.dtype.names})
    if table.ndim != 2 or table.shape[1] < 3 or table.dtype.kind not in "fiu":
        raise DataError(f"{path}: expected numbers of shape (N, 3 or more), found {table.dtype} of shape {table.shape}")
    names = _BIN_NAMES.get(table.shape[1], tuple(f"column_{i}" for i in range(3, table.shape[1])))
    with np.errstate(over="ignore"):
        table = table.astype(np.float32)
    return Scan(table[:, :3], table[:, 3:], names)


def _read_bin(path: Path, data: bytes, columns: int | None = None) -> Scan:
    """Little-endian float32 without a header."""
    count = columns or (5 if path.name.lower().endswith(".pcd.bin") else 4)
    if count < 3:
        raise DataError(f"{path}: {count} columns asked for, a point has at least x, y, z")
    if len(data) % (4 * count):
        fits = [str(other) for other in (3, 4, 5, 6) if len(data) % (4 * other) == 0]
        hint = f"; the size fits {' or '.join(fits)} columns" if fits else "; it is cut off or no float32 table"
        raise DataError(f"{path}: {len(data)} bytes is not a multiple of {4 * count} (float32 x {count} columns){hint}")
    return _from_table(path, np.frombuffer(data, "<f4").reshape(-1, count))


def _read_npy(path: Path, data: bytes) -> Scan:
    """One array, or in .npz the array `points`, or the only one with two dimensions."""
    import io

    try:
        loaded = np.load(io.BytesIO(data), allow_pickle=False)
        arrays = {"points": loaded} if isinstance(loaded, np.ndarray) else {n: loaded[n] for n in loaded.files}
    except Exception as error:  # numpy's header parser, zipfile and zlib raise a dozen kinds on broken bytes
        raise DataError(f"{path}: is not a readable {path.suffix} file: {error}") from error
    tables = [name for name, array in arrays.items() if array.ndim == 2 and array.shape[1] >= 3]
    if "points" not in arrays and len(tables) != 1:
        found = ", ".join(f"{name} {array.shape}" for name, array in arrays.items()) or "nothing"
        raise DataError(f"{path}: expected an array `points` of shape (N, 3 or more), found {found}")
    return _from_table(path, arrays["points" if "points" in arrays else tables[0]])


def _read_pcd(path: Path, data: bytes) -> Scan:
    """Point Cloud Data 0.7: ascii, binary and binary_compressed (columns one after another, LZF)."""
    header, kind, body = _pcd_header(path, data)
    dtype = _pcd_dtype(path, header)
    count = _whole(path, "POINTS", header.get("POINTS", ["0"])[0])
    if kind == "ascii":
        return _from_fields(path, _pcd_fields(_ascii_table(path, body, dtype, count)))
    if kind == "binary":
        _expect_bytes(path, body, count * dtype.itemsize)
        return _from_fields(path, _pcd_fields(np.frombuffer(body, dtype, count)))
    if kind != "binary_compressed":
        raise DataError(f"{path}: DATA is {kind!r}, expected ascii, binary or binary_compressed")
    _expect_bytes(path, body, 8)
    packed, unpacked = (int(size) for size in np.frombuffer(body, "<u4", 2))
    _expect_bytes(path, body[8:], packed)
    if unpacked != count * dtype.itemsize:
        raise DataError(f"{path}: {unpacked} bytes unpacked, {count} points need {count * dtype.itemsize}")
    return _from_fields(path, _pcd_fields(_columns(_lzf_unpack(path, body[8 : 8 + packed], unpacked), dtype, count)))


def _pcd_header(path: Path, data: bytes) -> tuple[dict[str, list[str]], str, bytes]:
    """Header entries, the kind of data, and the bytes after the header."""
    header: dict[str, list[str]] = {}
    start = 0
    while (end := data.find(b"\n", start)) >= 0 and len(header) < 32:
        words = data[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and words[0] == "DATA":
            return header, words[1].lower() if len(words) > 1 else "", data[start:]
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    raise DataError(f"{path}: has no PCD header that ends with a DATA line")


def _pcd_dtype(path: Path, header: dict[str, list[str]]) -> np.dtype:
    """Record of one point. Paddings (`_`) and fields of several values get names that `_pcd_fields` leaves out."""
    names = header.get("FIELDS", [])
    rows = [names, header.get("SIZE", []), header.get("TYPE", []), header.get("COUNT", ["1"] * len(names))]
    if not names or len({len(row) for row in rows}) != 1:
        raise DataError(f"{path}: FIELDS, SIZE, TYPE and COUNT of the header do not fit together: {rows}")
    record = []
    for number, (name, size, kind, count) in enumerate(zip(*rows, strict=True)):
        used = name if count == "1" and name != "_" else f"_{number}"
        try:
            record.append((used, np.dtype("<" + {"F": "f", "I": "i", "U": "u"}[kind] + size), (int(count),)))
        except (KeyError, TypeError, ValueError):
            raise DataError(f"{path}: field {name} has TYPE {kind}, SIZE {size}, COUNT {count}") from None
    return np.dtype(record)


def _pcd_fields(table: np.ndarray) -> dict[str, np.ndarray]:
    return {name: table[name][:, 0] for name in table.dtype.names or () if not name.startswith("_")}


def _columns(data: bytes, dtype: np.dtype, count: int) -> np.ndarray:
    """Records whose fields stand one after another instead of interleaved."""
    table = np.empty(count, dtype)
    start = 0
    for name in dtype.names or ():
        field = dtype[name]
        values = np.frombuffer(data, field.base, count * field.shape[0], start)
        table[name] = values.reshape(count, -1)
        start += count * field.itemsize
    return table


def _lzf_unpack(path: Path, data: bytes, size: int) -> bytes:
    """Undo LZF: a control byte below 32 precedes that many + 1 literals, any other says length and distance back."""
    out = bytearray()
    position, end = 0, len(data)
    try:
        while position < end:
            control = data[position]
            position += 1
            if control < 32:
                out += data[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[position]
                position += 1
            start = len(out) - ((control & 31) << 8) - data[position] - 1
            position += 1
            length += 2
            if start < 0:
                raise IndexError
            piece = out[start : start + length]
            out += piece if len(piece) == length else (piece * (length // len(piece) + 1))[:length]
    except IndexError:
        raise DataError(f"{path}: the compressed data is broken at byte {position} of {end}") from None
    if len(out) != size:
        raise DataError(f"{path}: the compressed data gives {len(out)} bytes, expected {size}")
    return bytes(out)


_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip


def _read_ply(path: Path, data: bytes) -> Scan:
    """The `vertex` element of a polygon file: ascii, binary little and big endian."""
    kind, elements, body = _ply_header(path, data)
    for name, count, dtype in elements:
        if name == "vertex":
            break
        if dtype is None:
            raise DataError(f"{path}: the element {name!r} before the vertices has lists, which are not supported")
        body = body.split(b"\n", count)[-1] if kind == "ascii" else body[count * dtype.itemsize :]
    else:
        raise DataError(f"{path}: has no element `vertex`, only {', '.join(name for name, *_ in elements) or 'none'}")
    if dtype is None:
        raise DataError(f"{path}: the vertices have list properties, which are not supported")
    if kind == "ascii":
        table = _ascii_table(path, body, dtype, count)
    else:
        _expect_bytes(path, body, count * dtype.itemsize)
        table = np.frombuffer(body, dtype, count)
    return _from_fields(path, {name: table[name] for name in dtype.names or ()})


def _ply_header(path: Path, data: bytes) -> tuple[str, list[tuple[str, int, np.dtype | None]], bytes]:
    """Format, elements (name, count, record; None for one with lists), and the bytes after the header."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise DataError(f"{path}: has no PLY header from `ply` to `end_header`")
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()]
    kind = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "missing")
    order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}.get(kind)
    if order is None:
        raise DataError(
            f"{path}: the PLY format is {kind!r}, expected ascii or binary_little_endian or binary_big_endian"
        )
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in lines:
        if words[:1] == ["element"] and len(words) == 3:
            elements.append((words[1], _whole(path, f"element {words[1]}", words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(words[1:])
    body = data[data.index(b"\n", end) + 1 :] if b"\n" in data[end:] else b""
    return kind, [(name, count, _ply_dtype(path, rows, order)) for name, count, rows in elements], body


def _ply_dtype(path: Path, properties: list[list[str]], order: str) -> np.dtype | None:
    if any(words[:1] == ["list"] for words in properties):
        return None
    try:
        return np.dtype([(words[1], order + _PLY_TYPES[words[0]]) for words in properties])
    except (KeyError, IndexError, ValueError):
        raise DataError(f"{path}: cannot read the properties {properties}") from None


def _whole(path: Path, what: str, text: str) -> int:
    if not text.isdigit():
        raise DataError(f"{path}: {what} must be a whole number, found {text!r}")
    return int(text)


def _expect_bytes(path: Path, data: bytes, size: int) -> None:
    if len(data) < size:
        raise DataError(f"{path}: the file is cut off: {size} bytes expected after the header, found {len(data)}")


def _ascii_table(path: Path, body: bytes, dtype: np.dtype, count: int) -> np.ndarray:
    """`count` records of numbers written as text, one per line."""
    width = sum(dtype[name].shape[0] if dtype[name].shape else 1 for name in dtype.names or ())
    words = body.split(None, count * width)[: count * width]
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise DataError(f"{path}: the text has something that is not a number: {error}") from error
    if len(numbers) < count * width:
        raise DataError(f"{path}: the file is cut off: {count} points x {width} values expected, found {len(numbers)}")
    table, start = np.empty(count, dtype), 0
    for name in dtype.names or ():
        shape = dtype[name].shape
        columns = numbers.reshape(count, width)[:, start : start + (shape[0] if shape else 1)]
        table[name] = columns if shape else columns[:, 0]
        start += columns.shape[1]
    return table


SCAN_READERS: dict[str, Callable[[Path, bytes], Scan]] = {
    ".bin": _read_bin,
    ".pcd": _read_pcd,
    ".ply": _read_ply,
    ".npy": _read_npy,
    ".npz": _read_npy,
}
