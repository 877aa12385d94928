"""Settings of the engine. `--config FILE` takes a TOML file with the same sections and names."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from mrasfm_engine.errors import InputError
from schemas.drive import MAX_GNSS_GAP_S, MAX_IMAGE_SIDE_PX, SIGMA_TRANSLATION_M, Camera
from schemas.findings import enumerated
from schemas.methods import ExtractorName, MatcherName
from schemas.misspelt import correction_of
from schemas.parsing import MAX_PROBLEMS_SHOWN

# The squares of numbers beyond these, and their inverses, leave what float64 can hold to equations.
SMALLEST, LARGEST = 1e-9, 1e9
Positive = Annotated[float, Field(ge=SMALLEST, le=LARGEST, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=SMALLEST, le=1, allow_inf_nan=False)]
Threshold = Annotated[float, Field(ge=0, le=LARGEST, allow_inf_nan=False)]
# No drive has more frames, cameras and pairs of an image than this; larger numbers are slips, which libraries below the
# engine would answer with tracebacks.
MAX_COUNT = 1_000_000
Count = Annotated[int, Field(ge=1, le=MAX_COUNT)]
CountOrZero = Annotated[int, Field(ge=0, le=MAX_COUNT)]
Keypoints = Annotated[int, Field(ge=1, le=100_000)]  # one for every few pixels of any image
Threads = Annotated[int, Field(ge=1, le=1024)]  # as the service's MRASFM_ENGINE_THREADS
Pixels = Annotated[int, Field(ge=1, le=MAX_IMAGE_SIDE_PX)]


def _available_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)  # TOML has types: "no" is none of them


class FeatureConfig(_Section):
    """Extraction of keypoints."""

    extractor: ExtractorName = Field(
        "sift", description="every extractor but `sift` needs a model, see `mrasfm models list`"
    )
    model: str | None = Field(
        None, description="name of the extractor's model; by default the usual one of the extractor"
    )
    min_score: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None, description="lowest score of a network's keypoints; by default the model's usual one"
    )
    max_keypoints: Keypoints = Field(2048, description="per image; 1024 costs accuracy")
    spread: bool = Field(
        True,
        description="keypoints are taken all over the image first; `false` takes the strongest",
    )
    refine: bool = Field(
        True, description="`xfeat`: keypoints move to the nearest detail, and those without one are dropped"
    )
    contrast_threshold: Positive = Field(
        0.02, description="of SIFT; half of its usual value, so that asphalt and shade yield keypoints too"
    )
    class_margin_px: CountOrZero = Field(
        2,
        description="keypoints have no class whose outline is nearer than this to the border of a class in the mask",
    )
    own_car: bool = Field(
        True,
        description="no keypoints on the vehicle itself, which is found by the edges that stay while it moves",
    )
    max_side_px: Pixels | None = Field(
        None,
        description="larger images are extracted at reduced size; coordinates stay those of the full image; by default "
        "1600, and with `sift` no more than three quarters of `max_keypoints` need",
    )


class PairConfig(_Section):
    """Selection of the image pairs that are matched."""

    selection: bool = Field(
        True,
        description="pairs are selected by motion and overlap; `false` matches all images of units at most "
        "`window_units` apart",
    )
    window_units: Count = Field(
        4, description="largest number of following units, spaced by the vehicle's motion, that a unit is matched with"
    )
    cross_window_units: CountOrZero = Field(
        2, description="without a prior trajectory: the same across cameras that look in similar directions"
    )
    pairs_per_image: Count = Field(16, description="with GNSS or rough poses: the pairs of largest overlap per image")
    max_depth_m: Positive = Field(50.0, description="viewing frustums end here")
    max_view_angle_deg: Positive = Field(75.0, description="largest angle between optical axes")
    min_overlap: Share = Field(
        0.08, description="smallest share of one image's frustum samples that the other image sees"
    )
    revisit_pairs_per_unit: CountOrZero = Field(
        3, description="without a prior trajectory: similar units farther along the path"
    )


class MatchConfig(_Section):
    """Matching of image pairs and verification of the matches."""

    matcher: MatcherName = Field(
        "nearest", description="every matcher but `nearest` needs a model, see `mrasfm models list`"
    )
    model: str | None = Field(
        None, description="name of the matcher's model; by default the usual one for the extractor"
    )
    max_keypoints: Keypoints = Field(
        1024, description="number of an image's first keypoints that a network matches; time grows with its square"
    )
    min_score: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None, description="lowest score of a network's matches; by default the model's usual one"
    )
    ratio: Share = Field(
        0.8, description="`nearest`: largest ratio of the distances to the best and the second best descriptor"
    )
    min_matches: Count = Field(15, description="pairs with fewer matches or fewer inliers are dropped")
    same_class: bool = Field(True, description="matches between different classes of the masks are dropped")
    max_error_px: Positive = Field(2.0, description="largest epipolar distance of an inlier")


class SubmapConfig(_Section):
    """The cut of a long drive into sub-maps, which are extracted, matched and mapped by themselves and then joined."""

    count: Count | None = Field(
        None, description="by default as few as `memory_mb` allows, in rounds of as many as there are workers for"
    )
    memory_mb: Positive = Field(
        1500.0, description="expected memory of mapping a sub-map besides the program's own; larger drives are cut"
    )
    overlap_units: Annotated[int, Field(ge=3, le=MAX_COUNT)] = Field(
        10, description="units that two neighbouring sub-maps share, which say how one lies to the other"
    )
    processes: Threads | None = Field(
        None,
        description="sub-maps that are done at one time, each in a process with its share of the threads; by default "
        "one for every four threads",
    )


class MappingConfig(_Section):
    """Incremental mapping."""

    camera_set_registration: bool = Field(
        True, description="`false` registers every image by its own PnP, as without a rig; for comparison"
    )
    keyframe_motion_px: Threshold = Field(
        2.0,
        description="units whose images or keypoints moved less take no part in mapping and are posed in the finished "
        "scene; 0 maps with all units",
    )
    motion_compensation: bool = Field(
        True, description="images, and rows where a readout time is declared, are posed at their own times"
    )
    max_error_px: Positive = Field(
        4.0, description="largest reprojection error of an observation while the scene grows"
    )
    filter_error_px: Positive = Field(
        3.0, description="largest reprojection error of an observation in the finished scene"
    )
    min_angle_deg: Positive = Field(
        1.0, description="smallest angle between a point's rays; below it depth is mostly noise"
    )
    min_pnp_inliers: Count = Field(20, description="of a unit, over all its cameras")
    min_pnp_inlier_ratio: Share = Field(0.2, description="of a unit, over all its cameras")
    local_units: Count = Field(6, description="units that vary in local adjustment")
    local_every: Count = Field(3, description="registered units between two local adjustments")
    pose_observations: CountOrZero = Field(
        250, description="observations of an image that its pose uses while the scene grows; 0 uses all"
    )
    drop_moving: bool = Field(
        True, description="tracks whose motion, or that of their neighbours, shows something that moves give no points"
    )
    semantic_triangulation: bool = Field(True, description="points of the road that are off its surface are dropped")
    road_patch_m: Positive = Field(8.0, description="radius of a plane patch of the road's surface")
    road_sigmas: Positive = Field(
        3.0, description="largest distance of a road point from the surface, in standard deviations of the point"
    )
    road_max_offset_m: Positive = Field(
        0.05, description="points farther off are dropped however uncertain they are, except on rough roads"
    )
    global_growth: Positive = Field(
        0.4, description="global adjustment runs when this share of units was registered since the last"
    )


class BundleAdjustmentConfig(_Section):
    """Camera set bundle adjustment."""

    camera_set_adjustment: bool = Field(
        True, description="`false` adjusts every image on its own, as without a rig; for comparison"
    )
    priors: bool = Field(
        True, description="of calibration, positions and gravity; without them GNSS aligns the scene and does no more"
    )
    loss_scale: Positive = Field(2.0, description="of the Cauchy loss, in standard deviations of an observation")
    sigma_rotation_deg: Positive = Field(2.0, description="prior of `rig_from_cam` where the manifest declares none")
    sigma_translation_m: Positive = Field(
        SIGMA_TRANSLATION_M, description="prior of `rig_from_cam` where the manifest declares none"
    )
    sigma_focal: Positive = Field(
        0.01,
        description="prior of a focal length relative to itself, where intrinsics vary and the manifest declares none",
    )
    sigma_principal_point: Positive = Field(
        0.002, description="prior of a principal point relative to the focal length, where intrinsics vary"
    )
    sigma_distortion: Positive = Field(
        0.005, description="prior of a radial term of distortion, where intrinsics vary; of a tangential one a fifth"
    )
    reassessment: bool = Field(
        True,
        description="every adjustment judges calibration and positions anew; `false` judges them once, before (by "
        "gates), for comparison",
    )
    sigma_time_offset_us: Positive = Field(
        2000.0,
        description="prior of a camera's time offset where the manifest declares none: clocks that software reads",
    )
    refine_calibration: bool = Field(
        True,
        description="`rig_from_cam` varies where motion or GNSS make it observable; `false` holds a single camera's "
        "intrinsics as well",
    )
    refine_time_offsets: bool = Field(
        True,
        description="each camera's constant offset of its timestamps varies with its prior where `rig_from_cam` varies "
        "and cameras are not simultaneous, or the manifest declares how well their times are known",
    )
    refine_focal: bool | None = Field(
        None,
        description="the intrinsics of each camera's model vary with their priors where the drive observes the focal "
        "length: those of several cameras where `rig_from_cam` varies too; by default those of a single camera, of "
        "cameras for which the manifest declares a sigma of any of them, and of all where lenses bend the scene",
    )
    min_heading_change_deg: Positive = Field(
        15.0,
        description="with `reassessment = false` alone: without GNSS, straighter drives hold the calibration as given",
    )

    def intrinsics_may_vary(self, camera: Camera, *, is_single: bool) -> bool:
        """Return whether the settings let a camera's intrinsics vary, of a drive with others or with a single one."""
        by_default = is_single or camera.declares_intrinsics
        return by_default if self.refine_focal is None else self.refine_focal


