"""Recall across sensors against cases worked out by hand."""

from __future__ import annotations

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import Descriptors, FrameMeta, Poses, Spec, Targets

from lidarfw_crossplace.metrics import PlaceRecall, mcnemar, spaced

Row = tuple[str, float, float, str]  # sequence, time, x, modality


def metric(rows: list[Row], vectors: list[list[float]], **options: object) -> dict[str, float]:
    found = PlaceRecall(Spec(Descriptors, len(vectors[0])), **options)  # type: ignore[arg-type]
    for (sequence, time, x, modality), vector in zip(rows, vectors, strict=True):
        matrix = torch.eye(4)[None].clone()
        matrix[0, 0, 3] = x
        pose = Poses(matrix, torch.tensor([True]), torch.ones(1))
        meta = [FrameMeta(f"{sequence}{time}", sequence, time=time, modality=modality)]
        found.update(Descriptors(torch.tensor([vector]), (modality,)), Targets(poses=pose), meta)
    return found.compute()


QUERIES, MAP = (0.0, 10.0, 20.0), (0.4, 1.5, 11.2, 24.0)
ROWS: list[Row] = [("1", 0, x, "camera") for x in QUERIES] + [("2", 0, x, "lidar") for x in MAP]
POSITIONS = [[x] for x in (*QUERIES, *MAP)]


def test_perfect_ranking_reaches_the_ceiling() -> None:
    found = metric(ROWS, POSITIONS, radii=(1, 2, 5), map_sequences=("2",))
    for radius, share in ((1, 1 / 3), (2, 2 / 3), (5, 1)):
        assert found[f"2d3d_recall@1_{radius}m"] == pytest.approx(share)
        assert found[f"2d3d_ceiling_{radius}m"] == pytest.approx(share)
        assert found[f"2d3d_chance_{radius}m"] == pytest.approx({1: 1, 2: 3, 5: 4}[radius] / 4 / 3)
    assert found["2d3d_error"] == pytest.approx((0.4 + 1.2 + 4) / 3)
    assert found["2d3d_queries"] == 3
    assert not any(key.startswith("3d2d") for key in found)  # nothing queries with the LiDAR
    assert found["recall@1"] == found["2d3d_recall@1_1m"]


def test_queries_without_a_place_can_be_left_out() -> None:
    found = metric(ROWS, POSITIONS, radii=(1,), map_sequences=("2",), exclude_hopeless=True)
    assert found["2d3d_recall@1_1m"] == 1


def test_equal_descriptors_find_nothing() -> None:
    found = metric(ROWS, [[1.0]] * 7, radii=(5,), map_sequences=("2",))
    assert found["2d3d_recall@1_5m"] == 0
    assert found["2d3d_ap_5m"] == 0


def test_average_precision_falls_with_a_confident_error() -> None:
    good = metric(ROWS, [[0.0], [10], [20], [0.1], [99], [10.2], [20.3]], radii=(5,), map_sequences=("2",))
    bad = metric(ROWS, [[0.0], [10], [20], [99], [98], [10.2], [0.01]], radii=(5,), map_sequences=("2",))
    assert good["2d3d_ap_5m"] == pytest.approx(1)
    assert bad["2d3d_ap_5m"] == pytest.approx(1 / 3 * 1 / 2)  # the error comes first, the third query has no chance


def test_way_between_queries() -> None:
    x = torch.tensor([[0.0, 0], [2, 0], [4, 0], [5, 0], [7, 0], [7.5, 0]])
    assert spaced(x, 3.0).tolist() == [False, False, True, False, False, True]
    assert spaced(x[:0], 3.0).tolist() == []


def test_interleaved_and_revisits_only() -> None:
    loop = [0.0, 1, 4, 5, 8, 9, 8, 5, 4, 1, 0]
    rows: list[Row] = [("1", 10.0 * i, x, s) for i, x in enumerate(loop) for s in ("camera", "lidar")]
    vectors = [[x] for _, _, x, _ in rows]
    whole, apart = (metric(rows, vectors, radii=(2,), apart=a) for a in (0.0, 35.0))
    for name in ("2d3d", "3d2d", "2d2d", "3d3d"):
        assert whole[f"{name}_recall@1_2m"] == whole[f"{name}_ceiling_2m"]
    assert apart["2d3d_ceiling_2m"] < whole["2d3d_ceiling_2m"]
    assert apart["2d3d_recall@1_2m"] == apart["2d3d_ceiling_2m"] > 0


def test_no_frames_and_wrong_options() -> None:
    assert PlaceRecall(Spec(Descriptors, 2)).compute() == {"recall@1": 0.0}
    with pytest.raises(ConfigError, match="radii"):
        PlaceRecall(Spec(Descriptors, 2), radii=())


def test_a_map_that_was_not_evaluated_is_no_recall_of_nothing() -> None:
    with pytest.raises(ConfigError, match=r"are 3, but none of the 7 frames .* is of the map\n  fix: .*map_sequences"):
        metric(ROWS, POSITIONS, map_sequences=("3",))
    assert PlaceRecall(Spec(Descriptors, 2), map_sequences=("3",)).compute() == {"recall@1": 0.0}


def test_paired_test() -> None:
    right = torch.ones(100, dtype=torch.bool)
    assert mcnemar(right, right) == 1
    few = right.clone()
    few[:5] = False
    assert mcnemar(right, few) == pytest.approx(2 * 0.5**5)
    many = right.clone()
    many[:40] = False
    assert mcnemar(right, many) == pytest.approx(7.1e-10, rel=0.1)  # chi-squared 39^2 / 40, one degree of freedom
