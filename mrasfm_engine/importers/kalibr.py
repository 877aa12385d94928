"""Kalibr's camera chain (`camchain.yaml`): lenses, and each camera's pose relative to the camera before it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, RootModel, ValidationError

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.lenses import Lens, kalibr_params, lens_from_distortion
from mrasfm_engine.importers.recording import proper_transform
from mrasfm_engine.io.documents import read_bytes
from mrasfm_engine.types import Floats
from schemas.drive import MAX_CAMERAS, Finite

MAX_BYTES = 10_000_000
_Row4 = Annotated[list[Finite], Field(min_length=4, max_length=4)]


class _Camera(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    camera_model: str
    intrinsics: Annotated[list[Finite], Field(min_length=4, max_length=5)]
    distortion_model: str
    distortion_coeffs: list[Finite]
    resolution: Annotated[list[int], Field(min_length=2, max_length=2)]
    rostopic: str
    T_cn_cnm1: Annotated[list[_Row4], Field(min_length=3, max_length=4)] | None = None
    timeshift_cam_imu: Finite | None = None


_Chain = RootModel[Annotated[dict[str, _Camera], Field(min_length=1, max_length=MAX_CAMERAS)]]


@dataclass(frozen=True, kw_only=True)
class ChainCamera:
    """A camera of the chain."""

    name: str  # cam0, cam1, ...
    topic: str
    size: tuple[int, int]
    lens: Lens
    first_from_cam: Floats  # (4, 4), in the chain's first camera
    timeshift_s: float  # to be added to the camera's times for those of Kalibr's inertial unit


def read_camchain(path: Path) -> list[ChainCamera]:
    """Cameras in the order of the chain: that of their numbers, as YAML in order of names has cam10 after cam1.

    Raises
    ------
    InputError
        That names the camera and the field at fault.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    text = read_bytes(path, what="calibration", max_bytes=MAX_BYTES)
    remedy = "Give the camchain.yaml that Kalibr writes."
    try:
        document = YAML(typ="safe", pure=True).load(text.decode("utf-8-sig"))
        chain = _Chain.model_validate(document).root
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(
            f"calibration {path}: {where}: {first['msg']}", remedy=remedy, code="bad-calibration"
        ) from None
    except (YAMLError, ValueError, KeyError, RecursionError) as error:  # a date that is none, a tag that does not fit
        said = " ".join(str(error).split())[:200]
        raise InputError(f"calibration {path} is not YAML: {said}", remedy=remedy, code="bad-calibration") from None
    cameras: list[ChainCamera] = []
    for name, camera in _in_order(chain):
        where = f"calibration {path}: {name}"
        pose = np.eye(4)
        if cameras:
            if camera.T_cn_cnm1 is None:
                raise InputError(f"{where}: T_cn_cnm1 is missing", remedy=remedy, code="bad-calibration")
            cam_from_last = proper_transform(np.array(camera.T_cn_cnm1), what=f"{where}: T_cn_cnm1")
            pose = cameras[-1].first_from_cam @ se3.inverse(cam_from_last)
        cameras.append(
            ChainCamera(
                name=name,
                topic=camera.rostopic,
                size=(camera.resolution[0], camera.resolution[1]),
                lens=_lens(camera, where),
                first_from_cam=pose,
                timeshift_s=camera.timeshift_cam_imu or 0.0,
            )
        )
    return cameras


def _in_order(chain: dict[str, _Camera]) -> list[tuple[str, _Camera]]:
    """Cameras by the numbers of their names; where others name them, as the file has them."""
    numbered = all(re.fullmatch(r"cam[0-9]{1,9}", name) for name in chain)
    return sorted(chain.items(), key=lambda item: int(item[0].removeprefix("cam"))) if numbered else [*chain.items()]


def _lens(camera: _Camera, where: str) -> Lens:
    expected = {"pinhole": 4, "omni": 5}.get(camera.camera_model)
    if expected is None or len(camera.intrinsics) != expected:
        raise InputError(
            f"{where}: camera_model {camera.camera_model!r} with {len(camera.intrinsics)} intrinsics is not known",
            remedy="Calibrate with pinhole-radtan, pinhole-equi or omni-radtan.",
            code="unknown-distortion",
        )
    params = kalibr_params(camera.intrinsics[-4:])
    model, coefficients = camera.distortion_model, camera.distortion_coeffs
    if camera.camera_model == "omni":
        if model not in ("radtan", "none") or len(coefficients) not in (0, 4):
            raise InputError(
                f"{where}: distortion_model {model!r} of an omni camera is not known",
                remedy="Calibrate with omni-radtan.",
                code="unknown-distortion",
            )
        return Lens(model="MEI", params=[*params, *(coefficients or [0.0] * 4), camera.intrinsics[0]])
    ros = {"radtan": "plumb_bob"}.get(model, model)
    return lens_from_distortion(params, ros, coefficients, where=where)
