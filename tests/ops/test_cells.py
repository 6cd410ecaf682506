"""Voxelisation and scatter against naive loops, and the properties that a user relies on."""

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings

from lidarfw.ops import assign_cells, group_points, scatter_max, scatter_mean, scatter_sum, voxelize_mean
from lidarfw.types import Grid, Points

GRID = Grid((-1.0, -2.0, -0.5), (5.4, 3.2, 1.5), (0.4, 0.4, 0.5))


def cloud(count: int, batch_size: int, seed: int, dtype: torch.dtype = torch.float32) -> Points:
    random = torch.Generator().manual_seed(seed)
    xyz = torch.rand(count, 3, generator=random, dtype=dtype) * torch.tensor([8.0, 7.0, 3.0], dtype=dtype)
    xyz = xyz - torch.tensor([2.0, 3.0, 1.0], dtype=dtype)
    batch = torch.randint(batch_size, (count,), generator=random)
    return Points(xyz, torch.rand(count, 2, generator=random, dtype=dtype), batch, batch_size)


def naive_cells(points: Points, grid: Grid, pillars: bool) -> dict[tuple[int, ...], list[int]]:
    cell, inside = grid.index(points.xyz)
    rows: dict[tuple[int, ...], list[int]] = {}
    for number in range(len(points)):
        if inside[number]:
            z, y, x = cell[number].tolist()
            rows.setdefault((int(points.batch[number]), 0 if pillars else z, y, x), []).append(number)
    return dict(sorted(rows.items()))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 200), st.integers(1, 3), st.integers(0, 10**6), st.booleans())
def test_cells_equal_a_loop_over_points(count: int, batch_size: int, seed: int, pillars: bool) -> None:
    points = cloud(count, batch_size, seed)
    cells = assign_cells(points.xyz, points.batch, batch_size, GRID, pillars)
    expected = naive_cells(points, GRID, pillars)
    assert [tuple(row) for row in cells.index.tolist()] == list(expected)
    assert cells.counts.tolist() == [len(rows) for rows in expected.values()]
    inverse = [-1] * count
    for row, members in enumerate(expected.values()):
        for member in members:
            inverse[member] = row
    assert cells.inverse.tolist() == inverse
    assert cells.order.tolist() == [member for members in expected.values() for member in members]


def test_points_on_cell_edges_fall_where_the_grid_says() -> None:
    grid = Grid((0.0, -40.0, -3.0), (70.4, 40.0, 1.0), (0.05, 0.05, 0.1))
    steps = torch.arange(1408, dtype=torch.float32) * 0.05
    xyz = torch.stack([steps, steps - 40, torch.full_like(steps, -2.3)], 1)
    xyz = torch.cat([xyz, torch.nextafter(xyz, torch.tensor(-1e9)), torch.nextafter(xyz, torch.tensor(1e9))])
    cell, inside = grid.index(xyz)
    found = assign_cells(xyz, torch.zeros(len(xyz), dtype=torch.long), 1, grid)
    assert torch.equal(found.inverse >= 0, inside)
    assert torch.equal(found.index[found.inverse[inside], 1:], cell[inside])


def test_nan_infinite_and_far_points_are_outside() -> None:
    bad = torch.tensor([[float("nan"), 0, 0], [float("inf"), 0, 0], [0, -float("inf"), 0], [1e30, 0, 0], [0, 0, 1.5]])
    cells = assign_cells(bad, torch.zeros(5, dtype=torch.long), 1, GRID)
    assert cells.inverse.tolist() == [-1] * 5
    assert cells.index.shape == (0, 4)


def test_more_cells_than_an_int32_counts() -> None:
    grid = Grid((0, 0, 0), (2000, 2000, 2000), (1, 1, 1))
    xyz = torch.tensor([[1999.5, 1999.5, 1999.5], [0.5, 0.5, 0.5]])
    cells = assign_cells(xyz, torch.zeros(2, dtype=torch.long), 1, grid)
    assert cells.index.tolist() == [[0, 0, 0, 0], [0, 1999, 1999, 1999]]
    assert cells.inverse.tolist() == [1, 0]


def test_voxel_mean_of_duplicated_points_is_the_point() -> None:
    point = Points(torch.tensor([[1.05, 0.3, 0.2]]), torch.tensor([[0.7]]), torch.zeros(1, dtype=torch.long))
    twice = Points.cat([point, point])
    voxels = voxelize_mean(twice, GRID)
    assert len(voxels) == 1
    torch.testing.assert_close(voxels.features, torch.tensor([[1.05, 0.3, 0.2, 0.7]]))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 150), st.integers(0, 10**6))