class GnssConfig(_Section):
    """Use of the receiver's positions."""

    correlation_time_s: Positive = Field(
        1.0, description="errors that wander stay the same for so long; in a map, samples closer in time count once"
    )
    wander_time_s: Positive = Field(
        60.0,
        description="time for which a receiver's error stays the same, as far as its positions do not scatter by it",
    )
    outlier_sigmas: Positive = Field(
        4.0, description="samples whose residual after alignment exceeds this are rejected, in standard deviations"
    )
    max_time_gap_s: Positive = Field(MAX_GNSS_GAP_S, description="positions are not interpolated across larger gaps")


class AggregationConfig(_Section):
    """Aggregation of scenes to a map."""

    candidates: Count = Field(
        3, description="number of scenes that each scene is compared with: those of largest overlap of views"
    )
    position_error_m: Positive = Field(
        12.0, description="largest error of the positions of two scenes against one another"
    )
    max_depth_m: Positive = Field(40.0, description="footprints of views end here")
    max_view_angle_deg: Positive = Field(
        50.0, description="largest angle between optical axes; images farther apart in direction do not match"
    )
    probe_spacing_m: Positive = Field(
        4.0, description="distance between units that are relocalised to find the transform between two scenes"
    )
    pairs_per_image: Count = Field(
        3, description="image pairs between two scenes per image, once their transform is known"
    )
    max_pairs: Count = Field(1200, description="image pairs between two scenes")
    agreeing_units: bool = Field(
        True,
        description="several units must agree on a seam's transform; `false` takes the best unit's, for comparison",
    )
    min_units: Count = Field(3, description="units of a scene that must agree on the transform of a seam")
    min_unit_inliers: Count = Field(12, description="image points of a unit for its pose in the other scene")
    min_inliers: Count = Field(
        36, description="points that two scenes share at a seam: as many as `min_units` units see at least"
    )
    max_scale_error: Positive = Field(
        0.05, description="largest difference of the lengths of two scenes, beyond three of the sigmas that they state"
    )
    multi_scene_adjustment: bool = Field(
        True,
        description="seams in loops are adjusted together; `false` adjusts one scene after the other, for comparison",
    )
    final_adjustment: Literal["overlap", "all", "none"] = Field(
        "overlap", description="units that vary on their own in the last adjustment"
    )


