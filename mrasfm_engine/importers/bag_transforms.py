"""Transforms of a bag (tf and tf_static): the pose of one frame in another, fixed or moving."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats, Ints

# Transforms that are published again and again differ by rounding; a joint or a suspension moves by more.
MAX_MOTION_M, MAX_MOTION_DEG = 1e-3, 0.02
MAX_SAMPLES = 20_000_000  # of all moving frames: 1.3 GB


@dataclass(kw_only=True)
class _Edge:
    """Pose of a frame in its parent: the first one, how far later ones are from it, and all where they are kept."""

    parent: str
    parent_from_child: Floats
    motion_m: float = 0.0
    motion_deg: float = 0.0
    times_us: array[int] = field(default_factory=lambda: array("q"))
    poses: array[float] = field(default_factory=lambda: array("d"))

    @property
    def is_fixed(self) -> bool:
        return self.motion_m <= MAX_MOTION_M and self.motion_deg <= MAX_MOTION_DEG


class TransformTree:
    """Frames of a bag and the transforms between them.

    Parameters
    ----------
    keeps_motion
        Whether every pose of a moving frame is kept, for `moving`; else only how far it moves.
    """

    def __init__(self, *, keeps_motion: bool = False) -> None:
        self._edges: dict[str, _Edge] = {}
        self._defects: dict[str, InputError] = {}  # by the child of the transforms at fault
        self._left_out: dict[str, InputError] = {}  # by the parent that is not the first of its child
        self._keeps_motion = keeps_motion
        self._samples = 0

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    def add(self, message: Any, *, topic: str) -> None:
        """Add the transforms of one TFMessage.

        A rotation that is no unit quaternion, and a second parent of a frame, are refused where a chain of transforms
        needs that frame: bags hold frames of arms, wheels and other maps that no camera depends on.

        Raises
        ------
        InputError
            If there are more than can be kept.
        """
        for stamped in message.transforms:
            self._add(stamped, topic)

    def _add(self, stamped: Any, topic: str) -> None:
        parent, child = _name(stamped.header.frame_id), _name(stamped.child_frame_id)
        try:
            pose = _matrix(stamped.transform, where=f"{topic}: transform from {child} to {parent}")
        except InputError as defect:
            self._defects.setdefault(child, defect)
            return
        edge = self._edges.setdefault(child, _Edge(parent=parent, parent_from_child=pose))
        if edge.parent != parent:
            two_parents = InputError(
                f"{topic}: frame {child} has two parents, {edge.parent} and {parent}",
                remedy="Record one publisher of this transform.",
                code="bad-transforms",
            )
            self._defects.setdefault(child, two_parents)
            self._left_out.setdefault(parent, two_parents)
            return
        if edge.is_fixed:  # a frame that has moved needs no second look, and bags have many transforms
            difference = se3.inverse(edge.parent_from_child) @ pose
            edge.motion_m = max(edge.motion_m, float(np.linalg.norm(difference[:3, 3])))
            edge.motion_deg = max(edge.motion_deg, float(se3.rotation_angle_deg(difference[:3, :3])))
        if self._keeps_motion:
            self._keep(edge, pose, _stamp_us(stamped.header.stamp), topic)

    def _keep(self, edge: _Edge, pose: Floats, time_us: int, topic: str) -> None:
        if edge.times_us and time_us <= edge.times_us[-1]:
            return  # published twice, or overtaken by a later one
        self._samples += 1
        if self._samples > MAX_SAMPLES:
            raise InputError(
                f"{topic} holds over {MAX_SAMPLES} transforms", remedy="Import without --world-frame.", code="bad-size"
            )
        edge.times_us.append(time_us)
        edge.poses.extend([*pose[:3, 3].tolist(), *se3.quaternion_from_rotation(pose[:3, :3]).tolist()])

    def fixed(self, to: str, frame: str, *, what: str) -> Floats:
        """The pose (4, 4) of a frame in another one, both fixed to the vehicle.

        Parameters
        ----------
        what
            What is at the frame, for messages.

        Raises
        ------
        InputError
            If one of them is unknown, nothing links them, or a transform between them moves or is at fault.
        """
        to_from_root, root_from_frame = self._chains(to, frame, what=what)
        for child, edge in [*to_from_root, *root_from_frame]:
            if not edge.is_fixed:
                raise InputError(
                    f"{what}: the transform from {child} to {edge.parent} moves by {edge.motion_m:.3f} m and "
                    f"{edge.motion_deg:.2f} deg, so that {frame} is not fixed to {to}",
                    remedy="Name a frame that is fixed to the cameras with --rig-frame.",
                    code="moving-frame",
                )
        return se3.inverse(_product(to_from_root)) @ _product(root_from_frame)

    def moving(self, to: str, frame: str, at_us: Ints, *, what: str) -> tuple[Floats, Ints]:
        """Poses (m, 4, 4) of a frame in another one, and the times (m,) among those given that all transforms cover.

        Raises
        ------
        InputError
            If one of them is unknown, nothing links them, or a transform between them is at fault.
        """
        to_from_root, root_from_frame = self._chains(to, frame, what=what)
        moving = [edge for _, edge in [*to_from_root, *root_from_frame] if not edge.is_fixed]
        start_us = max((edge.times_us[0] for edge in moving), default=0)
        end_us = min((edge.times_us[-1] for edge in moving), default=2**62)
        covered = at_us[(at_us >= start_us) & (at_us <= end_us)]
        upper, lower = (self._products(chain, covered) for chain in (to_from_root, root_from_frame))
        return se3.inverse(upper) @ lower, covered

    def _products(self, chain: list[tuple[str, _Edge]], at_us: Ints) -> Floats:
        product = np.broadcast_to(np.eye(4), (len(at_us), 4, 4))
        for _, edge in reversed(chain):
            product = product @ (edge.parent_from_child if edge.is_fixed else _interpolated(edge, at_us))
        return product

    def _chains(self, to: str, frame: str, *, what: str) -> tuple[list[tuple[str, _Edge]], list[tuple[str, _Edge]]]:
        """Edges from each of the frames up to the first that they have in common."""
        for name in (to, frame):
            if name not in self.frames:
                if known_defect := self._defects.get(name, self._left_out.get(name)):
                    raise known_defect
                known = ", ".join(self.frames[:20]) or "none: the bag has no tf or tf_static"
                raise InputError(
                    f"{what}: no transform has the frame {name!r}. Known frames: {known}",
                    remedy="Record tf_static, name the vehicle's frame with --rig-frame, or give the cameras' poses "
                    "with --calibration.",
                    code="missing-transform",
                )
        above_to, above_frame = list(self._upward(to)), list(self._upward(frame))
        shared = {name for name, _ in above_frame} & {name for name, _ in above_to}
        if not shared:
            # What is at fault may be the link that is missing.
            for name, _ in [*above_to, *above_frame]:
                if name in self._defects:
                    raise self._defects[name]
            raise InputError(
                f"{what}: no transforms link the frames {frame!r} and {to!r}",
                remedy="Record tf_static completely, name the vehicle's frame with --rig-frame, or give the cameras' "
                "poses with --calibration.",
                code="missing-transform",
            )
        chains = _up_to(above_to, shared), _up_to(above_frame, shared)
        for name, _ in [*chains[0], *chains[1]]:
            if name in self._defects:
                raise self._defects[name]
        return chains

    def _upward(self, frame: str) -> Iterator[tuple[str, _Edge | None]]:
        """A frame and those above it, each with the edge that leads farther up."""
        passed = set()
        while frame not in passed:
            passed.add(frame)
            edge = self._edges.get(frame)
            yield frame, edge
            if edge is None:
                return
            frame = edge.parent


def _up_to(chain: list[tuple[str, _Edge | None]], ends: set[str]) -> list[tuple[str, _Edge]]:
    edges: list[tuple[str, _Edge]] = []
    for name, edge in chain:
        if name in ends or edge is None:
            break
        edges.append((name, edge))
    return edges


def _product(chain: list[tuple[str, _Edge]]) -> Floats:
    product = np.eye(4)
    for _, edge in reversed(chain):
        product = product @ edge.parent_from_child
    return product


def _interpolated(edge: _Edge, at_us: Ints) -> Floats:
    rows = np.frombuffer(edge.poses, np.float64).reshape(-1, 7)
    poses = se3.transform(se3.rotation_from_quaternion(rows[:, 3:]), rows[:, :3])
    return se3.interpolate(np.frombuffer(edge.times_us, np.int64), poses, at_us)


def _name(frame: str) -> str:
    return frame.removeprefix("/")  # as in ROS 1 before tf2


def _stamp_us(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000 + (int(stamp.nanosec) + 500) // 1000


def _matrix(given: Any, *, where: str) -> Floats:
    q = np.array([given.rotation.x, given.rotation.y, given.rotation.z, given.rotation.w])
    t = np.array([given.translation.x, given.translation.y, given.translation.z])
    if not (np.isfinite(t).all() and abs(np.linalg.norm(q) - 1.0) <= 1e-3):  # also refuses NaN
        raise InputError(
            f"{where}: rotation {q.tolist()} is no unit quaternion, or translation {t.tolist()} is not finite",
            remedy="Correct its publisher.",
            code="bad-transform",
        )
    return se3.transform(se3.rotation_from_quaternion(q), t)
