"""Rigid alignment of point pairs: weighted least squares, and robustly from pairs of which many are wrong."""

from __future__ import annotations

import torch
from torch import Tensor

from lidarfw.types import Poses, SceneCoords

_RESIDUALS = 2**16  # residuals formed at once: they stay in the processor's cache


def kabsch(source: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """(..., 4, 4) rigid transforms that take source (..., N, 3) to target (..., N, 3) with least squared error.

    Umeyama, "Least-squares estimation of transformation parameters" (PAMI 1991), without scale: a rotation
    always, never a reflection. Differentiable where the points span a plane. Pairs of weight 0 have no effect;
    with no weight at all the result is the identity.

    Args:
        weight: (..., N) >= 0, 1 by default.
    """
    weight = torch.ones_like(source[..., 0]) if weight is None else weight
    share = (weight / weight.sum(-1, keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny))[..., None]
    center_s, center_t = (share * source).sum(-2, keepdim=True), (share * target).sum(-2, keepdim=True)
    covariance = (share * (target - center_t)).transpose(-1, -2) @ (source - center_s)
    u, _, vh = torch.linalg.svd(covariance)
    flip = torch.ones_like(u[..., 0])
    flip[..., 2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vh)).detach()
    rotation = (u * flip[..., None, :]) @ vh
    shift = center_t - center_s @ rotation.transpose(-1, -2)
    matrix = torch.cat([rotation, shift.transpose(-1, -2)], -1)
    last = matrix.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*matrix.shape[:-2], 1, 4)
    return torch.cat([matrix, last], -2)


def transform(matrix: Tensor, xyz: Tensor) -> Tensor:
    """Points (..., N, 3) moved by matrices (..., 4, 4)."""
    return xyz @ matrix[..., :3, :3].transpose(-1, -2) + matrix[..., None, :3, 3]


def ransac_pose(
    pairs: SceneCoords,
    *,
    threshold: float = 0.6,
    hypotheses: int = 1000,
    refinements: int = 5,
    minimum_inliers: int = 4,
    seed: int = 0,
) -> Poses:
    """Pose of every sample from pairs of which many may be wrong.

    Fischler and Bolles (1981) with the MSAC score of Torr and Zisserman, "MLESAC" (CVIU 2000), section 3: the
    hypothesis with the least sum of min(squared error, threshold^2) wins and is refitted to its inliers. All
    hypotheses of a sample are fitted and scored together. Not differentiable.

    Args:
        pairs: pairs of weight 0 are never drawn and never counted; a weight counts in the score and the fit.
        threshold: metres up to which a pair is an inlier.
        hypotheses: triples drawn for each sample, by the pairs' weights.
        refinements: at most so many refits; they stop where the inliers no longer change.
        seed: of the draw; the same for every sample, so a sample's pose does not depend on the others.

    Returns:
        `ok` is False, and the matrix the identity, where fewer than `minimum_inliers` pairs agree;
        `confidence` is the weighted share of inliers.
    """
    found = [_robust_fit(p, threshold, hypotheses, refinements, minimum_inliers, seed) for p in pairs.samples()]
    matrix, ok, confidence = (torch.stack(values) for values in zip(*found, strict=True))
    return Poses(matrix, ok, confidence)


def _robust_fit(
    pairs: SceneCoords, threshold: float, hypotheses: int, refinements: int, minimum: int, seed: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Matrix (4, 4), ok and confidence of one sample."""
    source, world, weight = pairs.source.detach(), pairs.world.detach(), pairs.weight.detach().to(pairs.source.dtype)
    identity = torch.eye(4, dtype=source.dtype, device=source.device)
    none = identity, torch.zeros((), dtype=torch.bool, device=source.device), source.new_zeros(())
    if int((weight > 0).sum()) < max(minimum, 3):
        return none
    center_s, center_w = source.mean(0), world.mean(0)  # far coordinates lose digits in float32
    source, world = source - center_s, world - center_w
    triples = _draw(weight, hypotheses, seed)
    matrices = kabsch(source[triples], world[triples])
    matrix = matrices[_msac_scores(matrices, source, world, weight, threshold).argmin()]
    inlier = _inliers(matrix, source, world, weight, threshold)
    for _ in range(refinements):
        matrix = kabsch(source, world, weight * inlier) if int(inlier.sum()) >= 3 else matrix
        before, inlier = inlier, _inliers(matrix, source, world, weight, threshold)
        if torch.equal(before, inlier):
            break
    if int(inlier.sum()) < minimum:
        return none
    matrix[:3, 3] += center_w - matrix[:3, :3] @ center_s
    return matrix, torch.ones_like(none[1]), (weight * inlier).sum() / weight.sum()


def _draw(weight: Tensor, hypotheses: int, seed: int) -> Tensor:
    """(hypotheses, 3) rows drawn by weight. A triple that holds a row twice fits badly and loses."""
    generator = torch.Generator(weight.device).manual_seed(seed)
    return torch.multinomial(weight, 3 * hypotheses, replacement=True, generator=generator).view(hypotheses, 3)


def _squared_errors(matrices: Tensor, source: Tensor, world: Tensor) -> Tensor:
    """(H, N) squared distance of each pair under each of the matrices (H, 4, 4)."""
    moved = matrices[:, :3, :3].reshape(-1, 3) @ source.t()
    apart = moved.view(len(matrices), 3, -1) + matrices[:, :3, 3:] - world.t()
    return apart.square_().sum(1)


def _msac_scores(matrices: Tensor, source: Tensor, world: Tensor, weight: Tensor, threshold: float) -> Tensor:
    """(H,) weighted sum of min(squared error, threshold^2); low is good."""
    rows = max(_RESIDUALS // len(source), 1)
    blocks = matrices.split(rows)  # type: ignore[no-untyped-call]
    return torch.cat([_squared_errors(m, source, world).clamp_(max=threshold**2) @ weight for m in blocks])


def _inliers(matrix: Tensor, source: Tensor, world: Tensor, weight: Tensor, threshold: float) -> Tensor:
    return (_squared_errors(matrix[None], source, world)[0] <= threshold**2) & (weight > 0)
