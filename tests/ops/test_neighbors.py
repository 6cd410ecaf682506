"""Point sampling and search against brute force."""

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from lidarfw.ops import ball_query, farthest_points, knn, neighbors, three_interpolate


def cloud(count: int, batch_size: int, seed: int) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    xyz = torch.rand(count, 3, generator=random, dtype=torch.float64)
    return xyz, torch.randint(batch_size, (count,), generator=random)


def brute_force(query, query_batch, reference, reference_batch, count: int, radius: float) -> tuple[Tensor, Tensor]:
    distance = torch.cdist(query, reference)
    distance[query_batch[:, None] != reference_batch] = torch.inf
    distance[distance > radius] = torch.inf
    distance, index = distance.sort(1)
    distance, index = (torch.cat([t, t.new_zeros(len(query), count)], 1)[:, :count] for t in (distance, index))
    distance[:, len(reference) :] = torch.inf
    return torch.where(distance.isinf(), -1, index), distance


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 40), st.integers(0, 60), st.integers(1, 3), st.integers(0, 10**6), st.sampled_from([0.3, 9.0]))
@pytest.mark.parametrize("search", ["_search_tree", "_search_all"])
def test_nearest_equal_brute_force(search: str, queries: int, points: int, batch_size: int, seed: int, radius) -> None:
    query, reference = cloud(queries, batch_size, seed), cloud(points, batch_size, seed + 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neighbors, "_search_tree", getattr(neighbors, search))  # the tests have no GPU
        index, distance = knn(*query, *reference, 5, radius)
    expected_index, expected_distance = brute_force(*query, *reference, 5, radius)
    assert torch.equal(index, expected_index)
    torch.testing.assert_close(distance, expected_distance)
    assert torch.equal(ball_query(*query, *reference, radius, 5), index)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 40), st.integers(1, 3), st.integers(0, 10**6))
def test_farthest_points_equal_a_loop(points: int, batch_size: int, seed: int) -> None:
    xyz, batch = cloud(points, batch_size, seed)
    chosen = farthest_points(xyz, batch, batch_size, 8)
    for sample in range(batch_size):
        rows = (batch == sample).nonzero().squeeze(1).tolist()
        expected = rows[:1] or [-1]
        while len(expected) < 8:
            left = [min(float((xyz[r] - xyz[c]).norm()) for c in expected) for r in rows]
            expected.append(rows[left.index(max(left))] if left and max(left) > 0 else expected[0])
        assert chosen[sample].tolist() == expected


def test_interpolation_at_a_reference_point_is_its_feature() -> None:
    xyz, batch = cloud(30, 2, 0)
    features = torch.randn(30, 4, dtype=torch.float64)
    torch.testing.assert_close(three_interpolate(xyz, batch, xyz, batch, features), features, rtol=1e-4, atol=1e-4)


def test_interpolation_weights_by_inverse_square_and_passes_gradients() -> None:
    reference = torch.tensor([[0.0, 0, 0], [3.0, 0, 0], [0, 50.0, 0], [0, 0, 500.0]], dtype=torch.float64)
    features = torch.tensor([[1.0], [0.0], [0.0], [9.0]], dtype=torch.float64, requires_grad=True)
    query, zeros = torch.tensor([[1.0, 0, 0]], dtype=torch.float64), torch.zeros(4, dtype=torch.long)
    value = three_interpolate(query, zeros[:1], reference, zeros, features)
    assert value.item() == pytest.approx(1 / (1 + 1 / 4 + 1 / 2501))
    assert torch.autograd.gradcheck(lambda f: three_interpolate(query, zeros[:1], reference, zeros, f), features)


def test_interpolation_without_reference_points_is_zero() -> None:
    query, batch = cloud(3, 2, 0)
    nothing = torch.zeros(0, 3, dtype=torch.float64)
    features = torch.zeros(0, 5, dtype=torch.float64, requires_grad=True)
    value = three_interpolate(query, batch, nothing, batch[:0], features)
    assert torch.equal(value, torch.zeros(3, 5, dtype=torch.float64))
    value.sum().backward()
    assert features.grad is not None