def test_voxel_mean_equals_a_loop_and_ignores_batch_mates(count: int, seed: int) -> None:
    points = cloud(count, 3, seed, torch.float64)
    voxels = voxelize_mean(points, GRID)
    values = torch.cat([points.xyz, points.features], 1)
    means = [values[rows].mean(0) for rows in naive_cells(points, GRID, False).values()]
    torch.testing.assert_close(voxels.features, torch.stack(means) if means else values[:0])
    assert voxels.shape == GRID.shape()
    for number, sample in enumerate(points.samples()):
        assert torch.equal(voxelize_mean(sample, GRID).features, voxels.features[voxels.index[:, 0] == number])


def test_order_of_the_points_changes_only_rounding() -> None:
    points = cloud(500, 2, 3)
    mixed = points[torch.randperm(500, generator=torch.Generator().manual_seed(1))]
    one, two = voxelize_mean(points, GRID), voxelize_mean(mixed, GRID)
    assert torch.equal(one.index, two.index)
    torch.testing.assert_close(one.features, two.features)


@pytest.mark.parametrize(("scatter", "reduce"), [(scatter_sum, "sum"), (scatter_mean, "mean"), (scatter_max, "amax")])
def test_scatter_equals_a_loop(scatter, reduce: str) -> None:
    features = torch.randn(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    inverse = torch.randint(-1, 6, (40,), generator=torch.Generator().manual_seed(1))
    inverse[inverse == 2] = 0  # row 2 stays empty, as do 6 and 7
    result = scatter(features, inverse, 8)
    for row in range(8):
        members = features[inverse == row]
        expected = getattr(members, reduce)(0) if len(members) else torch.zeros(3, dtype=torch.float64)
        torch.testing.assert_close(result[row], expected)
    assert torch.autograd.gradcheck(lambda f: scatter(f, inverse, 8), features.clone().requires_grad_())


@pytest.mark.parametrize("scatter", [scatter_sum, scatter_mean, scatter_max])
def test_scatter_of_nothing_stays_in_the_graph(scatter) -> None:
    features = torch.zeros(0, 3, requires_grad=True)
    result = scatter(features, torch.zeros(0, dtype=torch.long), 4)
    assert torch.equal(result, torch.zeros(4, 3))
    result.sum().backward()
    assert features.grad is not None
    outside = torch.ones(2, 3, requires_grad=True)
    scatter(outside, torch.tensor([-1, -1]), 4).sum().backward()
    assert torch.equal(outside.grad, torch.zeros(2, 3))


@pytest.mark.parametrize("scatter", [scatter_sum, scatter_mean, scatter_max])
def test_scatter_of_rows_that_all_lie_outside(scatter) -> None:
    assert scatter(torch.rand(5, 3), torch.full((5,), -1), 0).shape == (0, 3)
    assert torch.equal(scatter(torch.rand(5, 3), torch.full((5,), -1), 2), torch.zeros(2, 3))


def test_voxel_mean_passes_gradients_to_point_features() -> None:
    points = cloud(30, 2, 5, torch.float64)

    def features(values: torch.Tensor) -> torch.Tensor:
        return voxelize_mean(points.replace(features=values), GRID).features

    assert torch.autograd.gradcheck(features, points.features.clone().requires_grad_())


def test_grouped_points_are_the_first_of_each_cell() -> None:
    points = cloud(300, 2, 7)
    cells = assign_cells(points.xyz, points.batch, 2, GRID, pillars=True)
    rows, mask = group_points(cells, 4)
    for members, row, kept in zip(naive_cells(points, GRID, True).values(), rows, mask, strict=True):
        assert row[kept].tolist() == members[:4]
        assert row[~kept].tolist() == [0] * (4 - len(members[:4]))


def test_grouping_no_points() -> None:
    rows, mask = group_points(assign_cells(torch.zeros(0, 3), torch.zeros(0, dtype=torch.long), 1, GRID), 5)
    assert rows.shape == mask.shape == (0, 5)


def test_threads_do_not_change_a_bit() -> None:
    points = cloud(20000, 2, 11)
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            voxels = voxelize_mean(points, GRID)
            results.append((voxels.features, scatter_mean(points.features, points.batch, 2)))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])
