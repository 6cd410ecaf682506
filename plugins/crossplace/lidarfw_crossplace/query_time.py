"""Where the time of a LiDAR query goes: python -m lidarfw_crossplace.query_time [--network resnet152].

Every part by itself, from a scan of 64 beams to the nearest of a map of 10,000 places, as CPU milliseconds: the median
of some rounds. The weights are random, which takes the same time.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from lidarfw.components.retrievers.exact import ExactRetriever
from lidarfw.ops import range_project
from lidarfw.ops.inputs import town_scan
from lidarfw.types import Descriptors, FrameMeta, Image, Points, Poses, Spec

from lidarfw_crossplace import panorama
from lidarfw_crossplace.backbones import BLOCKS, CosPlaceBackbone
from lidarfw_crossplace.heads import PlaceHead
from lidarfw_crossplace.sparse_unet import MinkUNetBackbone
from lidarfw_crossplace.transforms import CHANNELS, Panorama

PAPER = {"classes of points": 79.76, "projection": 9.55, "gaps": 0.51, "three branches": 15.03}  # ms, RTX 3090
_PLACES = 10_000


def median_time(part: Callable[[], object], rounds: int) -> float:
    """CPU milliseconds of this process, all its threads; the first round is not counted."""
    part()
    times = []
    for _ in range(rounds):
        start = time.process_time()
        part()
        times.append(1000 * (time.process_time() - start))
    return statistics.median(times)


@torch.no_grad()
def parts(network: str, rounds: int) -> dict[str, float]:
    """Milliseconds by part."""
    view, scan = Panorama().view, town_scan(half_view=torch.pi)
    points = scan.replace(features=scan.features[:, :1])
    image = range_project(points, view)
    net = MinkUNetBackbone(Spec(Points, points.features.shape[1])).eval()
    width = len(CHANNELS) * PlaceHead(Spec(Image, 8)).provides.channels  # type: ignore[union-attr]
    places = Descriptors(torch.nn.functional.normalize(torch.randn(_PLACES, width), dim=1), ())
    poses = Poses(torch.eye(4).expand(_PLACES, 4, 4), torch.ones(_PLACES) > 0, torch.ones(_PLACES))
    search = ExactRetriever()
    index = search.build(places, poses)
    query = Descriptors(places.vector[:1], ())
    found = {
        "classes of points": median_time(lambda: net(points), max(rounds // 5, 1)),
        "projection": median_time(lambda: range_project(points, view), rounds),
        "gaps": median_time(lambda: panorama.interpolate_columns(image.features[0], image.mask[0], 4), rounds),
        "three branches": _branches(network, rounds),
        f"search of {_PLACES:,} places": median_time(lambda: search.query(index, query, 1), rounds),
    }
    print(f"a scan of {len(points):,} points, network {network}, {torch.get_num_threads()} threads")
    return found


def _branches(network: str, rounds: int) -> float:
    camera, view = panorama.camera_of(Panorama().view), Panorama().view
    total = 0.0
    for channels in CHANNELS.values():
        backbone = CosPlaceBackbone(Spec(Image, channels, 1, camera), network=network).eval()
        head = PlaceHead(backbone.provides).eval()  # type: ignore[arg-type]
        image = Image(torch.rand(1, channels, view.height, view.width), (camera,))
        total += median_time(lambda b=backbone, h=head, i=image: h(b(i), [FrameMeta("", "")]), max(rounds // 3, 1))  # type: ignore[misc]
    return total


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", choices=list(BLOCKS), default="resnet152", help="of each branch (%(default)s)")
    parser.add_argument("--rounds", type=int, default=10, help="(%(default)s)")
    args = parser.parse_args()
    found = parts(args.network, args.rounds)
    print("| part | CPU ms here | paper, RTX 3090, ms |\n|---|---:|---:|")
    for name, value in found.items():
        print(f"| {name} | {value:.1f} | {PAPER.get(name, '')} |")
    print(f"| all | {sum(found.values()):.1f} | {sum(PAPER.values()):.2f} |")


if __name__ == "__main__":
    main()
