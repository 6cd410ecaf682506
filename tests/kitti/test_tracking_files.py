"""Label and result files of KITTI tracking."""

from __future__ import annotations

from pathlib import Path

import pytest

from lidarfw.errors import DataError
from lidarfw.kitti import read_tracks, write_tracks

LINES = """0 -1 DontCare -1 -1 -10.0 219.31 188.49 245.5 218.56 -1000 -1000 -1000 -10 -1 -1 -1
0 0 Van 0 0 -1.7934 296.7449 161.7522 455.226 292.3724 2 1.8233 4.4339 -4.5523 1.8585 13.4105 -2.1155
3 7 Person 2 1 0.5 1 2 3 4 1.2 0.6 0.8 1 2 3 0.1
"""


def test_round_trip(tmp_path: Path) -> None:
    (tmp_path / "in.txt").write_text(LINES)
    rows = read_tracks(tmp_path / "in.txt")
    assert [(row.frame, row.id, row.label.type) for row in rows] == [
        (0, -1, "DontCare"),
        (0, 0, "Van"),
        (3, 7, "Person"),
    ]
    assert (rows[2].label.truncation, rows[2].label.occlusion, rows[2].label.score) == (2, 1, None)
    write_tracks(tmp_path / "out.txt", rows)
    assert read_tracks(tmp_path / "out.txt") == rows
    write_tracks(tmp_path / "none.txt", [])
    assert read_tracks(tmp_path / "none.txt") == []


def test_results_have_a_score(tmp_path: Path) -> None:
    path = tmp_path / "0000.txt"
    path.write_text(LINES.splitlines()[1] + " 12.5\n")
    rows = read_tracks(path)
    assert rows[0].label.score == 12.5
    write_tracks(path, rows)
    assert read_tracks(path) == rows


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0 1 Car 0 0", "0000.txt, line 2: expected 17 columns"),
        (LINES.splitlines()[1].replace("0 0 Van", "0.5 0 Van"), "whole numbers"),
        (LINES.splitlines()[1].replace("0 0 Van", "0 -2 Van"), "whole numbers"),
        (LINES.splitlines()[1].replace("0 0 Van", "x 0 Van"), "frame: expected a finite number, found 'x'"),
        (LINES.splitlines()[1].replace("Van", "Ship"), "found 'Ship'"),
        (LINES.splitlines()[1].replace("1.8233", "-1.8233"), "positive metres"),
    ],
)
def test_damage_is_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "0000.txt"
    path.write_text(f"{LINES.splitlines()[2]}\n{line}\n")
    with pytest.raises(DataError, match=message):
        read_tracks(path)
