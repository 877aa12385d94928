"""The wire contract: pydantic models of what goes into and comes out of MRASfM."""

from schemas.drive import (
    CAMERA_MODELS,
    BodyAxes,
    Camera,
    DriveManifest,
    Frame,
    FrameImage,
    Gnss,
    GnssSample,
    LabelMap,
    Pose,
    Rig,
    RoughPose,
    RoughTrajectory,
    SemanticClass,
)
from schemas.parsing import DocumentError, FieldProblem, parse_manifest, parse_new_manifest

__all__ = [
    "CAMERA_MODELS",
    "BodyAxes",
    "Camera",
    "DocumentError",
    "DriveManifest",
    "FieldProblem",
    "Frame",
    "FrameImage",
    "Gnss",
    "GnssSample",
    "LabelMap",
    "Pose",
    "Rig",
    "RoughPose",
    "RoughTrajectory",
    "SemanticClass",
    "parse_manifest",
    "parse_new_manifest",
]
