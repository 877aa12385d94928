"""Lane markings of a rendered drive as they were painted, and how far their edges are from them in a picture."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.synthetic.options import SynthOptions
from mrasfm_engine.synthetic.world import build_world
from mrasfm_engine.types import Bools, Bytes, Floats

EVERY_M = 0.05  # of an edge
END_M = 0.2  # of a stripe, where the next one or none begins
INSIDE_M, OUTSIDE_M, STEP_M = 0.05, 0.2, 0.005  # of the profile across an edge: the narrowest stripe is 12 cm wide
PLATEAU_M = 0.03  # at both ends of the profile
MIN_CONTRAST = 0.15  # of the paint's brightness over the ground's, that an edge has


@dataclass(frozen=True)
class Edges:
    """Points (n, 2) on the long sides of the markings, in the truth's frame, and directions (n, 2) away from the
    paint."""

    at_m: Floats
    outward: Floats


def true_edges(drive: Path) -> Edges:
    """Edges of all markings of a rendered drive's world, which is built again from its options."""
    document = json.loads((drive / "truth_world.json").read_text(encoding="utf-8"))["options"]
    defaults = SynthOptions()
    options = {}
    for field in fields(SynthOptions):
        if field.name in document:
            value, default = document[field.name], getattr(defaults, field.name)
            kind = type(default) if isinstance(default, Enum | tuple) else (lambda x: x)
            options[field.name] = kind(value)
    world = build_world(SynthOptions(**options), np.random.default_rng([options["seed"], 0]))
    painted = world.mesh.texture == world.materials.paint
    stripes = [a[painted][:, :2] for a in (world.mesh.origin, world.mesh.u, world.mesh.v)]
    at, outward = [], []
    for origin, u, v in zip(*stripes, strict=True):
        length = float(np.linalg.norm(u))
        s = np.arange(END_M, length - END_M, EVERY_M)[:, None] * u / length
        across = v / np.linalg.norm(v)
        for side, direction in ((origin, -across), (origin + v, across)):
            at.append(side + s)
            outward.append(np.broadcast_to(direction, s.shape))
    at_m, outwards = np.concatenate(at), np.concatenate(outward)
    free = ~_beside_paint(at_m + OUTSIDE_M / 2 * outwards, *stripes)
    return Edges(at_m[free], outwards[free])


def _beside_paint(xy: Floats, origin: Floats, u: Floats, v: Floats) -> Bools:
    """Points (n, 2) that lie on a marking: lines that cross a zebra have no edge there."""
    tree, inside = cKDTree(xy), np.zeros(len(xy), dtype=np.bool_)
    for corner, along, across in zip(origin, u, v, strict=True):
        near = np.array(tree.query_ball_point(corner + (along + across) / 2, np.linalg.norm(along)), dtype=np.int64)
        a, b = np.linalg.solve(np.column_stack([along, across]), (xy[near] - corner).T)
        inside[near] |= (a > 0) & (a < 1) & (b > 0) & (b < 1)
    return inside


def truth_from_scene(scene: Path, drive: Path) -> Floats:
    """The transform (2, 3) of x and y, with scale, that bring a scene's poses on average onto the true ones."""
    own, true = read_tum(scene / "poses.tum").world_from_rig, read_tum(drive / "truth.tum").world_from_rig
    scale = align_similarity(true[:, :3, 3], own[:, :3, 3], collinear_ratio=0.0).scale
    u, _, vt = np.linalg.svd((true[:, :3, :3] @ own[:, :3, :3].transpose(0, 2, 1)).sum(0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    shift = true[:, :3, 3].mean(0) - scale * rotation @ own[:, :3, 3].mean(0)
    return np.column_stack([scale * rotation[:2, :2], shift[:2]])


def beside_the_vehicle(edges: Edges, scene: Path, drive: Path) -> Edges:
    """Edges in the scene's frame, as they lie about the nearest unit's pose: without the errors of the trajectory."""
    own, true = read_tum(scene / "poses.tum").world_from_rig, read_tum(drive / "truth.tum").world_from_rig
    nearest = cKDTree(true[:, :2, 3]).query(edges.at_m)[1]
    own_from_true = (own @ se3.inverse(true))[nearest]
    height_m = true[nearest, 2, 3]
    at = np.einsum("nij,nj->ni", own_from_true[:, :2, :3], np.column_stack([edges.at_m, height_m]))
    return Edges(at + own_from_true[:, :2, 3], np.einsum("nij,nj->ni", own_from_true[:, :2, :2], edges.outward))


@dataclass(frozen=True)
class EdgeErrors:
    """Signed distances (n,) of edges in a picture from the true ones, NaN where there is none, of those that are
    shown."""

    error_m: Floats

    def within(self, distance_m: float) -> float:
        """Share of the shown edges that are found so near to the true ones."""
        return float((np.abs(self.error_m) <= distance_m).mean())


def edge_errors(picture: Bytes, truth_from_pixel: Floats, edges: Edges, near: Bools) -> EdgeErrors:
    """Find true edges, those that are `near`, in a picture (h, w, 4) whose pixels are at `truth_from_pixel` (2, 3)."""
    t = np.arange(-INSIDE_M, OUTSIDE_M, STEP_M)
    xy = edges.at_m[near][:, None] + t[:, None] * edges.outward[near][:, None]
    pixel = (xy - truth_from_pixel[:, 2]) @ np.linalg.inv(truth_from_pixel[:, :2]).T - 0.5
    gray = np.where(picture[..., 3] == 255, cv2.cvtColor(picture[..., :3], cv2.COLOR_RGB2GRAY), -1e6).astype(np.float32)
    maps = (pixel[..., k].astype(np.float32) for k in (0, 1))
    profile = cv2.remap(gray, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1e6)
    profile = profile[profile.min(1) >= 0]
    plateau = round(PLATEAU_M / STEP_M)
    paint, ground = profile[:, :plateau].mean(1), profile[:, -plateau:].mean(1)
    smooth = cv2.GaussianBlur(profile, (0, 0), 0.012 / STEP_M, sigmaY=1e-6)
    fall = smooth[:, :-1] - smooth[:, 1:]
    error = t[fall.argmax(1)] + STEP_M / 2
    return EdgeErrors(np.where(paint - ground > MIN_CONTRAST * ground, error, np.nan))
