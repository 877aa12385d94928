"""Settings of the engine, one comment a field. `--config FILE` takes a TOML file with the same sections and names."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mrasfm_engine.errors import InputError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
Threshold = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class FeatureConfig(_Section):
    """Extraction of keypoints."""

    extractor: Literal["sift", "superpoint", "aliked", "xfeat"] = "sift"  # all but SIFT need a model
    model: str | None = None  # name of the model, see `mrasfm models list`; the extractor's usual one if not given
    min_score: Annotated[float, Field(ge=0, le=1)] | None = None  # of a network's keypoints; the usual if not given
    max_keypoints: Count = 2048  # a image; 1024 costs accuracy
    spread: bool = True  # a network's keypoints are taken all over the image first; false: the strongest wherever
    refine: bool = True  # xfeat: keypoints are moved to the nearest detail, those without one are dropped
    contrast_threshold: Positive = 0.02  # half of SIFT's usual value, so that asphalt and shade yield keypoints too
    class_margin_px: Annotated[int, Field(ge=0)] = 2  # keypoints nearer to the border of a class in the mask have none
    max_side_px: Count = 1600  # larger images are extracted at reduced size; coordinates stay those of the full image


class PairConfig(_Section):
    """Which image pairs are matched."""

    selection: bool = True  # by overlap of views; false: all images of units at most window_units apart
    window_units: Count = 4  # without a prior: how many following units a camera is matched with
    cross_window_units: Annotated[int, Field(ge=0)] = 2  # the same across cameras that look in similar directions
    pairs_per_image: Count = 16  # with a prior: best pairs by overlap an image
    max_depth_m: Positive = 50.0  # viewing frustums end here
    max_view_angle_deg: Positive = 75.0  # between optical axes
    min_overlap: Share = 0.08  # fraction of one image's frustum samples seen by the other
    revisit_pairs_per_unit: Annotated[int, Field(ge=0)] = 3  # without a prior: similar units outside the window


class MatchConfig(_Section):
    """Matching of image pairs and its verification."""

    matcher: Literal["nearest", "superglue", "lightglue", "lighterglue"] = "nearest"  # all but nearest need a model
    model: str | None = None  # name of the model; the usual one for the extractor if not given
    max_keypoints: Count = 1024  # first of an image that a network matches: time grows with the square
    min_score: Annotated[float, Field(ge=0, le=1)] | None = None  # of a network's matches; the usual if not given
    ratio: Share = 0.8  # nearest: of the distances to the best and second best descriptor
    min_matches: Count = 15  # pairs with fewer matches or inliers are dropped
    same_class: bool = True  # drop matches whose ends lie on different classes of the masks
    max_error_px: Positive = 2.0  # epipolar distance of an inlier
    calibration_error_px: Positive = 8.0  # the same between cameras of one unit, where calibration gives the geometry


class MappingConfig(_Section):
    """The incremental loop."""

    camera_set_registration: bool = True  # false: every image by its own PnP, as without a rig; for comparison
    keyframe_motion_px: Threshold = 2.0  # units whose keypoints moved less are registered at the end; 0: map with all
    motion_compensation: bool = True  # images (and rows, where a readout time is declared) are posed at their own times
    max_error_px: Positive = 4.0  # reprojection error of an observation while poses still settle
    filter_error_px: Positive = 3.0  # and in the final scene
    min_angle_deg: Positive = 1.0  # of a point's rays; below it depth is mostly noise
    min_pnp_inliers: Count = 20  # of a unit over all its cameras
    min_pnp_inlier_ratio: Share = 0.2
    local_units: Count = 6  # units that vary in local adjustment
    local_every: Count = 2  # registered units between local adjustments
    pose_observations: int = Field(default=400, ge=0)  # of an image, for its pose while the scene grows; 0: all
    semantic_triangulation: bool = True  # points of the road that are off its surface are dropped
    road_patch_m: Positive = 8.0  # radius of a plane patch of the road's surface
    road_sigmas: Positive = 3.0  # how far from the surface a point of the road may be, in its own uncertainty
    road_max_offset_m: Positive = 0.05  # farther ones are dropped however uncertain they are, except on rough roads
    global_growth: Positive = 0.4  # global adjustment when this fraction of units was registered since the last


class AdjustmentConfig(_Section):
    """Camera set bundle adjustment."""

    camera_set_adjustment: bool = True  # false: every image is adjusted on its own, as without a rig
    priors: bool = True  # of calibration, positions and gravity; without them GNSS aligns the scene and does no more
    loss_scale: Positive = 2.0  # of the Cauchy loss, in standard deviations of an observation
    sigma_rotation_deg: Positive = 2.0  # prior of rig_from_cam where the manifest gives none
    sigma_translation_m: Positive = 0.05
    sigma_focal: Positive = 0.002  # prior of a focal length relative to itself, where focal lengths vary
    refine_calibration: bool = True  # rig_from_cam, where motion or GNSS make it observable
    refine_focal: bool = False  # one factor for fx and fy a camera, with its prior, where rig_from_cam varies too
    min_heading_change_deg: Positive = 15.0  # without GNSS, calibration is held on straighter drives
    max_scale_sigma: Positive = 0.1  # calibration is held where freeing it would leave scale more uncertain than this


class GnssConfig(_Section):
    """Use of the receiver's positions."""

    correlation_time_s: Positive = 1.0  # samples closer than this share most of their error
    outlier_sigmas: Positive = 4.0  # residuals over this many sigmas after alignment are rejected
    max_time_gap_s: Positive = 2.0  # no interpolation across larger gaps


