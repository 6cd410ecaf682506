"""Pictures of tracks: all of a sequence from above, and a page that needs nothing else to look through its frames."""

from __future__ import annotations

import base64
import colorsys
import html
import json
import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lidarfw import draw, kitti
from lidarfw.detections import Detections
from lidarfw.errors import DataError
from lidarfw.files import write_text
from lidarfw.io import read_image
from lidarfw.types import Tracks

Frames = Sequence[tuple[Detections, Tracks]]
Array = npt.NDArray[np.float64]

TAIL = 20  # frames
_STRIP = 880  # pixels, width of the pictures of the camera

_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>%(title)s</title><style>
body { font: 15px/1.4 system-ui, sans-serif; color: #1b1f24; margin: 1em auto; max-width: 1280px; padding: 0 1em; }
h1 { font-size: 1.3em; margin: 0 0 .4em; } p { color: #59636e; margin: .3em 0; }
#bar { display: flex; gap: .8em; align-items: center; margin: .5em 0; } #slide { flex: 1; }
#view { display: flex; gap: 1em; align-items: flex-start; } canvas { border: 1px solid #ddd; background: #fbfbfa; }
table { border-collapse: collapse; font-size: .88em; } td, th { padding: .1em .7em .1em 0; text-align: left; }
td.n { text-align: right; font-variant-numeric: tabular-nums; } tr.on { font-weight: 700; }
#strip { width: 100%%; } #side { max-height: 720px; overflow-y: auto; min-width: 270px; } img { max-width: 100%%; }
button { font: inherit; padding: .2em .9em; } #least { width: 4.5em; }
</style><h1>%(title)s</h1>
<div id="bar"><button id="play">Play</button><input id="slide" type="range" min="0" value="0"><span id="where"></span>
<label>score from <input id="least" type="number" min="0" max="1" step="0.05" value="0"></label></div>
%(strip)s<div id="view"><canvas id="c" width="880" height="720"></canvas><div id="side"></div></div>
<p>Seen from above, ahead is up; circles every 20 m. Each track has a colour, its number and a tail of %(tail)s frames.
Arrow keys step, space plays, the wheel zooms, a click on a box or a row follows it.</p>
<h2>The whole sequence</h2><img src="data:image/png;base64,%(overview)s" alt="all tracks from above">
<script>
const D = %(data)s, TAIL = %(tail)s, c = document.getElementById("c"), g = c.getContext("2d");
const slide = document.getElementById("slide"), least = document.getElementById("least");
let at = 0, zoom = D.zoom, chosen = null, timer = null;
slide.max = D.frames.length - 1;
const hue = id => "hsl(" + (id * 137.508) %% 360 + " 75%% " + (36 + id * 7 %% 14) + "%%)";
const X = y => c.width / 2 - y * zoom, Y = x => c.height - 60 - (x - D.back) * zoom;
// a place in the sensor frame of frame `a`, seen from frame `b`
function move(x, y, a, b) {
  const p = D.poses[a], q = D.poses[b];
  const mx = p[0] + Math.cos(p[2]) * x - Math.sin(p[2]) * y, my = p[1] + Math.sin(p[2]) * x + Math.cos(p[2]) * y;
  const dx = mx - q[0], dy = my - q[1];
  return [Math.cos(q[2]) * dx + Math.sin(q[2]) * dy, Math.cos(q[2]) * dy - Math.sin(q[2]) * dx];
}
function corners(b) {
  const s = Math.sin(b[7]), k = Math.cos(b[7]);
  return [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([u, v]) =>
    [b[3] + k * u * b[5] / 2 - s * v * b[6] / 2, b[4] + s * u * b[5] / 2 + k * v * b[6] / 2]);
}
function shown(f) { return D.frames[f].filter(b => b[2] >= +least.value); }
function line(points) { g.beginPath(); points.forEach((p, i) => g[i ? "lineTo" : "moveTo"](X(p[1]), Y(p[0]))); }
function paint() {
  g.clearRect(0, 0, c.width, c.height); g.lineWidth = 1; g.font = "12px system-ui";
  for (let r = 20; r <= 120; r += 20) {
    g.strokeStyle = "#dddddd"; g.beginPath(); g.arc(X(0), Y(0), r * zoom, 0, 7); g.stroke();
    g.fillStyle = "#9aa2ab"; g.fillText(r + " m", X(0) + 3, Y(r) - 3);
  }
  g.fillStyle = "#000"; line([[1.5, 0], [-1.5, 1], [-1.5, -1]]); g.fill();
  for (const b of shown(at)) {
    const tail = [];
    for (let f = Math.max(0, at - TAIL); f <= at; f++) {
      const o = D.frames[f].find(o => o[0] == b[0]);
      if (o) tail.push(move(o[3], o[4], f, at));
    }
    g.strokeStyle = g.fillStyle = hue(b[0]); g.globalAlpha = .5; g.lineWidth = 2; line(tail); g.stroke();
    g.globalAlpha = .25 + .75 * b[2]; g.lineWidth = b[0] == chosen ? 4 : 2;
    const k = corners(b); line([...k, k[0]]); g.stroke();
    line([[b[3], b[4]], [(k[0][0] + k[3][0]) / 2, (k[0][1] + k[3][1]) / 2]]); g.stroke();
    g.globalAlpha = 1; g.fillText("#" + b[0], X(b[4]) + 6, Y(b[3]) - 8);
  }
  const far = b => Math.hypot(b[3], b[4]), cell = (text, kind) => `<td class="${kind}">${text}</td>`;
  const rows = shown(at).sort((a, b) => far(a) - far(b)).map(b =>
    `<tr class="${b[0] == chosen ? "on" : ""}" data-id="${b[0]}"><td style="color:${hue(b[0])}">#${b[0]}</td>` +
    cell(D.classes[b[1]], "") + cell(b[2].toFixed(2), "n") + cell(far(b).toFixed(0) + " m", "n") + "</tr>");
  document.getElementById("side").innerHTML =
    "<table><tr><th>track</th><th>class</th><th>score</th><th>distance</th></tr>" + rows.join("") + "</table>";
  const strip = document.getElementById("strip"), shot = D.pictures[at];
  if (strip) strip.style.visibility = shot ? "visible" : "hidden";
  if (strip && shot) strip.src = "data:image/jpeg;base64," + shot;
  document.getElementById("where").textContent = "frame " + D.index[at] + " / " + D.index[D.index.length - 1];
  slide.value = at;
}
function go(f) { at = Math.max(0, Math.min(D.frames.length - 1, f)); paint(); }
function play() {
  if (timer) { clearInterval(timer); timer = null; }
  else timer = setInterval(() => go((at + 1) %% D.frames.length), 100);
  document.getElementById("play").textContent = timer ? "Stop" : "Play";
}
slide.oninput = () => go(+slide.value); least.oninput = paint;
document.getElementById("play").onclick = play;
onkeydown = e => {
  if (e.key == "ArrowRight") go(at + 1); else if (e.key == "ArrowLeft") go(at - 1);
  else if (e.key == " ") { play(); e.preventDefault(); }
};
c.onwheel = e => { zoom *= e.deltaY < 0 ? 1.1 : 1 / 1.1; paint(); e.preventDefault(); };
c.onclick = e => {
  const off = b => Math.hypot(X(b[4]) - e.offsetX, Y(b[3]) - e.offsetY);
  const near = shown(at).sort((a, b) => off(a) - off(b))[0];
  chosen = near && off(near) < 30 ? near[0] : null; paint();
};
document.getElementById("side").onclick = e => { chosen = +e.target.closest("tr").dataset.id; paint(); };
if (location.hash) at = Math.min(+location.hash.slice(1), D.frames.length - 1);
paint();
</script></html>
"""


def write_page(path: str | Path, name: str, frames: Frames, classes: Sequence[str], images: Path | None = None) -> None:
    """A page of a sequence: a bird's-eye view with a slider, its tracks with number, tail and score, and `overview`.

    Self-contained HTML without outside links; `#40` after its address opens it at the 41st frame. Without poses tails
    are drawn as if the sensor stood still. `images` is a folder of the camera's pictures, by number of the frame
    (000000.png): the tracks are drawn on them too, with their numbers. DataError where it has none of the sequence.
    """
    rows = [_rows(tracks) for _, tracks in frames]
    back, ahead = np.percentile([0.0, *(row[3] for frame in rows for row in frame)], [2, 98]).tolist()
    data = {
        "classes": list(classes),
        "index": [frame.meta.index for frame, _ in frames],
        "poses": [_place(frame) for frame, _ in frames],
        "frames": rows,
        "pictures": [""] * len(rows) if images is None else _strip(images, frames, classes),
        "back": round(back, 1),
        "zoom": round(640 / max(ahead - back, 20), 2),
    }
    picture = base64.b64encode(draw.png_bytes(overview(name, frames))).decode()
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    strip = "" if images is None else '<img id="strip" alt="the tracks in the picture of the camera">\n'
    values = {"title": html.escape(name), "data": text, "tail": TAIL, "overview": picture, "strip": strip}
    write_text(path, _PAGE % values)


def _strip(folder: Path, frames: Frames, classes: Sequence[str]) -> list[str]:
    """The camera's picture of every frame with its tracks, as the base64 of a JPEG; "" where there is none."""
    found = [next(folder.glob(f"{frame.meta.index:06d}.*"), None) for frame, _ in frames]
    if not any(found):
        raise DataError(
            f"{folder}: has no picture 000000.png or .jpg of the sequence.\n  fix: --images DIR/SEQUENCE/*.png"
        )
    return [
        "" if path is None else _shot(path, frame, tracks, classes)
        for path, (frame, tracks) in zip(found, frames, strict=True)
    ]


def _shot(path: Path, frame: Detections, tracks: Tracks, classes: Sequence[str]) -> str:
    import cv2

    view = draw.camera_view(read_image(path), kitti.camera_of(frame.meta.cameras, kitti.IMAGE), tracks, None, classes)
    size = (_STRIP, round(view.shape[0] * _STRIP / view.shape[1]))
    small = cv2.resize(view, size, interpolation=cv2.INTER_AREA)[..., ::-1]
    return base64.b64encode(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()).decode()


def _rows(tracks: Tracks) -> list[list[float]]:
    boxes = tracks.boxes
    columns: list[Any] = [tracks.id.tolist(), boxes.label.tolist()]
    columns += [[round(value, 3) for value in boxes.score.tolist()]]
    numbers = [*boxes.center[:, :2].T, *boxes.size[:, :2].T, boxes.yaw]
    columns += [[round(value, 2) for value in column.tolist()] for column in numbers]
    return [list(row) for row in zip(*columns, strict=True)]


def _place(frame: Detections) -> list[float]:
    """x, y and heading of the sensor in the map."""
    matrix = np.eye(4) if frame.pose is None else frame.pose.matrix[0].double().numpy()
    return [round(float(value), 3) for value in (*matrix[:2, 3], math.atan2(matrix[1, 0], matrix[0, 0]))]


def overview(title: str, frames: Frames) -> draw.Picture:
    """All tracks of a sequence from above, in the map: a line for each in its colour, the way of the sensor black."""
    paths: dict[int, list[Array]] = defaultdict(list)
    for frame, tracks in frames:
        x, y, turn = _place(frame)
        rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        places = tracks.boxes.center[:, :2].double().numpy() @ rotation.T + (x, y)
        for number, place in zip(tracks.id.tolist(), places, strict=True):
            paths[number].append(place)
    own = np.array([_place(frame)[:2] for frame, _ in frames]).reshape(-1, 2)
    lines = {number: np.stack(path) for number, path in paths.items() if len(path) > 1}
    return draw.plan_view(lines, own, {number: _colour(number) for number in lines}, title)


def _colour(number: int) -> str:
    """The colour of a track, as on the page."""
    rgb = colorsys.hls_to_rgb(number * 137.508 % 360 / 360, (36 + number * 7 % 14) / 100, 0.75)
    return "#" + "".join(f"{round(255 * value):02x}" for value in rgb)