class OutputConfig(_Section):
    """Files besides the scene itself."""

    pictures: bool = Field(
        True,
        description="the road from above: a GeoTIFF, and PNGs before and after recalibration; reads every image again",
    )


class SemanticsConfig(_Section):
    """Masks of images that come without one."""

    model: str | None = Field(
        None, description="name of a segmentation model for images without a mask; by default no masks are made"
    )


class ModelsConfig(_Section):
    """Trained models and their execution."""

    folder: Annotated[Path, Field(strict=False)] | None = Field(
        None, description="folder of the trained models; by default `MRASFM_MODELS` or the user's data folder"
    )
    gpu: bool = Field(True, description="a GPU is used where onnxruntime has a provider for one that starts")


class EngineConfig(_Section):
    """All settings of a reconstruction."""

    features: FeatureConfig = FeatureConfig()
    pairs: PairConfig = PairConfig()
    matching: MatchConfig = MatchConfig()
    submaps: SubmapConfig = SubmapConfig()
    mapping: MappingConfig = MappingConfig()
    bundle_adjustment: BundleAdjustmentConfig = BundleAdjustmentConfig()
    gnss: GnssConfig = GnssConfig()
    aggregation: AggregationConfig = AggregationConfig()
    output: OutputConfig = OutputConfig()
    semantics: SemanticsConfig = SemanticsConfig()
    models: ModelsConfig = ModelsConfig()
    use_gnss: bool = Field(True, description="`false` ignores GNSS everywhere")
    seed: Annotated[int, Field(ge=0, lt=2**31)] = Field(0, description="of everything that is drawn at random")
    threads: Threads = Field(
        default_factory=_available_cores, description="by default one for each core that the process may use"
    )


def described(error: ValidationError) -> str:
    """Describe settings that are unknown or out of range: all, up to a number that a screen has room for."""
    found = error.errors(include_url=False)
    told = [f"{'.'.join(map(str, p['loc']))}: {_problem(p)}" for p in found[:MAX_PROBLEMS_SHOWN]]
    return enumerated(told, MAX_PROBLEMS_SHOWN, count=len(found))


def _problem(detail: ErrorDetails) -> str:
    if detail["type"] == "extra_forbidden":
        return f"is not a setting{correction_of(EngineConfig, detail['loc'])}"
    return detail["msg"]


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
            values = tomllib.loads(path.read_text(encoding="utf-8-sig"))  # editors of Windows begin with a mark
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}", remedy="Give an existing file.") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(
                f"{path} is not TOML: {error}", remedy="`mrasfm describe settings` prints a file with all settings."
            ) from error
    try:
        return EngineConfig.model_validate(values | overrides)
    except ValidationError as error:
        raise InputError(
            f"{path or 'settings'}: {described(error)}",
            remedy="`mrasfm describe settings` prints all settings and their meaning.",
        ) from error
