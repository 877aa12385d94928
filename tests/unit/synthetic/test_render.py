"""The renderer against geometry: where edges, depths and colours must be."""

import numpy as np
import pycolmap
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic.atlas import AtlasBuilder
from mrasfm_engine.synthetic.cameras import ideal_map, project, unproject
from mrasfm_engine.synthetic.light import Light, cast_shadows
from mrasfm_engine.synthetic.mesh import Label, MeshBuilder, Surface
from mrasfm_engine.synthetic.render import Lens, View, develop, render
from mrasfm_engine.synthetic.rigs import TrueCamera, true_cameras

MODELS = ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"]


def camera(model: str) -> TrueCamera:
    return true_cameras(1, width=320, height=180, model=model, rng=np.random.default_rng(3))[0]


def noon() -> Light:
    return Light(
        to_sun=np.array([0.0, 0.0, 1.0]),
        sun=np.ones(3),
        sky=np.ones(3),
        haze=np.zeros(3),
        zenith=np.zeros(3),
        glow=np.zeros(3),
        haze_m=1e9,
        cloudiness=0.0,
        gain=1.0,
    )


def draw(builder: MeshBuilder, atlas: AtlasBuilder, lens: Lens, world_from_cam: np.ndarray) -> View:
    sky = atlas.add(np.zeros((64, 64, 3), np.uint8))
    mesh, textures = builder.build(), atlas.build()
    return render(
        mesh,
        textures,
        lens,
        world_from_cam,
        light=noon(),
        shadows=cast_shadows(mesh, textures, np.array([0.0, 0.0, 1.0])),
        shadow_strength=0.0,
        moving_boxes=np.zeros((0, 8)),
        sky_texture=sky,
    )


