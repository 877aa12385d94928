"""The compiled residuals of camera set bundle adjustment, and their derivatives.

One observation of point X by camera c of unit u, with (R_u, t_u) = world_from_rig, (A, b) = unit_from_band,
(R_c, t_c) = rig_from_cam:

    x_rig = R_u' (X - t_u)      x_band = A' (x_rig - b)      x_cam = R_c' (x_band - t_c)
    residual = (pixel(x_cam) - observed) / sigma

With P = d pixel / d x_cam (2x3), M = P R_c', Q = M A' and N = Q R_u' the derivatives in the steps of `problem` are,
row by row,

    d/dX     =  N                       d/dtau_u = -N            d/domega_u = N x (X - t_u)
    d/dtau_c = -M                       d/domega_c = M x (x_band - t_c)
    d/dphi   =  pixel - principal point      d/dintrinsics: see `intrinsics_derivatives`
    d/ddelta = -M (omega x x_band + v)       (omega, v) the rig's velocity at the row band, in its own axes there
    d/drho   =  d/ddelta (y / height - 1/2)

because R' exp(-omega) v = R' v + R' [v]x omega and n' [v]x omega = (n x v)' omega. The Cauchy loss enters by
reweighting: an observation counts w = 1 / (1 + r^2 / s^2) (its Gauss-Newton approximation).

Where the motion within a unit follows from the trajectory, a row band's pose takes part in steps of up to three units
(`support`, with `weight` w): d/dtau_i = -w_i N and d/domega_i = w_i N x (X - t_band). Left out is that a turned unit
also bends the way to its neighbours, which is small where a unit's step is short against the depth of points. A row
band that is held to its unit has no other support, and the derivatives above. Where all images are taken at their
unit's time, `bands` and `motion` are None: numba compiles the kernels without them, so that nobody pays for what is
not there.

Small functions of the inner loops are `forceinline`: LLVM puts them into their callers. With `inline="always"` numba
would copy their code before it infers types, and compile every copy anew, which takes several times as long. Constants
among a kernel's arguments are wrapped (`np.bool_(False)`): a literal is a type of its own, and compiled for itself.

What runs for every observation counts no references (`uncounted`): kernels ask for their memory and hand it on.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from mrasfm_engine.geometry.camera_model import inverse_depth, project
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Bools, Floats, Ints

BEHIND_PX = 1000.0  # what an observation costs whose point is where its camera shows nothing


class Views(NamedTuple):
    """Poses of units (u, 3, 3), (u, 3) and of cameras (c, 3, 3), (c, 3); the cameras' kinds and
    parameters (c, PARAMETERS)."""

    unit_r: Floats
    unit_t: Floats
    cam_r: Floats
    cam_t: Floats
    kind: Ints
    params: Floats


class Bands(NamedTuple):
    """Poses (s, 3, 3) and (s, 3) of row bands in their units, the row band (n,) of every observation, velocities.

    Of these (s, 6) and the readout (c, 3) of images see `problem.RowBandMotion`.
    """

    r: Floats
    t: Floats
    of_observation: Ints
    velocity: Floats
    readout: Floats


class Motion(NamedTuple):
    """Units (s, 3) whose steps move a row band, and their weights (s, 3): see `problem.RowBandMotion`."""

    support: Ints
    weight: Floats


class Observed(NamedTuple):
    """Unit, camera, point (n,) and pixel (n, 2) of every observation, by point; first one (p + 1,) of every point."""

    unit: Ints
    camera: Ints
    point: Ints
    xy: Floats
    first: Ints
    fixed: Bools


class Slots(NamedTuple):
    """Slots of units and cameras in the reduced vector, -1 where held; number of free units.

    `inner` is as long as a camera has places besides its pose, for intrinsics and its time offset: a length that is
    part of the type, so that loops over them are compiled for it.
    """

    unit: Ints
    camera: Ints
    num_units: int
    inner: tuple[int, ...]


class Loss(NamedTuple):
    """Standard deviation of an observation in pixels, and the Cauchy loss on residuals over it.

    With `is_curved` observations count in J' J with w^2 instead of their weight w: with the loss' second derivative,
    where residuals of a length point anywhere. J' r is the gradient all the same.
    """

    sigma: float
    scale2: float  # square of the loss' scale in sigmas
    is_curved: bool


@uncounted(forceinline=True)
def camera_point(
    unit_r: Any, unit_t: Any, bands: Any, band: int, follows: bool, cam_r: Any, cam_t: Any, x: Any,
    from_unit: Any, rig: Any, cam: Any,
) -> None:  # fmt: skip
    """from_unit = X - t_u (X - t_band where the row band follows several units), rig = x_band - t_c, cam = x_cam."""
    for i in range(3):
        from_unit[i] = x[i] - unit_t[i]
    if bands is None:
        for i in range(3):
            rig[i] = unit_r[0, i] * from_unit[0] + unit_r[1, i] * from_unit[1] + unit_r[2, i] * from_unit[2] - cam_t[i]
    else:
        for i in range(3):
            cam[i] = (
                unit_r[0, i] * from_unit[0] + unit_r[1, i] * from_unit[1] + unit_r[2, i] * from_unit[2]
                - bands.t[band, i]
            )  # fmt: skip
        if follows:
            for i in range(3):
                from_unit[i] = unit_r[i, 0] * cam[0] + unit_r[i, 1] * cam[1] + unit_r[i, 2] * cam[2]
        for i in range(3):
            rig[i] = (
                bands.r[band, 0, i] * cam[0] + bands.r[band, 1, i] * cam[1] + bands.r[band, 2, i] * cam[2] - cam_t[i]
            )
    for i in range(3):
        cam[i] = cam_r[0, i] * rig[0] + cam_r[1, i] * rig[1] + cam_r[2, i] * rig[2]


@njit(cache=True, nogil=True)
def squared_errors(
    views: Views, bands: Bands | None, points: Any, observed: Observed, lo: int, hi: int, out: Any
) -> None:
    """Squared reprojection errors in pixels of observations lo..hi; BEHIND_PX squared of points not seen."""
    _squared_errors(views, bands, points, observed, lo, hi, out, workspace(6))


@uncounted()
def _squared_errors(
    views: Views, bands: Bands | None, points: Any, observed: Observed, lo: int, hi: int, out: Any, memory: Any
) -> None:
    d, rig, cam, work, proj, _, _, _ = memory
    for n in range(lo, hi):
        u, c = observed.unit[n], observed.camera[n]
        band = 0 if bands is None else bands.of_observation[n]
        camera_point(
            views.unit_r[u], views.unit_t[u], bands, band, np.bool_(False), views.cam_r[c], views.cam_t[c],
            points[observed.point[n]], d, rig, cam,
        )  # fmt: skip
        if not project(views.kind[c], views.params[c], cam[0], cam[1], cam[2], work, proj):
            out[n] = BEHIND_PX * BEHIND_PX
            continue
        out[n] = (proj[0] - observed.xy[n, 0]) ** 2 + (proj[1] - observed.xy[n, 1]) ** 2


@uncounted(forceinline=True)
def linearise(
    unit_r: Any, unit_t: Any, bands: Any, band: int, follows: bool, c: int, camera_is_free: bool,
    cam_r: Any, cam_t: Any, kind: int, k: Any, x: Any, xy: Any, loss: Loss,
    d: Any, rig: Any, cam: Any, work: Any, proj: Any, res: Any, jx: Any, jc: Any,
) -> bool:  # fmt: skip
    """Weighted residual, and its derivatives in the point and a free camera, of one observation; False if it is not
    seen.

    Those in the unit follow from jx = N and d = X - t_u. Of a camera that is not free there are none.
    """
    camera_point(unit_r, unit_t, bands, band, follows, cam_r, cam_t, x, d, rig, cam)
    if not project(kind, k, cam[0], cam[1], cam[2], work, proj):
        return False
    r0, r1 = (proj[0] - xy[0]) / loss.sigma, (proj[1] - xy[1]) / loss.sigma
    weight = 1.0 / (1.0 + (r0 * r0 + r1 * r1) / loss.scale2)
    if loss.is_curved:
        res[0], res[1] = r0, r1
        s = weight / loss.sigma
    else:
        root = math.sqrt(weight)
        res[0], res[1] = r0 * root, r1 * root
        s = root / loss.sigma
    for i in range(2):
        p0, p1, p2 = proj[2 + 3 * i] * s, proj[3 + 3 * i] * s, proj[4 + 3 * i] * s
        m0 = p0 * cam_r[0, 0] + p1 * cam_r[0, 1] + p2 * cam_r[0, 2]
        m1 = p0 * cam_r[1, 0] + p1 * cam_r[1, 1] + p2 * cam_r[1, 2]
        m2 = p0 * cam_r[2, 0] + p1 * cam_r[2, 1] + p2 * cam_r[2, 2]
        if bands is None:
            q0, q1, q2 = m0, m1, m2
        else:
            q0 = m0 * bands.r[band, 0, 0] + m1 * bands.r[band, 0, 1] + m2 * bands.r[band, 0, 2]
            q1 = m0 * bands.r[band, 1, 0] + m1 * bands.r[band, 1, 1] + m2 * bands.r[band, 1, 2]
            q2 = m0 * bands.r[band, 2, 0] + m1 * bands.r[band, 2, 1] + m2 * bands.r[band, 2, 2]
        n0 = q0 * unit_r[0, 0] + q1 * unit_r[0, 1] + q2 * unit_r[0, 2]
        n1 = q0 * unit_r[1, 0] + q1 * unit_r[1, 1] + q2 * unit_r[1, 2]
        n2 = q0 * unit_r[2, 0] + q1 * unit_r[2, 1] + q2 * unit_r[2, 2]
        jx[i, 0], jx[i, 1], jx[i, 2] = n0, n1, n2
        if not camera_is_free:
            continue
        jc[i, 0], jc[i, 1], jc[i, 2] = m1 * rig[2] - m2 * rig[1], m2 * rig[0] - m0 * rig[2], m0 * rig[1] - m1 * rig[0]
        jc[i, 3], jc[i, 4], jc[i, 5] = -m0, -m1, -m2
        jc[i, 6] = (proj[i] - k[2 + i]) * s
        if jc.shape[1] > 7:
            if bands is None:
                jc[i, 7], jc[i, 8] = 0.0, 0.0
            else:
                w0, w1, w2 = bands.velocity[band, 0], bands.velocity[band, 1], bands.velocity[band, 2]
                x0, x1, x2 = rig[0] + cam_t[0], rig[1] + cam_t[1], rig[2] + cam_t[2]
                jc[i, 7] = -(
                    m0 * (w1 * x2 - w2 * x1 + bands.velocity[band, 3])
                    + m1 * (w2 * x0 - w0 * x2 + bands.velocity[band, 4])
                    + m2 * (w0 * x1 - w1 * x0 + bands.velocity[band, 5])
                )
                jc[i, 8] = jc[i, 7] * (
                    bands.readout[c, 0] * xy[0] + bands.readout[c, 1] * xy[1] + bands.readout[c, 2] - 0.5
                )
    if camera_is_free and jc.shape[1] > 9:
        intrinsics_derivatives(kind, k, cam, proj, s, jc)
    return True


@njit(cache=True)
def workspace(dof: int) -> Any:
    """Arrays d, rig, cam, work, proj, res, jx and jc for `linearise`, of a camera with `dof` unknowns."""
    d, rig, cam, work, proj, res = np.empty(3), np.empty(3), np.empty(3), np.empty(6), np.empty(8), np.empty(2)
    return d, rig, cam, work, proj, res, np.empty((2, 3)), np.empty((2, dof))


@uncounted(forceinline=True)
def row_band(bands: Any, n: int) -> int:
    """Row band of an observation; 0 where there are none."""
    return 0 if bands is None else bands.of_observation[n]


@uncounted(forceinline=True)
def follows_trajectory(motion: Any, band: int) -> bool:
    """True if steps of several units move a row band, False if it is held to its own."""
    return bool(motion is not None and motion.weight[band, 0] != 1.0)


@uncounted(forceinline=True)
def num_supports(motion: Any) -> int:
    """Number of units whose steps may move an observation: its own, or the support of its row band."""
    return 1 if motion is None else 3


@uncounted(forceinline=True)
def support(motion: Any, unit_slot: Any, u: int, band: int, k: int) -> tuple[int, float]:
    """Slot, -1 where held, and weight of unit k of those whose steps move an observation by unit u."""
    if motion is None:
        return unit_slot[u], 1.0
    # Read before the weight is known, of the last unit for a support of -1: a branch here is slower.
    weight, slot = motion.weight[band, k], unit_slot[motion.support[band, k]]
    return (-1 if weight == 0.0 else slot), weight


@uncounted()
def intrinsics_derivatives(kind: int, k: Any, cam: Any, proj: Any, s: float, jc: Any) -> None:
    """Derivatives, times s, of a pixel in log(fy / fx), cx, cy and the four terms of distortion into jc[:, 9:16].

    A perspective camera's distortion is the radial one's, of which it has none: how far it may be off is asked all the
    same.
    """
    iz = inverse_depth(kind, k, cam[2], cam[0] * cam[0] + cam[1] * cam[1] + cam[2] * cam[2])
    a, b = cam[0] * iz, cam[1] * iz
    r2 = a * a + b * b
    jc[0, 9], jc[1, 9] = 0.0, (proj[1] - k[3]) * s
    jc[0, 10], jc[1, 10] = s, 0.0
    jc[0, 11], jc[1, 11] = 0.0, s
    fx, fy = k[0] * s, k[1] * s
    if kind == 2:
        r = math.sqrt(cam[0] * cam[0] + cam[1] * cam[1])
        theta = math.atan2(r, cam[2])
        power = theta**3 / max(r, 1e-12)
        for i in range(4):
            jc[0, 12 + i], jc[1, 12 + i] = fx * cam[0] * power, fy * cam[1] * power
            power *= theta * theta
    else:
        share = 1.0
        if kind == 3:
            share = 1.0 / (1.0 + r2 * (k[10] + r2 * (k[11] + r2 * k[12])))
        jc[0, 12], jc[1, 12] = fx * a * r2 * share, fy * b * r2 * share
        jc[0, 13], jc[1, 13] = fx * a * r2 * r2 * share, fy * b * r2 * r2 * share
        jc[0, 14], jc[1, 14] = fx * 2.0 * a * b, fy * (r2 + 2.0 * b * b)
        jc[0, 15], jc[1, 15] = fx * (r2 + 2.0 * a * a), fy * 2.0 * a * b
