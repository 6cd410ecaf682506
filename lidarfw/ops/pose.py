"""Rigid alignment of point pairs: weighted least squares, and robustly from pairs of which many are wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
    hypotheses: int = 512,
    least_share: float = 0.1,
    edge_ratio: float = 0.9,
    shortest_edge: float = 0.0,
    refinements: int = 20,
    minimum_inliers: int = 6,
    seed: int = 0,
) -> Poses:
    """Pose of every sample from pairs of which many may be wrong.

    Fischler and Bolles (1981) with the MSAC score of Torr and Zisserman, "MLESAC" (CVIU 2000), section 3: triples of
    pairs are drawn, those that are not rigid are dropped before anything is fitted, and of the others the pose with
    the least sum of min(squared error, threshold^2) wins. It is refitted to its inliers with weights
    1 / (1 + (error / threshold)^2) until these no longer change. All hypotheses of a sample are fitted and scored
    together. Not differentiable.

    Args:
        pairs: pairs of weight 0 are never drawn and never counted; a weight counts in the score and the fit.
        threshold: metres up to which a pair is an inlier.
        hypotheses: triples that are fitted at most.
        least_share: so many triples are drawn that one of inliers only is among them with a probability of 99.9 %
            where at least this share of the pairs are inliers.
        edge_ratio: the sides of a triple must agree between sensor and map up to this ratio, below 1.
        shortest_edge: metres that each side must have at least; triples that fit neither are taken last.
        refinements: at most so many refits.
        minimum_inliers: fewer inliers than this, or than 1 % of the pairs, are no pose, and neither is a line of them.
        seed: of the draw; the same for every sample, so a sample's pose does not depend on the others.

    Returns:
        `confidence` is the weighted share of inliers. Where no pose was found `ok` is False, `confidence` 0 and the
        matrix the least-squares fit to all pairs, or the identity where there are fewer than three.
    """
    draws = max(iterations(least_share), hypotheses)
    found = []
    for sample in pairs.samples():
        fit = _Fit.of(sample, threshold)
        found.append(fit.pose(draws, hypotheses, (edge_ratio, shortest_edge), refinements, minimum_inliers, seed))
    matrix, ok, confidence = (torch.stack(values) for values in zip(*found, strict=True))
    return Poses(matrix, ok, confidence)


def iterations(share: float, probability: float = 0.999) -> int:
    """Draws of three pairs after which one holds inliers only with that probability, at that share of inliers."""
    return max(1, math.ceil(math.log(1 - probability) / math.log(1 - min(share, 1 - 1e-9) ** 3)))


@dataclass
class _Fit:
    """The pairs of one sample about their means (far coordinates lose digits in float32)."""

    source: Tensor  # (N, 3)
    world: Tensor  # (N, 3)
    weight: Tensor  # (N,)
    centers: tuple[Tensor, Tensor]
    threshold: float

    @classmethod
    def of(cls, pairs: SceneCoords, threshold: float) -> _Fit:
        source, world = pairs.source.detach(), pairs.world.detach()
        weight = pairs.weight.detach().to(source.dtype)
        usable = (weight > 0) & world.isfinite().all(1) & source.isfinite().all(1)
        source, world, weight = source[usable], world[usable].to(source.dtype), weight[usable]
        centers = source.sum(0) / max(len(source), 1), world.sum(0) / max(len(world), 1)
        return cls(source - centers[0], world - centers[1], weight, centers, threshold)

    def pose(
        self, draws: int, hypotheses: int, edges: tuple[float, float], refinements: int, minimum: int, seed: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Matrix (4, 4), ok and confidence."""
        no = torch.zeros((), dtype=torch.bool, device=self.source.device), self.source.new_zeros(())
        if len(self.source) < 3:
            return torch.eye(4, dtype=self.source.dtype, device=self.source.device), *no
        triples = self._draw(draws, seed)
        triples = triples[self._rigid_first(triples, *edges)[:hypotheses]]
        matrices = kabsch(self.source[triples], self.world[triples])
        matrix, inlier = self._refined(matrices[self._msac_scores(matrices).argmin()], refinements)
        if int(inlier.sum()) < max(minimum, len(self.source) / 100) or self._on_a_line(inlier):
            return self._uncentred(kabsch(self.source, self.world, self.weight)), *no
        confidence = (self.weight * inlier).sum() / self.weight.sum()
        return self._uncentred(matrix), torch.ones_like(no[0]), confidence

    def _draw(self, count: int, seed: int) -> Tensor:
        """(count, 3) rows drawn by weight. A triple that holds a row twice is not rigid and fits badly."""
        generator = torch.Generator(self.weight.device).manual_seed(seed)
        return torch.multinomial(self.weight, 3 * count, replacement=True, generator=generator).view(count, 3)

    def _rigid_first(self, triples: Tensor, ratio: float, shortest: float) -> Tensor:
        """Order of the triples: first those whose sides are as long in the map as in the sensor frame."""
        sides = [(p[triples] - p[triples.roll(1, 1)]).norm(dim=2) for p in (self.source, self.world)]
        low, high = torch.minimum(*sides), torch.maximum(*sides)
        rigid = ((low >= ratio * high) & (low > shortest)).all(1)
        return rigid.byte().argsort(descending=True, stable=True)

    def _squared_errors(self, matrices: Tensor) -> Tensor:
        """(H, N) squared distance of each pair under each of the matrices (H, 4, 4)."""
        moved = matrices[:, :3, :3].reshape(-1, 3) @ self.source.t()
        apart = moved.view(len(matrices), 3, -1) + matrices[:, :3, 3:] - self.world.t()
        return apart.square_().sum(1)

    def _msac_scores(self, matrices: Tensor) -> Tensor:
        """(H,) weighted sum of min(squared error, threshold^2); low is good."""
        rows = max(_RESIDUALS // len(self.source), 1)
        blocks = matrices.split(rows)  # type: ignore[no-untyped-call]
        return torch.cat([self._squared_errors(m).clamp_(max=self.threshold**2) @ self.weight for m in blocks])

    def _refined(self, matrix: Tensor, rounds: int) -> tuple[Tensor, Tensor]:
        """The matrix refitted to its inliers until they stay the same, and which these are (N,)."""
        inlier = torch.zeros_like(self.weight, dtype=torch.bool)
        for step in range(rounds + 1):
            squared = self._squared_errors(matrix[None])[0] / self.threshold**2
            before, inlier = inlier, squared <= 1
            if step == rounds or int(inlier.sum()) < 3 or torch.equal(before, inlier):
                break
            matrix = kabsch(self.source, self.world, self.weight * inlier / (1 + squared))
        return matrix, inlier

    def _on_a_line(self, inlier: Tensor) -> bool:
        """Whether the inliers leave the turn about their common line open."""
        spread = torch.linalg.svdvals(self.source[inlier] - self.source[inlier].mean(0))
        return bool(spread[1] <= 1e-3 * spread[0])

    def _uncentred(self, matrix: Tensor) -> Tensor:
        matrix = matrix.clone()
        matrix[:3, 3] += self.centers[1] - matrix[:3, :3] @ self.centers[0]
        return matrix
