"""Rigid alignment with known answers, scipy as the oracle, and outliers."""

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidarfw.ops import kabsch, ransac_pose, transform
from lidarfw.ops.pose import iterations
from lidarfw.types import SceneCoords


def random_pose(seed: int, distance: float = 10.0) -> Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.from_numpy(Rotation.random(rng=seed).as_matrix())
    matrix[:3, 3] = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * distance
    return matrix


def random_points(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 5


def test_exact_pairs_give_the_exact_pose_in_a_batch() -> None:
    poses = torch.stack([random_pose(seed) for seed in range(6)]).view(2, 3, 4, 4)
    source = random_points(2, 3, 20)
    torch.testing.assert_close(kabsch(source, transform(poses, source)), poses)


def test_noisy_weighted_pairs_equal_scipy() -> None:
    source = random_points(50)
    target = transform(random_pose(3), source) + random_points(50, seed=9) * 0.1
    weight = torch.rand(50, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    ours = kabsch(source, target, weight)
    mean_s, mean_t = ((weight[:, None] * p).sum(0) / weight.sum() for p in (source, target))
    rotation, _ = Rotation.align_vectors((target - mean_t).numpy(), (source - mean_s).numpy(), weight.numpy())
    torch.testing.assert_close(ours[:3, :3], torch.from_numpy(rotation.as_matrix()))
    torch.testing.assert_close(ours[:3, 3], mean_t - ours[:3, :3] @ mean_s)


@pytest.mark.parametrize("flat", [torch.tensor([1.0, 1, 0]), torch.tensor([-1.0, 1, 1])])
def test_planar_and_mirrored_points_give_a_rotation(flat: Tensor) -> None:
    source = random_points(30)
    matrix = kabsch(source * (flat != 0), source * flat)
    assert torch.linalg.det(matrix[:3, :3]).item() == pytest.approx(1)
    torch.testing.assert_close(matrix[:3, :3] @ matrix[:3, :3].T, torch.eye(3, dtype=torch.float64))


def test_no_weight_is_the_identity() -> None:
    torch.testing.assert_close(
        kabsch(random_points(5), random_points(5, seed=1), torch.zeros(5).double())[3, 3].item(), 1.0
    )
    matrix = kabsch(torch.zeros(0, 3), torch.zeros(0, 3))
    assert torch.linalg.det(matrix).item() == pytest.approx(1)


def test_alignment_is_differentiable() -> None:
    source = random_points(8).requires_grad_()
    target = (transform(random_pose(1), source.detach()) + random_points(8, seed=2) * 0.2).requires_grad_()
    weight = torch.rand(8, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(kabsch, (source, target, weight))


def outlier_pairs(count: int, wrong: float, seed: int, offset: float = 0.0) -> tuple[SceneCoords, Tensor]:
    pose = random_pose(seed)
    pose[:3, 3] += offset
    source = random_points(count, seed=seed) * 4
    world = transform(pose, source) + random_points(count, seed=seed + 1) * 0.01
    bad = torch.rand(count, generator=torch.Generator().manual_seed(seed)) < wrong
    world[bad] += random_points(int(bad.sum()), seed=seed + 2) * 4
    pairs = SceneCoords(source.float(), world.float(), torch.ones(count), torch.zeros(count, dtype=torch.long))
    return pairs, pose


@pytest.mark.parametrize("offset", [0.0, 5000.0])
def test_robust_fit_among_many_outliers(offset: float) -> None:
    samples = [outlier_pairs(400, wrong, seed, offset) for seed, wrong in enumerate((0.0, 0.5, 0.7))]
    poses = ransac_pose(SceneCoords.cat([s[0] for s in samples], as_batch=True), threshold=0.3)
    assert poses.ok.all()
    for matrix, confidence, (pairs, expected), wrong in zip(
        poses.matrix, poses.confidence, samples, (0.0, 0.5, 0.7), strict=True
    ):
        moved = transform(matrix.double(), pairs.source.double())
        assert (moved - transform(expected, pairs.source.double())).norm(dim=1).max() < 0.05 + offset * 1e-6
        assert confidence.item() == pytest.approx(1 - wrong, abs=0.08)
        alone = ransac_pose(pairs, threshold=0.3)
        assert torch.equal(alone.matrix[0], matrix)


def test_samples_without_a_pose_are_marked() -> None:
    good, _ = outlier_pairs(50, 0.0, 0)
    nothing = good[:0]
    few = good[:2]
    noise = good.replace(world=random_points(50, seed=7).float() * 50)
    unweighted = good.replace(weight=torch.zeros(50))
    batch = SceneCoords.cat([good, nothing, few, noise, unweighted], as_batch=True)
    poses = ransac_pose(batch, threshold=0.1, minimum_inliers=8)
    assert poses.ok.tolist() == [True, False, False, False, False]
    assert torch.equal(poses.matrix[[1, 2, 4]], torch.eye(4).expand(3, 4, 4))
    torch.testing.assert_close(poses.matrix[3], kabsch(noise.source, noise.world))  # the best guess there is
    assert poses.confidence[1:].sum() == 0
    assert poses.matrix.isfinite().all()


def test_pairs_on_a_line_are_no_pose() -> None:
    source = torch.linspace(-20, 20, 40)[:, None] * torch.tensor([1.0, 2.0, 0.5])
    pairs = SceneCoords(source, source + 3, torch.ones(40), torch.zeros(40, dtype=torch.long))
    assert not ransac_pose(pairs).ok[0]


def test_exact_pairs_among_random_ones() -> None:
    pose, source = random_pose(5), random_points(100, seed=1) * 4
    world = transform(pose, source)
    world[60:] = random_points(40, seed=2) * 8
    found = ransac_pose(SceneCoords(source, world, torch.ones(100), torch.zeros(100).long()), threshold=1.2)
    torch.testing.assert_close(found.matrix[0], pose, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("share", "expected"), [(0.6, 29), (0.3, 253), (0.1, 6905), (1.0, 1)])
def test_draws_that_find_three_inliers(share: float, expected: int) -> None:
    assert iterations(share) == expected
