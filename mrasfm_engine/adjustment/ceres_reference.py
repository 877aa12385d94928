"""Camera set bundle adjustment by Ceres, through pycolmap: slower, by other people, and therefore the reference.

It takes a `Problem` and returns what `solver.solve` returns. What COLMAP has no words for is refused: terms besides the
observations, one focal factor for fx and fy, and shots apart from their unit's timestamp. A rig of COLMAP's stands
where one of its cameras does, which is held: the first that is fixed. (A rig whose reference sees nothing keeps all of
its cameras where they are, whatever the options say.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mrasfm_engine.adjustment.problem import UNIT_DOF
from mrasfm_engine.adjustment.solver import Problem, Report, Termination
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import FISHEYE, PERSPECTIVE, RADIAL
from mrasfm_engine.scene.state import State

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MODEL = {PERSPECTIVE: "PINHOLE", RADIAL: "OPENCV", FISHEYE: "OPENCV_FISHEYE"}
PARAMS = {PERSPECTIVE: 4, RADIAL: 8, FISHEYE: 8}
IMAGE_SIZE_PX = 1 << 14  # COLMAP asks for one; the adjustment does not


@dataclass(kw_only=True)
class CeresProblem:
    """A problem handed over to COLMAP."""

    problem: Problem
    reconstruction: pycolmap.Reconstruction
    point_ids: Ints  # (p,)

    @property
    def reference(self) -> int:
        """The camera where the rig stands."""
        return int(np.flatnonzero(self.problem.layout.camera_slot < 0)[0])

    @staticmethod
    def of(problem: Problem) -> CeresProblem:
        """Hand a problem over.

        Raises
        ------
        ValueError
            Where COLMAP cannot express it.
        """
        if problem.terms or problem.motion is not None:
            raise ValueError("COLMAP knows neither other terms nor images apart from their unit's timestamp")
        if problem.layout.free_focal:
            raise ValueError("COLMAP varies fx and fy each on its own")
        if not (problem.layout.camera_slot < 0).any():
            raise ValueError("COLMAP holds one camera of a rig, and all are free")
        reconstruction = pycolmap.Reconstruction()
        point_ids = np.zeros(problem.observations.num_points, dtype=np.int64)
        handed = CeresProblem(problem=problem, reconstruction=reconstruction, point_ids=point_ids)
        rig_from_reference = problem.state.rig_from_cam[handed.reference]
        _add_rig(reconstruction, problem, handed.reference)
        o, cameras = problem.observations, len(problem.camera_kind)
        image = o.unit * cameras + o.camera + 1
        order = np.argsort(image, kind="stable")
        bounds = np.searchsorted(image[order], np.arange(len(problem.layout.unit_slot) * cameras + 2))
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order)) - bounds[image[order]]
        for u in range(len(problem.layout.unit_slot)):
            _add_frame(
                reconstruction,
                se3.inverse(problem.state.world_from_rig[u] @ rig_from_reference),
                u,
                [o.xy_px[order[bounds[i] : bounds[i + 1]]] for i in range(u * cameras + 1, (u + 1) * cameras + 1)],
            )
        for p, (lo, hi) in enumerate(zip(o.first_of_point[:-1], o.first_of_point[1:], strict=True)):
            track = pycolmap.Track()
            for i, k in zip(image[lo:hi].tolist(), place[lo:hi].tolist(), strict=True):
                track.add_element(i, k)
            point_ids[p] = reconstruction.add_point3D(problem.state.points_m[p], track)
        return handed

    def adjuster(self) -> pycolmap.BundleAdjuster:
        """COLMAP's adjuster with the options of the problem; `solve` does the work."""
        problem, layout = self.problem, self.problem.layout
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
        options.print_summary = False
        options.refine_sensor_from_rig = layout.num_cameras > 0
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        # COLMAP's residuals are in pixels.
        options.ceres.loss_function_scale = problem.options.loss_scale * problem.options.sigma_px
        solver = options.ceres.solver_options
        solver.function_tolerance = problem.options.function_tolerance
        solver.max_num_iterations = problem.options.max_iterations
        solver.num_threads = problem.options.threads
        config = pycolmap.BundleAdjustmentConfig()
        for image in self.reconstruction.images:
            config.add_image(image)
        for u in np.flatnonzero(layout.unit_slot < 0):
            config.set_constant_rig_from_world_pose(int(u) + 1)
        for c in np.flatnonzero(layout.camera_slot < 0):
            if c != self.reference:
                config.set_constant_sensor_from_rig_pose(_sensor(int(c)))
            config.set_constant_cam_intrinsics(int(c) + 1)
        if problem.observations.fixed is not None:
            for point_id in self.point_ids[problem.observations.fixed].tolist():
                config.add_constant_point(point_id)
        return pycolmap.create_default_bundle_adjuster(options, config, self.reconstruction)

    def state(self) -> State:
        """What the reconstruction holds now."""
        before, rig = self.problem.state, self.reconstruction.rigs[1]
        rig_from_reference = before.rig_from_cam[self.reference]
        units = np.stack(
            [
                _inverse(self.reconstruction.frames[u + 1].rig_from_world)
                for u in range(len(self.problem.layout.unit_slot))
            ]
        ) @ se3.inverse(rig_from_reference)
        cameras = before.rig_from_cam.copy()
        for c in range(len(cameras)):
            if c != self.reference:
                cameras[c] = rig_from_reference @ _inverse(rig.sensor_from_rig(_sensor(c)))
        params = before.camera_params.copy()
        for c, kind in enumerate(self.problem.camera_kind):
            params[c, : PARAMS[int(kind)]] = self.reconstruction.cameras[c + 1].params
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
    ValueError
        Where COLMAP cannot express the problem.
    RuntimeError
        Where Ceres finds no usable solution.
    """
    handed = CeresProblem.of(problem)
    summary = handed.adjuster().solve()
    if not summary.is_solution_usable():
        raise RuntimeError(f"Ceres found no solution: {summary.brief_report()}")
    state, layout = handed.state(), problem.layout
    converged = summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE
    free = UNIT_DOF * (layout.num_units + layout.num_cameras)  # focal lengths are held
    return state, Report(
        initial_cost=problem.cost(problem.state),
        final_cost=problem.cost(state),
        iterations=problem.options.max_iterations,
        termination=Termination.CONVERGED if converged else Termination.ITERATIONS,
        observations=len(problem.observations.unit),
        parameters=free + 3 * problem.observations.num_free_points,
        pose_parameters=free,
    )


def _sensor(camera: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=camera + 1)


def _add_rig(reconstruction: pycolmap.Reconstruction, problem: Problem, reference: int) -> None:
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(_sensor(reference))
    rig_from_reference = problem.state.rig_from_cam[reference]
    for c, kind in enumerate(problem.camera_kind.tolist()):
        params = problem.state.camera_params[c, : PARAMS[kind]]
        size = {"width": IMAGE_SIZE_PX, "height": IMAGE_SIZE_PX}
        reconstruction.add_camera(pycolmap.Camera(camera_id=c + 1, model=MODEL[kind], params=params, **size))
        if c != reference:
            rig.add_sensor(_sensor(c), _rigid(se3.inverse(problem.state.rig_from_cam[c]) @ rig_from_reference))
    reconstruction.add_rig(rig)


def _add_frame(
    reconstruction: pycolmap.Reconstruction, reference_from_world: Floats, unit: int, xy_px: list[Floats]
) -> None:
    frame = pycolmap.Frame(frame_id=unit + 1, rig_id=1)
    frame.rig_from_world = _rigid(reference_from_world)
    first = unit * len(xy_px) + 1
    for c in range(len(xy_px)):
        frame.add_data_id(pycolmap.data_t(sensor_id=_sensor(c), id=first + c))
    reconstruction.add_frame(frame)
    for c, xy in enumerate(xy_px):
        image = pycolmap.Image(name=f"{unit}-{c}", keypoints=xy, camera_id=c + 1, image_id=first + c)
        image.frame_id = unit + 1
        reconstruction.add_image(image)
    reconstruction.register_frame(unit + 1)


def _rigid(matrix: Floats) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(matrix[:3, :3]), matrix[:3, 3])


def _inverse(pose: pycolmap.Rigid3d) -> Floats:
    matrix = pose.matrix()
    return se3.inverse(se3.transform(matrix[:, :3], matrix[:, 3]))