class AggregationConfig(_Section):
    """Putting scenes together to a map."""

    candidates: Count = 3  # scenes that each scene is compared with: those whose views overlap most
    position_error_m: Positive = 12.0  # how far positions of two scenes may be off against one another
    max_depth_m: Positive = 40.0  # footprints of views end here
    max_view_angle_deg: Positive = 50.0  # between optical axes: farther apart, nothing looks alike
    probe_spacing_m: Positive = 4.0  # between units that are compared to find how two scenes lie
    pairs_per_image: Count = 3  # of images between two scenes, once it is known how they lie
    max_pairs: Count = 1200  # of images between two scenes
    consensus: bool = True  # several units must agree how two scenes lie; false: the best one decides, for comparison
    min_units: Count = 3  # of a scene that must agree
    min_unit_inliers: Count = 12  # of a unit's image points, for its pose in the other scene
    min_inliers: Count = 60  # points that two scenes share at a seam
    max_scale_error: Positive = 0.05  # by which lengths of two scenes may differ, beyond what is uncertain about them
    joint: bool = True  # seams that make loops are adjusted together; false: one scene after the other, for comparison
    final_adjustment: Literal["overlap", "all", "none"] = "overlap"  # which units vary on their own in the end


class OutputConfig(_Section):
    """What is written besides the scene itself."""

    pictures: bool = True  # the road from above before and after recalibration, as PNG; reads every image again


class SemanticsConfig(_Section):
    """Masks of images that come without one."""

    model: str | None = None  # name of a model for segmentation; no masks are made if not given


class ModelsConfig(_Section):
    """Where trained models lie and what runs them."""

    folder: Path | None = None  # MRASFM_MODELS or the user's data folder if not given
    gpu: bool = True  # where onnxruntime has a provider for one that starts


class EngineConfig(_Section):
    """All settings of a reconstruction."""

    features: FeatureConfig = FeatureConfig()
    pairs: PairConfig = PairConfig()
    matching: MatchConfig = MatchConfig()
    mapping: MappingConfig = MappingConfig()
    adjustment: AdjustmentConfig = AdjustmentConfig()
    gnss: GnssConfig = GnssConfig()
    aggregation: AggregationConfig = AggregationConfig()
    output: OutputConfig = OutputConfig()
    semantics: SemanticsConfig = SemanticsConfig()
    models: ModelsConfig = ModelsConfig()
    use_gnss: bool = True
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    threads: Count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def read_config(path: Path | None, **overrides: Any) -> EngineConfig:
    """The settings in a TOML file over the defaults, and `overrides` (top-level fields) over those.

    Raises
    ------
    InputError
        Where the file cannot be read or a setting is unknown or out of range.
    """
    values: dict[str, Any] = {}
    if path is not None:
        try:
            values = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}", remedy="Give an existing file.") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(f"{path} is not TOML: {error}", remedy="See the README for an example.") from error
    try:
        return EngineConfig.model_validate(values | overrides)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise InputError(
            f"{path or 'settings'}: {field}: {first['msg']}",
            remedy="The settings and their meaning stand in mrasfm_engine/config.py.",
        ) from error
