"""Camera set bundle adjustment by Ceres, through pycolmap: slower, by other people, and therefore the reference.

It takes a `Problem` and returns what `solver.solve` returns. What COLMAP has no words for is refused: row bands apart
from their unit's timestamp, and one focal factor for fx and fy where they differ or where the distortion has more
terms than COLMAP's models of one focal length. `ceres_terms` hands over the terms besides observations, with pyceres.

A rig of COLMAP's stands where one of its cameras does, which is held: the first that is fixed. Where all are free, a
sensor without images stands at the rig's origin. (A rig whose reference sees nothing keeps all of its cameras where
they are, whatever the options say, until they are set free one by one.) Units that move as one are a rig of their own,
which has a camera for every image.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from types import ModuleType

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mrasfm_engine.bundle_adjustment.solver import Problem, Report, Termination
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import ADJUSTED, FISHEYE, PERSPECTIVE, RADIAL
from mrasfm_engine.scene.state import State

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# COLMAP's models with two focal lengths, and with one, and how many terms of distortion they have.
MODEL = {PERSPECTIVE: ("PINHOLE", 0), RADIAL: ("OPENCV", 4), FISHEYE: ("OPENCV_FISHEYE", 4)}
ONE_FOCAL_MODEL = {PERSPECTIVE: ("SIMPLE_PINHOLE", 0), RADIAL: ("RADIAL", 2), FISHEYE: ("RADIAL_FISHEYE", 2)}
IMAGE_SIZE_PX = 1 << 14  # COLMAP asks for one; the adjustment does not


@dataclass(kw_only=True)
class CeresProblem:
    """A problem handed over to COLMAP."""

    problem: Problem
    reconstruction: pycolmap.Reconstruction
    point_ids: Ints  # (p,)
    residuals: list[object] = field(default_factory=list)  # of the terms: Ceres only borrows them

    @cached_property
    def reference(self) -> int | None:
        """The camera where rigs stand; None where they stand at their origin."""
        fixed = np.flatnonzero(self.problem.layout.camera_slot < 0)
        return int(fixed[0]) if len(fixed) else None

    @cached_property
    def rig_from_reference(self) -> Floats:
        """Constant transform (4, 4)."""
        return np.eye(4) if self.reference is None else self.problem.state.rig_from_cam[self.reference]

    @cached_property
    def set_of_unit(self) -> Ints:
        """(u,) -1 for units that move by themselves."""
        sets = self.problem.sets
        return np.full(len(self.problem.layout.unit_slot), -1) if sets is None else sets.of_unit

    @cached_property
    def leader(self) -> Ints:
        """The unit (u,) that stands for all of its set; units that move by themselves stand for themselves."""
        first = {k: int(np.flatnonzero(self.set_of_unit == k)[0]) for k in np.unique(self.set_of_unit).tolist()}
        return np.array([u if k < 0 else first[k] for u, k in enumerate(self.set_of_unit.tolist())], dtype=np.int64)

    @cached_property
    def reference_from_unit(self) -> Floats:
        """Constant transforms (u, 4, 4) to units from where the rig that carries them stands."""
        world_from_rig = self.problem.state.world_from_rig
        leader_from_unit: Floats = se3.inverse(world_from_rig[self.leader]) @ world_from_rig
        return se3.inverse(self.rig_from_reference) @ leader_from_unit

    @staticmethod
    def of(problem: Problem) -> CeresProblem:
        """Hand a problem over.

        Raises
        ------
        ValueError
            Where COLMAP cannot express it.
        """
        if problem.motion is not None:
            raise ValueError("COLMAP does not know images apart from their unit's timestamp")
        if problem.sets is not None and problem.layout.num_cameras:
            raise ValueError("units that move as one need a fixed calibration")
        reconstruction = pycolmap.Reconstruction()
        point_ids = np.zeros(problem.observations.num_points, dtype=np.int64)
        handed = CeresProblem(problem=problem, reconstruction=reconstruction, point_ids=point_ids)
        o, cameras, units = problem.observations, len(problem.camera_kind), len(problem.layout.unit_slot)
        image = o.unit * cameras + o.camera + 1
        order = np.argsort(image, kind="stable")
        bounds = np.searchsorted(image[order], np.arange(units * cameras + 2))
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order)) - bounds[image[order]]
        xy_px = [o.xy_px[order[bounds[i] : bounds[i + 1]]] for i in range(1, units * cameras + 1)]
        for k in np.unique(handed.set_of_unit).tolist():
            handed._add_rig(k)
        for leader in np.unique(handed.leader).tolist():
            handed._add_frame(leader, xy_px)
        for p, (lo, hi) in enumerate(zip(o.first_of_point[:-1], o.first_of_point[1:], strict=True)):
            track = pycolmap.Track()
            for i, k in zip(image[lo:hi].tolist(), place[lo:hi].tolist(), strict=True):
                track.add_element(i, k)
            point_ids[p] = reconstruction.add_point3D(problem.state.points_m[p], track)
        return handed

    def _camera_id(self, unit: int, camera: int) -> int:
        """Cameras of units that move by themselves are the same ones; every unit of a set has its own."""
        carrier = 0 if self.set_of_unit[unit] < 0 else unit + 1
        return carrier * len(self.problem.camera_kind) + camera + 1

    def _reference_sensor(self, leader: int) -> pycolmap.sensor_t:
        if self.reference is None:
            return pycolmap.sensor_t(type=pycolmap.SensorType.IMU, id=1)
        return _sensor(self._camera_id(leader, self.reference))

    def _add_rig(self, of_set: int) -> None:
        """The rig of a set's units, or of all those that move by themselves (-1)."""
        members = np.flatnonzero(self.set_of_unit == of_set)
        members = members if of_set >= 0 else members[:1]
        rig = pycolmap.Rig(rig_id=_rig_id(of_set))
        reference = self._reference_sensor(int(members[0]))
        rig.add_ref_sensor(reference)
        for u in members.tolist():
            for c in range(len(self.problem.camera_kind)):
                camera_id = self._camera_id(u, c)
                self.reconstruction.add_camera(_camera(self.problem, c, camera_id))
                if _sensor(camera_id) != reference:
                    reference_from_cam = self.reference_from_unit[u] @ self.problem.state.rig_from_cam[c]
                    rig.add_sensor(_sensor(camera_id), _rigid(se3.inverse(reference_from_cam)))
        self.reconstruction.add_rig(rig)

    def _add_frame(self, leader: int, xy_px: list[Floats]) -> None:
        """The frame of a unit and of those that move with it; its number is the unit's + 1."""
        cameras = len(self.problem.camera_kind)
        frame = pycolmap.Frame(frame_id=leader + 1, rig_id=_rig_id(int(self.set_of_unit[leader])))
        unit_from_world = se3.inverse(self.problem.state.world_from_rig_of(np.array([leader]))[0])
        frame.rig_from_world = _rigid(self.reference_from_unit[leader] @ unit_from_world)
        images = [(u, c) for u in np.flatnonzero(self.leader == leader).tolist() for c in range(cameras)]
        for u, c in images:
            frame.add_data_id(pycolmap.data_t(sensor_id=_sensor(self._camera_id(u, c)), id=u * cameras + c + 1))
        self.reconstruction.add_frame(frame)
        for u, c in images:
            ids = {"camera_id": self._camera_id(u, c), "image_id": u * cameras + c + 1}
            image = pycolmap.Image(name=f"{u}-{c}", keypoints=xy_px[u * cameras + c], **ids)
            image.frame_id = leader + 1
            self.reconstruction.add_image(image)
        self.reconstruction.register_frame(leader + 1)

    def adjuster(self) -> pycolmap.BundleAdjuster:
        """COLMAP's adjuster with the options of the problem; `solve` does the work.

        Raises
        ------
        ImportError
            Without pyceres, where there are terms or all cameras are free.
        ValueError
            Where a term is of a kind that is not known here, or on something that no image observes.
        """
        options, config = self._options(), self._config()
        if not self.problem.terms and self.reference is not None:
            return pycolmap.create_default_bundle_adjuster(options, config, self.reconstruction)
        add_terms = _ceres_terms().add_terms
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, self.reconstruction)
        for c in np.flatnonzero(self.problem.layout.camera_slot >= 0).tolist() if self.reference is None else ():
            if not adjuster.problem.has_parameter_block(self.camera_pose(c)):
                raise ValueError(f"no image of camera {c} observes anything: COLMAP does not vary it")
            adjuster.problem.set_parameter_block_variable(self.camera_pose(c))
        self.residuals += add_terms(self, adjuster.problem)
        return adjuster

    def _options(self) -> pycolmap.BundleAdjustmentOptions:
        problem, layout = self.problem, self.problem.layout
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_principal_point = options.refine_extra_params = False
        options.refine_focal_length = bool(layout.free_intrinsics[:, 0].any())
        options.print_summary = False
        options.refine_sensor_from_rig = layout.num_cameras > 0
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        # COLMAP's residuals are in pixels.
        options.ceres.loss_function_scale = problem.options.loss_scale * problem.options.sigma_px
        solver = options.ceres.solver_options
        solver.function_tolerance = problem.options.function_tolerance
        solver.max_num_iterations = problem.options.max_iterations
        # Residuals in Python wait for the interpreter's lock, which `solve` keeps: on other threads, for ever.
        solver.num_threads = 1 if problem.terms else problem.options.threads
        return options

    def _config(self) -> pycolmap.BundleAdjustmentConfig:
        layout = self.problem.layout
        config = pycolmap.BundleAdjustmentConfig()
        for image in self.reconstruction.images:
            config.add_image(image)
        for u in np.flatnonzero(layout.unit_slot < 0):
            config.set_constant_rig_from_world_pose(int(u) + 1)
        for camera_id in self.reconstruction.cameras:
            c = (camera_id - 1) % len(self.problem.camera_kind)
            if layout.camera_slot[c] < 0:
                config.set_constant_cam_intrinsics(camera_id)
                if c != self.reference:
                    config.set_constant_sensor_from_rig_pose(_sensor(camera_id))
        if self.problem.observations.fixed is not None:
            for point_id in self.point_ids[self.problem.observations.fixed].tolist():
                config.add_constant_point(point_id)
        return config

    def unit_pose(self, unit: int) -> Floats:
        """What Ceres varies for a unit (7,): the pose, from the world, of where its rig stands."""
        pose: Floats = self.reconstruction.frames[int(self.leader[unit]) + 1].rig_from_world.params
        return pose

    def camera_pose(self, camera: int) -> Floats:
        """What Ceres varies for a free camera (7,): its pose from where the rig stands."""
        pose: Floats = self.reconstruction.rigs[_rig_id(-1)].non_ref_sensors[_sensor(camera + 1)].params
        return pose

    def intrinsics(self, camera: int) -> Floats:
        """A camera's parameters (n,) in the order of COLMAP's model, the focal length first."""
        params: Floats = self.reconstruction.cameras[camera + 1].params
        return params

    def state(self) -> State:
        """What the reconstruction holds now; what is fixed, as it was given."""
        before, layout = self.problem.state, self.problem.layout
        units, cameras, params = before.world_from_rig, before.rig_from_cam, before.camera_params.copy()
        for u in np.flatnonzero(layout.unit_slot >= 0).tolist():
            units[u] = se3.inverse(matrix_of(self.unit_pose(u))) @ self.reference_from_unit[u]
        for c in np.flatnonzero(layout.camera_slot >= 0).tolist():
            cameras[c] = self.rig_from_reference @ se3.inverse(matrix_of(self.camera_pose(c)))
            if layout.free_intrinsics[:, 0].any():
                params[c, :2] = self.intrinsics(c)[0]
        return replace(
            before,
            unit_rotation=np.ascontiguousarray(units[:, :3, :3]),
            unit_position_m=np.ascontiguousarray(units[:, :3, 3]),
            camera_rotation=np.ascontiguousarray(cameras[:, :3, :3]),
            camera_position_m=np.ascontiguousarray(cameras[:, :3, 3]),
            camera_params=params,
            points_m=np.stack([self.reconstruction.points3D[int(p)].xyz for p in self.point_ids]),
        )


