"""What refinement costs: `python -m lidarfw_msrm.bench [CKPT | OVERRIDE ...] [--scan FILE]`.

Three tables: time of a scan by the number of stages, where the paper has 60.40, 66.35, 78.93 and 101.56 ms for one to
four (table X); time and memory of the head by the number of regions; time of the decomposed PointNet (section II-C)
against the PointNet that it replaces. Times are processor time of this process, the median of rounds in turn, so that
other load on the machine falls on all columns alike.
"""

from __future__ import annotations

import argparse
import copy
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import lidarfw
import torch
from lidarfw import latency
from lidarfw.assembly import build, plan
from lidarfw.cli import answered
from lidarfw.config import compose
from lidarfw.errors import ConfigError
from lidarfw.files import require_checkpoint, write_text
from lidarfw.model import PerceptionModel
from lidarfw.types import Batch, collate
from torch import Tensor, nn

from lidarfw_msrm.heads.msrm import MSRMHead
from lidarfw_msrm.heads.pooling import Aggregation, Sites, aggregation_cost

PAPER = (60.40, 66.35, 78.93, 101.56)  # ms with 1, 2, 3, 4 stages (table X)
USUAL = ["experiment=msrm_town", "head.msrm.stages=4"]
REGIONS = (10, 20, 40, 80, 160)
STAGES = ("encoders", "attention", "confidence", "correction")


def in_turn(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median processor time of each call in milliseconds; the calls take turns, after a round that does not count."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        for name, call in calls.items():
            begin = time.process_time()
            call()
            if turn:
                taken[name].append((time.process_time() - begin) * 1e3)
    return {name: statistics.median(values) for name, values in taken.items()}


def by_stages(model: PerceptionModel, head: MSRMHead, batch: Batch, rounds: int) -> dict[str, float]:
    """Milliseconds of a scan, from points to boxes, with 1, 2, ... stages of the model."""
    whole = {name: getattr(head, name) for name in STAGES}

    def run(stages: int) -> None:
        for name, modules in whole.items():
            setattr(head, name, modules[:stages])
        model.predict(batch)

    try:
        return in_turn({str(n): partial(run, n) for n in range(1, len(head.encoders) + 1)}, rounds)
    finally:
        for name, modules in whole.items():
            setattr(head, name, modules)


def by_regions(model: PerceptionModel, head: MSRMHead, batch: Batch, rounds: int) -> dict[str, tuple[float, float]]:
    """Milliseconds of a scan, and MB that a training step on it keeps for its gradients, by the number of regions."""
    before = head.regions

    def run(regions: int) -> None:
        head.regions = regions
        model.predict(batch)

    try:
        times = in_turn({str(n): partial(run, n) for n in REGIONS}, rounds)
        found = {}
        for name, value in times.items():
            head.regions = int(name)
            found[name] = (value, kept_for_gradients(model, batch) / 1e6)
        return found
    finally:
        head.regions = before


def kept_for_gradients(model: PerceptionModel, batch: Batch) -> int:
    """Bytes of the tensors that a training step keeps for its backward pass; each storage once."""
    learning = copy.deepcopy(model).train()  # running statistics of the model itself stay as they are
    storages: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        learning(batch)
    return sum(storages.values())


class NaivePointNet(nn.Module):
    """The PointNet on [features, offset] of every pair that `Aggregation` replaces, up to its maximum."""

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(in_channels + 3, channels, bias=False)

    def forward(self, sites: Sites, xyz: Tensor, pairs: Tensor, neighbors: int) -> Tensor:
        """(M, C') of points that have `neighbors` pairs each."""
        query, site = pairs.unbind(1)
        pair = torch.cat([sites.features[site], sites.xyz[site] - xyz[query]], 1)
        pooled: Tensor = torch.relu(self.linear(pair)).view(len(xyz), neighbors, -1).amax(1)
        return pooled


def decomposition(rounds: int, sites: int = 10_000, neighbors: int = 16) -> dict[str, Any]:
    """Products and milliseconds of both forms: 160 regions of 6^3 points, 16 neighbours, 64 channels to 32."""
    places, c, out = 160 * 6**3, 64, 32
    generator = torch.Generator().manual_seed(0)
    there = Sites(torch.rand(sites, 3, generator=generator), torch.rand(sites, c, generator=generator), torch.zeros(0))
    xyz = torch.rand(places, 3, generator=generator)
    site = torch.randint(sites, (places * neighbors,), generator=generator)
    pairs = torch.stack([torch.arange(places).repeat_interleave(neighbors), site], 1)
    naive, ours = NaivePointNet(c, out).eval(), Aggregation(c, out).eval()
    ours.out = nn.Sequential()  # the layer after the maximum is the same in both
    with torch.no_grad():
        times = in_turn(
            {
                "naive": lambda: naive(there, xyz, pairs, neighbors),
                "decomposed": lambda: ours(ours.transform(there), there, xyz, pairs),
            },
            rounds,
        )
    products = aggregation_cost(sites, places, neighbors, c, out)
    return {"products": dict(zip(("naive", "decomposed"), products, strict=True)), "milliseconds": times}


def measure(model: PerceptionModel, batch: Batch, rounds: int) -> dict[str, Any]:
    """All three."""
    head = next((m for m in model.modules() if isinstance(m, MSRMHead)), None)
    if head is None:
        raise ConfigError("the model has no head 'msrm'.\n  fix: head=[anchor,msrm]")
    with torch.no_grad():
        stages = by_stages(model, head, batch, rounds)
        regions = by_regions(model, head, batch, rounds)
    return {"stages": stages, "regions": regions, "decomposition": decomposition(rounds)}


def table(found: dict[str, Any]) -> str:
    """As Markdown."""
    first = next(iter(found["stages"].values()))
    lines = ["| stages | ms | to one stage | paper |", "|---|---|---|---|"]
    for (name, value), paper in zip(found["stages"].items(), PAPER):
        lines.append(f"| {name} | {value:.1f} | {value / first:.3f} | {paper / PAPER[0]:.3f} |")
    lines += ["", "| regions | ms | MB kept for gradients |", "|---|---|---|"]
    lines += [f"| {name} | {ms:.1f} | {mb:.1f} |" for name, (ms, mb) in found["regions"].items()]
    lines += ["", "| PointNet | million products | ms |", "|---|---|---|"]
    both = found["decomposition"]
    lines += [f"| {n} | {both['products'][n] / 1e6:.1f} | {ms:.1f} |" for n, ms in both["milliseconds"].items()]
    return "\n".join(lines)


@answered
def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "what", metavar="CKPT|OVERRIDE", nargs="*", default=["experiment=msrm_town", "head.msrm.stages=4"]
    )
    parser.add_argument("--scan", type=Path, metavar="FILE", help="a real scan; else a simulated street")
    parser.add_argument("--rounds", type=int, default=7, metavar="N", help="measurements of each (%(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    given = parser.parse_args(arguments)
    if given.what[0].endswith((".ckpt", ".safetensors")):
        require_checkpoint(given.what[0])
        model = lidarfw.load(given.what[0])
    else:
        model = build(plan(compose(given.what)))
    model.eval()
    frame = latency.read_frame(model, given.scan, None, None) if given.scan else latency.simulated_frame(model)
    found = measure(model, collate([frame]), given.rounds)
    print(table(found))
    if given.json:
        write_text(given.json, json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
