"""KITTI's average precision once more, from the rules and with plain loops: what the metric is compared with.

Works on `lidarfw.kitti.Label` lists alone: camera coordinates, shapely polygons, no torch.
"""

from __future__ import annotations

import math

from shapely.geometry import Polygon

HEIGHT, OCCLUSION, TRUNCATION = (40, 25, 25), (0, 1, 2), (0.15, 0.3, 0.5)
NEIGHBOUR = {"Car": "Van", "Pedestrian": "Person_sitting", "Cyclist": None}


def outline(label):
    (_, width, length), (x, _, z), angle = label.size, label.location, label.rotation_y
    corners = []
    for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1)):
        along, across = a * length / 2, b * width / 2
        corners.append(
            (
                x + along * math.cos(angle) + across * math.sin(angle),
                z - along * math.sin(angle) + across * math.cos(angle),
            )
        )
    return Polygon(corners)


def bev(a, b):
    first, second = outline(a), outline(b)
    return first.intersection(second).area / first.union(second).area


def volume(a, b):
    top = max(a.location[1] - a.size[0], b.location[1] - b.size[0])
    common = outline(a).intersection(outline(b)).area * max(0, min(a.location[1], b.location[1]) - top)
    return common / (math.prod(a.size) + math.prod(b.size) - common)


def area(box):
    return (box[2] - box[0]) * (box[3] - box[1])


def common_area(a, b):
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return width * height if width > 0 and height > 0 else 0


def picture(a, b):
    common = common_area(a.box2d, b.box2d)
    return common / (area(a.box2d) + area(b.box2d) - common)


MEASURES = {"2d": picture, "bev": bev, "3d": volume}


class Frame:
    """Objects and detections with their overlaps, measured once."""

    def __init__(self, objects, detections):
        self.regions = [o for o in objects if o.type == "DontCare"]
        self.objects = [o for o in objects if o.type != "DontCare"]
        self.detections = detections
        self.overlap = {
            name: [[measure(o, d) for d in detections] for o in self.objects] for name, measure in MEASURES.items()
        }

    def roles(self, name, level):
        """0 counts, 1 is ignored, -1 has no part: of objects and of detections."""
        objects = []
        for o in self.objects:
            low = o.box2d[3] - o.box2d[1] <= HEIGHT[level]
            if o.type not in (name, NEIGHBOUR[name]):
                objects.append(-1)
            elif o.type != name or low or o.occlusion > OCCLUSION[level] or o.truncation > TRUNCATION[level]:
                objects.append(1)
            else:
                objects.append(0)
        detections = []
        for d in self.detections:
            low = abs(d.box2d[3] - d.box2d[1]) < HEIGHT[level]
            detections.append(1 if low else (0 if d.type == name else -1))
        return objects, detections

    def recall_scores(self, name, level, measure, limit):
        """Scores of the true positives when every object takes the surest detection."""
        objects, detections = self.roles(name, level)
        taken, scores = set(), []
        for i, role in enumerate(objects):
            if role == -1:
                continue
            best = None
            for j, d in enumerate(self.detections):
                if detections[j] == -1 or j in taken or self.overlap[measure][i][j] <= limit:
                    continue
                if best is None or d.score > self.detections[best].score:
                    best = j
            if best is None:
                continue
            taken.add(best)
            if role == 0 and detections[best] == 0:
                scores.append(self.detections[best].score)
        return scores, objects.count(0)

    def count(self, name, level, measure, limit, threshold):
        """True and false positives and the summed agreement of orientation at a score threshold."""
        objects, detections = self.roles(name, level)
        active = [j for j, d in enumerate(self.detections) if detections[j] != -1 and d.score >= threshold]
        taken, true, agreement = set(), 0, 0.0
        for i, role in enumerate(objects):
            fits = [j for j in active if j not in taken and self.overlap[measure][i][j] > limit] if role != -1 else []
            counted = [j for j in fits if detections[j] == 0]
            if not fits:
                continue
            best = max(counted, key=lambda j: self.overlap[measure][i][j]) if counted else fits[0]
            taken.add(best)
            if role == 0 and counted:
                true += 1
                agreement += (1 + math.cos(self.objects[i].alpha - self.detections[best].alpha)) / 2
        false = 0
        for j in active:
            if j in taken or detections[j] == 1:
                continue
            box = self.detections[j].box2d
            if measure == "2d" and any(common_area(box, r.box2d) / area(box) > limit for r in self.regions):
                continue
            false += 1
        return true, false, agreement


def thresholds(scores, objects):
    scores, found, goal = sorted(scores, reverse=True), [], 0.0
    for i, score in enumerate(scores):
        left = (i + 1) / objects
        right = (i + 2) / objects if i + 1 < len(scores) else left
        if right - goal < goal - left and i + 1 < len(scores):
            continue
        found.append(score)
        goal += 1 / 40
    return found


def average_precisions(frames, name, level, measure, limit):
    """(AP R11, AP R40, AOS R11, AOS R40)."""
    scores, objects = [], 0
    for frame in frames:
        more, count = frame.recall_scores(name, level, measure, limit)
        scores, objects = scores + more, objects + count
    precision, similarity = [0.0] * 41, [0.0] * 41
    for k, threshold in enumerate(thresholds(scores, objects)):
        true = false = 0
        agreement = 0.0
        for frame in frames:
            t, f, a = frame.count(name, level, measure, limit, threshold)
            true, false, agreement = true + t, false + f, agreement + a
        if true + false:
            precision[k], similarity[k] = true / (true + false), agreement / (true + false)
    curves = [[max(curve[k:]) for k in range(41)] for curve in (precision, similarity)]
    return [value for c in curves for value in (sum(c[::4]) / 11, sum(c[1:]) / 40)]