def solve_with_ceres(problem: Problem) -> tuple[State, Report]:
    """As `solver.solve`.

    Raises
    ------
    ImportError
        Without pyceres, where there are terms or all cameras are free.
    ValueError
        Where COLMAP cannot express the problem.
    RuntimeError
        Where Ceres finds no usable solution.
    """
    handed = CeresProblem.of(problem)
    summary = handed.adjuster().solve()
    if not summary.is_solution_usable():
        raise RuntimeError(f"Ceres found no solution: {summary.brief_report()}")
    state = handed.state()
    converged = summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE
    return state, Report(
        initial_cost=problem.cost(problem.state),
        final_cost=problem.cost(state),
        iterations=problem.options.max_iterations,
        termination=Termination.CONVERGED if converged else Termination.ITERATIONS,
        observations=len(problem.observations.unit),
        parameters=problem.unknowns + 3 * problem.observations.num_free_points,
        pose_parameters=problem.unknowns,
    )


def matrix_of(pose: Floats) -> Floats:
    """Transform (4, 4) of what Ceres varies (7,): a quaternion, x y z w, and a translation."""
    return se3.transform(se3.rotation_from_quaternion(pose[:4]), pose[4:])


def _ceres_terms() -> ModuleType:
    try:
        from tests.helpers import ceres_terms
    except ModuleNotFoundError as error:
        if error.name != "pyceres":
            raise
        raise ImportError("Ceres takes terms, and cameras that are all free, through pyceres: install it") from error
    return ceres_terms


def _rig_id(of_set: int) -> int:
    return of_set + 2


def _sensor(camera_id: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=camera_id)


def _camera(problem: Problem, camera: int, camera_id: int) -> pycolmap.Camera:
    kind, params = int(problem.camera_kind[camera]), problem.state.camera_params[camera]
    one_focal = problem.layout.free_intrinsics[:, 0].any() and problem.layout.camera_slot[camera] >= 0
    model, terms = (ONE_FOCAL_MODEL if one_focal else MODEL)[kind]
    if one_focal and (params[0] != params[1] or params[4 + terms : ADJUSTED].any()):
        raise ValueError(
            f"camera {camera}: COLMAP varies one focal length only where fx = fy, and with {terms} terms of radial "
            "distortion at most"
        )
    theirs = params[1 if one_focal else 0 : 4 + terms]
    return pycolmap.Camera(camera_id=camera_id, model=model, params=theirs, width=IMAGE_SIZE_PX, height=IMAGE_SIZE_PX)


def _rigid(matrix: Floats) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(matrix[:3, :3]), matrix[:3, 3])
