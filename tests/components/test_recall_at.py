"""Metric `recall_at`."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidarfw.components.metrics.recall_at import QUERIES, RecallAt, precision_recall
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import Descriptors, FrameMeta, Poses, Spec, Targets

pytestmark = pytest.mark.filterwarnings("ignore:The ``compute`` method of metric RecallAt was called before")
Visit = tuple[str, float, float, float]  # sequence, time, x, descriptor (a number on a line)


def fed(visits: list[Visit], batch: int = 1, **options: object) -> RecallAt:
    metric = RecallAt(Spec(Descriptors, channels=2), **options)
    for start in range(0, len(visits), batch):
        part = visits[start : start + batch]
        matrix = torch.eye(4).repeat(len(part), 1, 1)
        matrix[:, 0, 3] = torch.tensor([x for _, _, x, _ in part])
        ok = torch.ones(len(part), dtype=torch.bool)
        vector = torch.tensor([[value, 1.0] for _, _, _, value in part])
        meta = [FrameMeta(f"{start + i}", name, 0, time) for i, (name, time, _, _) in enumerate(part)]
        metric.update(Descriptors(vector), Targets(poses=Poses(matrix, ok, ok.float())), meta)
    return metric


def figures(visits: list[Visit], batch: int = 1, **options: object) -> dict[str, float]:
    return fed(visits, batch, **options).compute()


MAP: list[Visit] = [("map", i, 20.0 * i, float(i)) for i in range(10)]


def test_golden() -> None:
    """Three queries in a map of ten places 20 m apart: found first, found third, and one that is nowhere."""
    queries = [("query", 0, 41.0, 2.1), ("query", 1, 99.0, 2.6), ("query", 2, 500.0, 8.4)]
    found = figures([*MAP, *queries], map_sequences=["map"], radii=(5.0, 25.0), counts=(1, 3, 5))
    assert (found["queries"], found["revisits_5m"], found["revisits_25m"]) == (3, 2, 2)
    # 99 m is at place 5, which comes after 3, 2 and 4: rank 4; with 25 m place 4 is right too: rank 3
    assert [found[f"recall@{count}_5m"] for count in (1, 3, 5)] == [0.5, 0.5, 1]
    assert [found[f"recall@{count}_25m"] for count in (1, 3, 5)] == [0.5, 1, 1]
    assert found["recall@1"] == found["recall@1%_5m"] == 0.5
    # best matches by distance: 0.1 right, then 0.4 twice, both wrong
    assert found["ap_5m"] == pytest.approx(0.5)
    assert found["f1_5m"] == pytest.approx(2 * 1 * 0.5 / 1.5)
    everything = figures([*MAP, *queries], map_sequences=["map"], revisits_only=False)
    assert everything["recall@1_5m"] == pytest.approx(1 / 3)


def test_loops_in_a_sequence() -> None:
    """The frame just before is always near; only those older than the gap count."""
    drive = [("a", float(t), 2.0 * t, float(t)) for t in range(50)]
    assert figures(drive)["revisits_10m"] == 0
    back = [("a", 100.0 + t, 2.0 * t, t + 0.1) for t in range(50)]
    found = figures(drive + back)
    assert found["revisits_5m"] == 50
    assert (found["recall@1"], found["ap_5m"], found["f1_5m"]) == (1, 1, 1)
    # the same places in another sequence are not searched
    assert figures(drive + [("b", t, x, d) for _, t, x, d in back])["revisits_5m"] == 0


def test_a_hundredth_of_the_map() -> None:
    places = [("map", 0.0, 1000.0 + i, float(i)) for i in range(399)]
    hidden = ("map", 0.0, 0.0, 3.6)  # right, but after 4, which is nearer to the query 4.0, or 3, 5 and so on
    for value, rank in ((3.65, 1), (4.0, 2), (4.4, 3), (4.9, 4), (5.4, 5)):
        found = figures([*places, hidden, ("q", 0.0, 0.0, value)], batch=100, map_sequences=["map"], counts=(1, 3))
        assert found["recall@1%_5m"] == float(rank <= 4), (value, rank)
        assert found["recall@3_5m"] == float(rank <= 3)


def test_a_map_that_was_not_evaluated_is_no_recall_of_nothing() -> None:
    with pytest.raises(ConfigError, match=r"are elsewhere, but none of the 10 frames"):
        figures(MAP, map_sequences=["elsewhere"])
    assert figures([], map_sequences=["elsewhere"])["recall@1"] == 0


def test_equal_descriptors_find_nothing() -> None:
    """A collapsed network gives one vector for all: no place may count as found."""
    found = figures([*[(s, t, x, 1.0) for s, t, x, _ in MAP], ("q", 0.0, 0.0, 1.0)], map_sequences=["map"])
    assert (found["recall@1"], found["recall@5_5m"], found["ap_5m"], found["revisits_5m"]) == (0, 0, 0, 1)


def test_precision_recall_steps() -> None:
    distance = torch.tensor([0.3, 0.1, 0.2, 0.2])
    precision, recall = precision_recall(distance, torch.tensor([True, True, False, True]), 4)
    assert precision.tolist() == pytest.approx([1, 2 / 3, 3 / 4])
    assert recall.tolist() == [0.25, 0.5, 0.75]
    assert len(precision_recall(distance[:0], distance[:0] > 0, 0)[0]) == 0


def test_nothing_is_finite() -> None:
    for visits in ([], MAP[:1], MAP):
        assert set(figures(visits).values()) == {0.0}
    metric = fed(MAP, map_sequences=["map"])
    metric.update(Descriptors(torch.ones(1, 2)), Targets(), [FrameMeta("")])
    assert metric.compute()["queries"] == 0


def test_frames_without_a_true_pose_are_left_out() -> None:
    metric = fed(MAP, map_sequences=["map"])
    lost = Poses(torch.eye(4)[None], torch.tensor([False]), torch.zeros(1))
    metric.update(Descriptors(torch.ones(1, 2)), Targets(poses=lost), [FrameMeta("", "q")])
    assert metric.compute()["queries"] == 0


def test_user_errors() -> None:
    for options in ({"radii": []}, {"radii": [0]}, {"counts": [0]}):
        with pytest.raises(ConfigError, match="above 0"):
            fed([], **options)
    with pytest.raises(DataError, match="frame 0: its descriptor holds NaN"):
        fed([("a", 0.0, 0.0, float("nan"))])


def town(seed: int, count: int) -> list[Visit]:
    """A loop driven three times with noisy descriptors."""
    random = np.random.RandomState(seed)
    rows = []
    for step in range(count):
        x = 10.0 * (step % (count // 3)) + random.normal(0, 3)
        rows.append(("a", float(step), x, round(x + random.normal(0, 12))))
    return rows


@pytest.mark.parametrize("only", [True, False])
def test_equals_plain_loops(only: bool) -> None:
    visits = town(0, 120)
    found = figures(visits, batch=7, radii=[8.0], counts=[1, 5], gap=20.0, revisits_only=only)
    hits = {1: 0, 5: 0}
    queries = revisits = 0
    for number, (_, time, x, value) in enumerate(visits):
        places = [
            (abs(np.float32(v) - np.float32(value)), abs(p - x) <= 8)
            for _, t, p, v in visits[:number]
            if time - t >= 20
        ]
        if places:
            queries += 1
            revisits += any(right for _, right in places)
            order = sorted(places)  # False before True among equals
            for count in hits:
                hits[count] += any(right for _, right in order[:count])
    total = revisits if only else queries
    assert (found["queries"], found["revisits_8m"]) == (queries, revisits)
    assert [found["recall@1_8m"], found["recall@5_8m"]] == pytest.approx([hits[1] / total, hits[5] / total])


def test_more_queries_than_a_block() -> None:
    visits = town(1, QUERIES + 88)
    one = figures(visits, batch=200)
    assert one["queries"] == len(visits) - 30
    assert one["recall@1"] > 0.2
    shuffled = [visits[i] for i in np.random.RandomState(0).permutation(len(visits))]
    assert figures(shuffled, batch=100) == pytest.approx(one)


def test_reset() -> None:
    metric = fed([*MAP, ("q", 0.0, 0.0, 0.0)], map_sequences=["map"])
    assert metric.compute()["recall@1"] == 1
    metric.reset()
    assert set(metric.compute().values()) == {0.0}
