"""Training batches of pairs of frames that were taken near to each other."""

from __future__ import annotations

import numpy as np
import pytest

from lidarfw.data import DataModule, PairOrder
from lidarfw.errors import ConfigError
from lidarfw.testing import SyntheticDataset

PLACES = np.array([[0.0, 0, 0], [5, 0, 0], [100, 0, 0], [104, 0, 0], [108, 0, 0], [500, 0, 0]])


def order(epoch: int = 0, **options: int) -> list[int]:
    found = PairOrder(PLACES, 6.0, 4, seed=1, **options)
    found.set_epoch(epoch)
    return found.numbers()


def test_partners_are_near_and_stand_beside_each_other() -> None:
    for epoch in range(20):
        first, second = np.array(order(epoch)).reshape(-1, 2).T
        assert (np.abs(PLACES[first, 0] - PLACES[second, 0]) < 6).all()
        assert (first != second).all()
        assert 5 not in first  # it has no partner


def test_order_depends_on_seed_and_epoch_alone() -> None:
    assert order(3) == order(3)
    assert any(order(3) != order(epoch) for epoch in range(3))
    batches = list(PairOrder(PLACES, 6.0, 4, seed=1))
    assert [number for batch in batches for _, number in batch] == order()


def test_processes_share_the_pairs() -> None:
    whole = np.array(order()).reshape(-1, 2)
    parts = [np.array(order(rank=rank, world=2)).reshape(-1, 2) for rank in range(2)]
    assert len(parts[0]) == len(parts[1]) == 2
    assert {tuple(pair) for part in parts for pair in part} == {tuple(pair) for pair in whole}


def test_what_makes_no_pairs_is_named() -> None:
    with pytest.raises(ConfigError, match="no two frames"):
        PairOrder(PLACES[[0, 2, 5]], 6.0, 4, seed=1)
    with pytest.raises(ConfigError, match=r"even loader\.batch_size"):
        DataModule({}, batch_size=3, pairs=10.0)
    module = DataModule({"train": SyntheticDataset(frames=4)}, pairs=10.0)
    with pytest.raises(ConfigError, match=r"(?s)SyntheticDataset gives none.*loader.pairs=0"):
        module.train_dataloader()
