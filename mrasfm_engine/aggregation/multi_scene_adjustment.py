"""Multi-scene adjustment: one adjustment of the transforms of all scenes of a component, over joined points.

Points that seams join become tracks over any number of scenes. All scenes but one vary rigidly, over all tracks at
once, so that no seam is favoured by its order. GNSS then places the result (see `map_placement`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.seam import Seam
from mrasfm_engine.aggregation.seam_refinement import OBSERVATIONS_OF_IMAGE, moved_scenes, tracks_of, transform_problem
from mrasfm_engine.bundle_adjustment.observation_sampling import solve_with_chosen_points
from mrasfm_engine.bundle_adjustment.solver import Report
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.types import Floats, Ints

MIN_TRACKS = 10


def joined_owner(assembly: Assembly, seams: Sequence[Seam]) -> Ints:
    """The joined point (p,) of every point of an assembly, numbered without gaps; -1 for points of one scene alone.

    Seams with most shared points come first. A pair that would join two points of one scene is left out.
    """
    parent = np.arange(assembly.first_point[-1])
    members: dict[int, set[int]] = {}
    number = {scene.name: k for k, scene in enumerate(assembly.scenes)}
    scene_of = assembly.scene_of_point

    def root(point: int) -> int:
        while parent[point] != point:
            parent[point] = parent[parent[point]]
            point = int(parent[point])
        return point

    for seam in sorted(seams, key=lambda s: -len(s.shared)):
        offsets = assembly.first_point[[number[seam.a], number[seam.b]]]
        for a, b in (seam.shared + offsets).tolist():
            ra, rb = root(a), root(b)
            scenes_a, scenes_b = (members.get(r, {int(scene_of[r])}) for r in (ra, rb))
            if ra == rb or scenes_a & scenes_b:
                continue
            parent[rb] = ra
            members[ra] = scenes_a | scenes_b
    roots = np.array([root(int(p)) for p in np.flatnonzero(parent != np.arange(len(parent)))], dtype=np.int64)
    owner = np.full(len(parent), -1, dtype=np.int64)
    if not len(roots):
        return owner
    tops = np.unique(roots)
    label = np.full(len(parent), -1, dtype=np.int64)
    label[tops] = np.arange(len(tops))
    owner[tops] = label[tops]
    joined = np.flatnonzero(parent != np.arange(len(parent)))
    owner[joined] = label[roots]
    return owner


@dataclass(frozen=True, kw_only=True)
class JointResult:
    """Scenes of a component after their joint adjustment."""

    first_from_scene: Floats  # (scenes, 4, 4)
    owner: Ints  # (p,) see `joined_owner`
    report: Report | None


def adjust_jointly(
    assembly: Assembly,
    first_from_scene: Floats,
    seams: Sequence[Seam],
    fixed: int,
    config: EngineConfig,
    *,
    cancel: Callable[[], bool],
) -> JointResult:
    """Adjust how all scenes lie over all that they share; scene `fixed` stays.

    Parameters
    ----------
    seams
        Accepted ones, all between scenes of the assembly.
    """
    owner = joined_owner(assembly, seams)
    tracks = tracks_of(assembly, owner)
    if not config.aggregation.multi_scene_adjustment or tracks.count < MIN_TRACKS or len(assembly.scenes) < 2:
        return JointResult(first_from_scene=first_from_scene, owner=owner, report=None)
    sets = np.arange(len(assembly.scenes))
    sets = np.where(sets == fixed, -1, sets - (sets > fixed))
    problem = transform_problem(assembly, assembly.state(first_from_scene), tracks, sets, config)
    solution, report = solve_with_chosen_points(
        problem, assembly.image_size_px, an_image=OBSERVATIONS_OF_IMAGE, cancel=cancel
    )
    poses = moved_scenes(assembly, first_from_scene, solution)
    return JointResult(first_from_scene=poses, owner=owner, report=report)