@pytest.mark.parametrize("model", MODELS)
def test_camera_models_agree_with_colmap(model: str) -> None:
    cam = camera(model)
    peer = pycolmap.Camera(model=model, width=cam.width, height=cam.height, params=list(cam.params))
    rays = ideal_map(model, cam.params, width=cam.width, height=cam.height)
    points = np.concatenate([rays[::20, ::20].reshape(-1, 2), np.ones((rays[::20, ::20, 0].size, 1))], 1)
    ours, theirs = project(model, cam.params, points), np.array([peer.img_from_cam(p) for p in points])
    np.testing.assert_allclose(ours, theirs, atol=1e-9)
    # The first sample is the centre of the top left pixel.
    np.testing.assert_allclose(ours[0], [0.5, 0.5], atol=1e-9)
    np.testing.assert_allclose(unproject(model, cam.params, ours), points[:, :2], atol=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_a_small_square_appears_at_its_projection(model: str) -> None:
    """Its centroid, weighted by brightness and averaged over many places, tells the pixel convention exactly."""
    lens = Lens(camera(model))
    rng = np.random.default_rng(0)
    half, errors = 0.12, []
    grid = np.stack(np.meshgrid(*[np.linspace(-half, half, 41)] * 2, [0.0]), -1).reshape(-1, 3)
    for x, y in rng.uniform([-1.7, -0.9], [1.7, 0.9], (24, 2)):
        atlas, builder = AtlasBuilder(), MeshBuilder()
        white = Surface(texture=atlas.add(np.full((64, 64, 3), 255, np.uint8)), label=Label.BUILDING)
        # Turned, because edges along the pixels would all fall on the same side of the samples.
        turn = se3.exp_so3([0.0, 0.0, rng.uniform(0.2, 0.6)])
        corner = turn @ [-half, -half, 0] + [x, y, 3.0]
        builder.add(white, corner, turn[:, 0] * 2 * half, turn[:, 1] * 2 * half, normal=[0, 0, -1.0])
        image = draw(builder, atlas, lens, np.eye(4)).intensity[..., 0].astype(float)
        rows, cols = np.indices(image.shape) + 0.5
        found = np.array([(image * cols).sum(), (image * rows).sum()]) / image.sum()
        true = project(model, lens.camera.params, grid @ turn.T + np.array([x, y, 3.0])).mean(0)
        errors.append(found - true)
    assert np.abs(np.mean(errors, 0)).max() < 0.03
    assert 0 < np.std(errors) < 0.08


@pytest.mark.parametrize("model", MODELS)
def test_depth_and_occlusion_are_exact(model: str) -> None:
    lens = Lens(camera(model))
    atlas, builder = AtlasBuilder(), MeshBuilder()
    look = Surface(texture=atlas.add(np.full((64, 64, 3), 128, np.uint8)), label=Label.BUILDING)
    near = Surface(texture=look.texture, label=Label.CAR)
    # A slanted wall with a car in front of its left half, and triangles for one of them.
    builder.add(look, [-30, -30, 4], [60, 0, 12], [0, 60, 0])
    builder.add(near, [-1.5, -1.5, 3], [3, 0, 0], [0, 3, 0], triangle=True)
    view = draw(builder, atlas, lens, np.eye(4))
    x, y = np.moveaxis(lens.pixels, -1, 0)
    wall = (4 + 6.0) / (1 - 0.2 * x)
    u, v = (3 * x + 1.5) / 3, (3 * y + 1.5) / 3
    car = (u >= 0) & (v >= 0) & (u + v <= 1) & (wall > 3)
    expected = np.where(car, 3.0, wall)
    # Away from edges, where a pixel is not of both.
    interior = np.minimum(np.minimum(np.abs(u + v - 1), np.abs(u)), np.abs(v)) > 0.01
    np.testing.assert_allclose(view.depth_m[interior], expected[interior], rtol=1e-5)
    np.testing.assert_array_equal(view.labels[interior], np.where(car, Label.CAR, Label.BUILDING)[interior])
    assert 0.05 < car.mean() < 0.95


def test_texture_is_fixed_in_the_world_and_not_mirrored() -> None:
    """A point has the same colour from two places, and texture rows count downwards."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (16, 16, 3)).astype(np.uint8)
    picture = np.kron(coarse, np.ones((16, 16, 1), np.uint8))
    lens = Lens(camera("PINHOLE"))
    atlas, builder = AtlasBuilder(), MeshBuilder()
    # Upright in a camera: x right, y down, so v points to -y.
    builder.add(
        Surface(texture=atlas.add(picture), label=Label.BUILDING),
        [-2, 2, 5],
        [4, 0, 0],
        [0, -4, 0],
        normal=[0, 0, -1.0],
    )
    pose = se3.transform(se3.exp_so3([0.02, -0.15, 0.1]), [0.6, -0.2, 0.5])
    a, b = (draw(builder, atlas if k == 0 else _again(picture), lens, p) for k, p in enumerate((np.eye(4), pose)))
    cells = (np.indices((16, 16)).reshape(2, -1).T + 0.5) / 16
    points = np.stack([-2 + 4 * cells[:, 1], -2 + 4 * cells[:, 0], np.full(256, 5.0)], -1)
    for view, world_from_cam in ((a, np.eye(4)), (b, pose)):
        xy = project("PINHOLE", lens.camera.params, se3.apply(se3.inverse(world_from_cam), points))
        inside = ((xy > 3) & (xy < [317, 177])).all(1)
        seen = view.intensity[xy[inside, 1].astype(int), xy[inside, 0].astype(int)]
        # A level wall that sees no sun is lit by three quarters of the sky.
        expected = coarse.reshape(-1, 3)[inside] / 255 * np.sqrt(0.5)
        assert inside.sum() > 60
        np.testing.assert_allclose(seen, expected, atol=0.01)


def _again(picture: np.ndarray) -> AtlasBuilder:
    atlas = AtlasBuilder()
    atlas.add(picture)
    return atlas


def test_sensor_noise_has_the_size_it_promises() -> None:
    lens = Lens(camera("PINHOLE"))
    lens.vignetting[:] = 1.0
    flat = np.full((180, 320, 3), 0.5, np.float32)
    view = View(
        intensity=flat,
        labels=np.zeros((180, 320), np.uint8),
        is_moving=np.zeros((180, 320), np.bool_),
        depth_m=np.ones((180, 320), np.float32),
    )
    image = develop(view, lens, gain=1.0, noise=1.0, blur_px=0.0, rng=np.random.default_rng(0)).astype(float)
    expected = np.hypot(np.sqrt(0.022**2 * 0.25 + 0.004**2) / (2 * 0.5) * 255, np.sqrt(1 / 12))
    assert image.mean() == pytest.approx(127.5, abs=0.1)
    assert image.std() == pytest.approx(expected, rel=0.05)
    neighbours = np.corrcoef(image[:, :-1].ravel(), image[:, 1:].ravel())[0, 1]
    assert abs(neighbours) < 0.02
