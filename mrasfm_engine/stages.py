"""The stages of a reconstruction.

Each takes its input, leaves its result and a report in the store, and is skipped where both are there already.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mrasfm_engine import __version__
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError, ReconstructionError, StorageError
from mrasfm_engine.export.picture_files import PictureFiles
from mrasfm_engine.features.extraction import extract_features, features_by_image
from mrasfm_engine.features.own_car import OwnCar, find_own_cars, large_share_finding
from mrasfm_engine.features.stored_features import FeatureWriter, StoredFeatures
from mrasfm_engine.io import left_out_images
from mrasfm_engine.io.images import mask_of_png, mask_png
from mrasfm_engine.io.stage_store import Arrays, StageStore, StageWriter, StoredStage, drive_fingerprint, fingerprint
from mrasfm_engine.mapping import gaps, mapping_report, miscalibration
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.components import map_drive
from mrasfm_engine.mapping.keyframes import register_between_keyframes
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.scene_builder import build_scene
from mrasfm_engine.matching.calibration_check import require_calibration_direction
from mrasfm_engine.matching.pair_choice import PairChoice
from mrasfm_engine.matching.pair_matching import match_pairs
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory, prior_trajectory
from mrasfm_engine.matching.simultaneous import contradiction
from mrasfm_engine.matching.standing import Standing, find_standing, without_standing
from mrasfm_engine.preflight.drive_check import require_sound
from mrasfm_engine.preflight.image_content import inspect_drive
from mrasfm_engine.registry import Components, load_components
from mrasfm_engine.scene.drive import Drive, Incomplete
from mrasfm_engine.scene.row_bands import RowBands
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches, Scene
from mrasfm_engine.scene.semantics import CLASS_NAMES, count_classes
from mrasfm_engine.scene.standing_units import with_standing_units, without_units
from mrasfm_engine.triangulation.tracks import Keypoints
from mrasfm_engine.types import Bools, CountProgress, Ints, StageProgress
from mrasfm_engine.visualization.pictures import draw_pictures
from schemas.artifacts import CHECKPOINT_FOLDER, Stage
from schemas.findings import as_json

Result = TypeVar("Result")

PROBE_UNITS = 5
STANDING, STANDING_VERSION = "standing", 2
PAIR_ARRAYS = ("ends", "matches", "inliers", "is_revisit")
WINDOW_PAIRS = 4096  # written at once: some megabytes, with nearly nothing for headers
# Raise a stage's version with every change after which the same input and settings give another result: what was
# finished under an older version is done again, with all that follows from it.
VERSIONS = {Stage.FEATURES: 4, Stage.MATCHES: 6, Stage.MAPPING: 9}


@dataclass
class Run:
    """One reconstruction under way: settings, store, report, and who watches."""

    drive: Drive
    config: EngineConfig
    store: StageStore
    progress: StageProgress
    cancel: Callable[[], bool]
    content_sha256: Mapping[str, str] | None = None  # of the drive's files by name, where the caller knows them
    report: dict[str, Any] = field(default_factory=lambda: {"engine_version": __version__, "stages": []})
    own_cars: list[Bools | None] = field(default_factory=list)  # by camera, once its images were looked at
    key: str = ""  # fingerprint of what has been done so far; where it is empty, the drive's counts
    standing: Standing | None = None  # where units are left out: which, and the drive with all of them
    whole_drive: Drive | None = None

    @cached_property
    def components(self) -> Components:
        """Extractor, matcher and segmenter; their models are loaded at the first use, once."""
        return load_components(self.config, self.drive.manifest.label_map)

    @property
    def feature_settings(self) -> object:
        """Dependencies of the features: settings, and the models by their hashes."""
        config = self.config
        models = self.components.fingerprint_of("extractor", "segmenter")
        return [config.features.model_dump(), config.semantics.model_dump(), models]

    def step(self, stage: Stage) -> CountProgress:
        """The progress callback of a stage."""
        return lambda done, total: self.progress(stage, done, total)

    def begin(self, stage: Stage) -> None:
        """Tell that a stage begins, of which nothing is done yet."""
        self.progress(stage, 0, 0)

    @cached_property
    def drive_key(self) -> str:
        """Fingerprint of the drive's manifest and files."""
        return drive_fingerprint(self.drive, self.content_sha256, threads=self.config.threads)

    def next_key(self, stage: Stage, settings: object) -> str:
        """The fingerprint of a stage that follows those done so far."""
        return fingerprint(self.key or self.drive_key, stage, settings, VERSIONS[stage])

    def stage(
        self, name: Stage, settings: object, work: Callable[[], tuple[Arrays, dict[str, Any]]]
    ) -> tuple[Arrays, dict[str, Any]]:
        """Do a stage, or take its result from the store.

        A stage's fingerprint covers the one before it, its own settings and its version.
        """

        def done() -> tuple[Arrays, dict[str, Any]]:
            found = work()
            self.store.save(name, self.key, *found)
            return found

        return self._found_or_done(
            name, settings, lambda: self.store.load(name, self.key), done, lambda found: found[1]
        )

    def large_stage(
        self, name: Stage, settings: object, work: Callable[[StageWriter], dict[str, Any]]
    ) -> tuple[StoredStage, dict[str, Any]]:
        """Do a stage whose arrays are written as they come, or find its file in the store; `work` gives its report."""

        def done() -> StoredStage:
            with self.store.writing(name, self.key) as writer:
                writer.finish(work(writer))
            written = self.store.open(name, self.key)
            if written is None:
                raise StorageError(
                    f"what was written of the stage {name} does not come back from the disk",
                    remedy="Check the disk that the scene is written to.",
                )
            return written

        found = self._found_or_done(
            name, settings, lambda: self.store.open(name, self.key), done, lambda found: found.report
        )
        return found, found.report

    def _found_or_done(
        self,
        name: Stage,
        settings: object,
        find: Callable[[], Result | None],
        do: Callable[[], Result],
        report_of: Callable[[Result], dict[str, Any]],
    ) -> Result:
        if self.cancel():
            raise CancelledError
        self.key = self.next_key(name, settings)
        started = time.perf_counter()
        found = find()
        reused = found is not None
        if found is None:
            self.begin(name)
            found = do()
        seconds = round(time.perf_counter() - started, 3)
        self.report["stages"].append({"stage": name, "seconds": seconds, "reused": reused, **report_of(found)})
        self.progress(name, 1, 1)
        return found


def load_models(run: Run) -> None:
    """Read the models that the settings name; refuse what does not go together before any work."""
    run.report["models"] = run.components.describe()


def preflight(run: Run) -> None:
    """Check manifest, files and a sample of the images; refuse what cannot work before any long work."""
    run.begin(Stage.PREFLIGHT)
    findings = inspect_drive(
        run.drive, use_gnss=run.config.use_gnss, progress=run.step(Stage.PREFLIGHT), cancel=run.cancel
    )
    run.report["findings"] = [as_json(finding) for finding in findings]
    require_sound(findings)
    run.progress(Stage.PREFLIGHT, 1, 1)


def prior(run: Run) -> PriorTrajectory:
    """Read the prior trajectory of the units."""
    result = prior_trajectory(run.drive, run.config.gnss, use_gnss=run.config.use_gnss)
    run.report["prior"] = {
        "source": result.source,
        "gnss_samples": 0 if result.gnss is None else len(result.gnss.good),
        "gnss_gross_errors": 0 if result.gnss is None else int((~result.gnss.good).sum()),
    }
    return result


def leave_out_standing(run: Run, known: PriorTrajectory) -> PriorTrajectory:
    """Leave out units between the first and the last of each stop; the prior trajectory of all others.

    The run goes on with the drive of these, until `all_units`.
    """
    if not run.config.mapping.keyframe_motion_px or len(run.drive.timestamps_us) < 3:
        return known
    of_prior = [run.config.gnss.model_dump(), run.config.use_gnss]
    key = fingerprint(run.drive_key, STANDING, run.config.mapping.keyframe_motion_px, of_prior, STANDING_VERSION)
    if (stored := run.store.load(STANDING, key)) is not None:
        included, moved_px, compared = (stored[0][name] for name in ("included", "moved_px", "compared"))
        standing = Standing(included=included, moved_px=moved_px, compared=int(compared))
    else:
        standing = find_standing(
            run.drive,
            known,
            min_motion_px=run.config.mapping.keyframe_motion_px,
            threads=run.config.threads,
            cancel=run.cancel,
        )
    if standing.included.all():
        return known
    if stored is None:
        arrays = {"included": standing.included, "moved_px": standing.moved_px, "compared": np.array(standing.compared)}
        run.store.save(STANDING, key, arrays, {})
    run.standing, run.whole_drive = standing, run.drive
    run.key = fingerprint(run.drive_key, standing.included.tolist())
    run.drive = without_standing(run.drive, standing.included)
    return prior_trajectory(run.drive, run.config.gnss, use_gnss=run.config.use_gnss)


def all_units(
    run: Run, result: Scene, components: Sequence[tuple[Scene, dict[str, Any]]] = ()
) -> tuple[Scene, list[tuple[Scene, dict[str, Any]]]]:
    """The scenes with the units that `leave_out_standing` left out, and the reports in the drive's own units."""
    standing, drive = run.standing, run.whole_drive
    if standing is None or drive is None:
        return result, list(components)
    result, stops = with_standing_units(result, drive, standing.included, standing.moved_px)
    unit_of = np.flatnonzero(standing.included)
    parts, taken = list[tuple[Scene, dict[str, Any]]](), result.unit_registered.copy()
    for part, report in components:
        whole = with_standing_units(part, drive, standing.included, standing.moved_px)[0]
        # A stop between two parts has its pose in the larger one.
        parts.append((without_units(whole, taken), in_units(report, unit_of)))
        taken |= whole.unit_registered
    run.drive = drive
    run.report["stages"] = [in_units(stage, unit_of) for stage in run.report["stages"]]
    frames = drive.manifest.frames
    run.report["standing"] = {
        "units": int((~standing.included).sum()),
        "units_compared": standing.compared,
        "stops": [
            {
                "first_unit": stop.first,
                "last_unit": stop.last,
                "first_source_frame": frames[stop.first].source_frame,
                "last_source_frame": frames[stop.last].source_frame,
                "units_between": stop.last - stop.first - 1,
                "images_moved_at_most_px": round(float(standing.moved_px[stop.first + 1 : stop.last].max()), 3),
                "posed": bool(result.unit_registered[stop.first + 1]),
                "sigma_at_most_m": float(stop.sigma_m.max()) if np.isfinite(stop.sigma_m).all() else None,
            }
            for stop in stops
        ],
    }
    return result, parts


def in_units(report: Any, unit_of: Ints) -> Any:
    """A report with other numbers of its units: unit k of it becomes `unit_of[k]`."""
    if isinstance(report, list):
        return [in_units(part, unit_of) for part in report]
    if not isinstance(report, dict):
        return report
    result = {name: in_units(value, unit_of) for name, value in report.items()}
    if isinstance(report.get("unit"), int):
        result["unit"] = int(unit_of[report["unit"]])
    if "spans" in report:
        result["spans"] = [[int(unit_of[unit]) for unit in span] for span in report["spans"]]
    if report.get("initial_units") is not None:
        result["initial_units"] = [int(unit_of[unit]) for unit in report["initial_units"]]
    return result


def probe(run: Run) -> None:
    """Check on the first units that the calibration is the right way round."""
    images = [i for i, image in enumerate(run.drive.images) if image.unit < PROBE_UNITS]
    known = run.store.has("features", run.next_key(Stage.FEATURES, run.feature_settings))
    if len(run.drive.cameras) < 2 or known:
        return
    first = run.drive.manifest.model_copy(update={"frames": run.drive.manifest.frames[:PROBE_UNITS]})
    features = extract_features(
        Drive(run.drive.root, first),
        run.components.extractor,
        threads=run.config.threads,
        segmenter=run.components.segmenter,
        cancel=run.cancel,
    )
    if all(f.left_out for f in features):
        return  # the extraction says whether there are others
    require_calibration_direction(run.drive, images, features, run.components.matcher, run.config.matching)


def features(run: Run) -> Sequence[ImageFeatures]:
    """Keypoints and descriptors of all images; they stay on disk."""

    def work(stage: StageWriter) -> dict[str, Any]:
        own_cars: list[OwnCar] = []
        if run.config.features.own_car:
            own_cars = find_own_cars(run.drive, threads=run.config.threads, cancel=run.cancel)
        writer = FeatureWriter(stage)
        by_class: Counter[str] = Counter()
        made, left_out = 0, dict[str, Incomplete]()
        extracted = features_by_image(
            run.drive,
            run.components.extractor,
            threads=run.config.threads,
            segmenter=run.components.segmenter,
            class_margin_px=run.config.features.class_margin_px,
            own_cars=[car.mask for car in own_cars],
            progress=run.step(Stage.FEATURES),
            cancel=run.cancel,
        )
        with closing(extracted):
            for image, found in zip(run.drive.images, extracted, strict=True):
                writer.add(found)
                if isinstance(found, Incomplete):
                    left_out[image.file] = found
                else:
                    by_class.update(count_classes([found.classes]))
                    made += found.made_mask is not None
        writer.finish()
        for name, array in _pack_own_cars(own_cars).items():
            stage.add(name, array)
        few = [run.drive.images[i].file for i in np.flatnonzero(writer.counts < 100)]
        return {
            "images": len(run.drive.images),
            "keypoints": int(writer.counts.sum()),
            "keypoints_by_class": {name: by_class[name] for name in CLASS_NAMES.values() if by_class[name]},
            "images_with_mask": {
                "given": sum(image.mask is not None for image in run.drive.images),
                "made_by_model": made,
            },
            "own_car": {
                camera.name: car.report()
                for camera, car in zip(run.drive.cameras if own_cars else [], own_cars, strict=True)
            },
            "images_with_under_100_keypoints": [file for file in few if file not in left_out],
            "images_left_out": [{"file": file, "reason": str(reason)} for file, reason in left_out.items()],
        }

    stage, report = run.large_stage(Stage.FEATURES, run.feature_settings, work)
    left_out = {image["file"]: Incomplete(image["reason"]) for image in report["images_left_out"]}
    _say_left_out(run, left_out)
    run.own_cars = _unpack_own_cars(stage) or [None for _ in run.drive.cameras]
    run.report["own_car"] = report["own_car"]
    for camera, mask in zip(run.drive.cameras, run.own_cars, strict=True):
        run.report["findings"] += [as_json(finding) for finding in large_share_finding(camera.name, mask)]
    if len(left_out) == len(run.drive.images):
        raise left_out_images.nothing_left(left_out)
    found = StoredFeatures(stage, [left_out.get(image.file) for image in run.drive.images])
    if not found.counts.sum():
        raise ReconstructionError(
            "no image of the drive has a keypoint",
            remedy="Check that the images are not empty, and that masks do not cover everything.",
            code="no-features",
        )
    return found


def _say_left_out(run: Run, left_out: Mapping[str, Incomplete]) -> None:
    """The preflight's findings are of a sample, these are of all images: they take their place."""
    findings = [finding for finding in run.report.get("findings", []) if finding["code"] not in left_out_images.CODES]
    found = left_out_images.left_out_findings(left_out, len(run.drive.images))
    run.report["findings"] = findings + [as_json(finding) for finding in found]


def _pack_own_cars(own_cars: Sequence[OwnCar]) -> Arrays:
    masks = [
        np.zeros(0, np.uint8) if car.mask is None else mask_png(car.mask.astype(np.uint8) * 255) for car in own_cars
    ]
    return {
        "own_car_bytes": np.array([len(mask) for mask in masks], dtype=np.int64),
        "own_cars": np.concatenate([np.zeros(0, np.uint8), *masks]),
    }


def _unpack_own_cars(stage: StoredStage) -> list[Bools | None]:
    sizes = stage.read("own_car_bytes")
    if not len(sizes):
        return []
    masks = np.split(stage.read("own_cars"), np.cumsum(sizes)[:-1])
    return [mask_of_png(mask) > 0 if len(mask) else None for mask in masks]


def matches(run: Run, found: Sequence[ImageFeatures], known: PriorTrajectory) -> list[PairMatches]:
    """Candidate pairs by the prior (or by window and similarity), matched and verified."""

    def work(stage: StageWriter) -> dict[str, Any]:
        chosen = PairChoice(run.drive, found, known, run.config)
        result = match_pairs(
            run.drive,
            found,
            chosen.first,
            run.components.matcher,
            run.config.matching,
            run.config.bundle_adjustment,
            threads=run.config.threads,
            prior=known,
            further=chosen.further,
            progress=run.step(Stage.MATCHES),
            cancel=run.cancel,
        )
        names = [camera.name for camera in run.drive.cameras]
        contradicted = contradiction(names, run.drive.rig_from_cam, result.rig)
        _write_pairs(stage, chosen.with_revisits(result.pairs))
        return {
            "candidate_pairs": result.candidates,
            "verified_pairs": len(result.pairs) - result.against_calibration,
            "rejected_pairs": {
                "few matches": result.few_matches,
                "few inliers": result.few_inliers,
                "against the calibration": result.against_calibration,
            },
            "prior": {
                "pairs_predicted": result.prior.predicted,
                "pairs_against_the_prior": result.prior.against,
                "left_out": result.prior.left_out,
            },
            "dropped_between_classes": result.across_classes,
            "matches": sum(len(p.matches) for p in result.pairs),
            "verified_matches": sum(int(p.inliers.sum()) for p in result.pairs),
            "simultaneous": {
                "matches": result.rig.matches,
                "share_that_fits_calibration_as_given": round(result.rig.fitted_as_given, 4),
                "share_that_fits_calibration_as_corrected": round(result.rig.fitted, 4),
            },
            "contradiction": None if contradicted is None else as_json(contradicted),
        }

    settings = [section.model_dump() for section in (run.config.pairs, run.config.matching, run.config.gnss)]
    priors = {"refine_calibration", "sigma_rotation_deg", "sigma_translation_m"}
    settings.append(run.config.bundle_adjustment.model_dump(include=priors))
    settings.append({"use_gnss": run.config.use_gnss, "models": run.components.fingerprint_of("matcher")})
    stage, report = run.large_stage(Stage.MATCHES, settings, work)
    if report["contradiction"] is not None:
        run.report["findings"].append(report["contradiction"])
    if not report["verified_pairs"]:
        raise ReconstructionError(
            f"nothing matches: none of {report['candidate_pairs']} image pairs has a verified match",
            remedy="Check that consecutive frames show the same scene, and that images are sharp and not mixed up.",
            code="nothing-matches",
        )
    return _read_pairs(stage)


def _write_pairs(stage: StageWriter, pairs: Sequence[PairMatches]) -> None:
    """Write matches window by window, so that they are not in memory twice."""
    first = range(0, len(pairs), WINDOW_PAIRS)
    stage.add("windows", np.array(len(first), dtype=np.int64))
    for window, begin in enumerate(first):
        for name, array in pack_pairs(pairs[begin : begin + WINDOW_PAIRS]).items():
            stage.add(f"{name}.{window}", array)


def _read_pairs(stage: StoredStage) -> list[PairMatches]:
    return [
        pair
        for window in range(int(stage.read("windows")))
        for pair in unpack_pairs({name: stage.read(f"{name}.{window}") for name in PAIR_ARRAYS})
    ]


def pack_pairs(pairs: Sequence[PairMatches]) -> Arrays:
    """Matches of all pairs in a few arrays."""
    return {
        "ends": np.array([(p.image_a, p.image_b, len(p.matches)) for p in pairs], dtype=np.int64).reshape(-1, 3),
        "matches": np.concatenate([p.matches for p in pairs] or [np.zeros((0, 2), np.int32)]),
        "inliers": np.concatenate([p.inliers for p in pairs] or [np.zeros(0, np.bool_)]),
        "is_revisit": np.array([p.is_revisit for p in pairs], dtype=np.bool_),
    }


def unpack_pairs(arrays: Arrays) -> list[PairMatches]:
    """Restore the matches from `pack_pairs`."""
    stops = np.cumsum(arrays["ends"][:, 2])
    return [
        PairMatches(
            image_a=int(a),
            image_b=int(b),
            matches=arrays["matches"][hi - n : hi],
            inliers=arrays["inliers"][hi - n : hi],
            is_revisit=bool(is_revisit),
        )
        for (a, b, n), hi, is_revisit in zip(arrays["ends"], stops, arrays["is_revisit"], strict=True)
    ]


def mapping(
    run: Run, found: Sequence[ImageFeatures], pairs: Sequence[PairMatches], known: PriorTrajectory
) -> list[Mapper]:
    """Units registered one by one, points triangulated, everything adjusted; of every component, the largest first."""
    bands = RowBands.from_drive(run.drive, compensate=run.config.mapping.motion_compensation)
    keypoints = Keypoints.from_features(run.drive, found, bands)

    def work() -> tuple[Arrays, dict[str, Any]]:
        parts = map_drive(
            run.drive,
            keypoints,
            pairs,
            known.world_from_rig,
            run.config,
            absolute=absolute_priors(known),
            progress=run.step(Stage.MAPPING),
            cancel=run.cancel,
        )
        for part in parts:
            part.mapper.missing |= np.array([f.left_out is not None for f in found])
        arrays = {
            f"{number}.{name}": array
            for number, part in enumerate(parts)
            for name, array in part.mapper.to_arrays().items()
        }
        return arrays, {
            **mapping_report.describe(parts[0].mapper, parts[0].log, [part.mapper for part in parts[1:]]),
            **gaps.describe(parts),
            "findings": [as_json(finding) for finding in gaps.findings(parts)],
        }

    sections = (run.config.mapping, run.config.bundle_adjustment, run.config.gnss)
    settings = [*(section.model_dump() for section in sections), run.config.seed, run.config.use_gnss]
    arrays, report = run.stage(Stage.MAPPING, settings, work)
    run.report["findings"] += report["findings"]
    count = len(report["components"])
    return [
        Mapper.from_arrays(
            run.drive,
            keypoints,
            run.config,
            known.world_from_rig,
            {name.partition(".")[2]: array for name, array in arrays.items() if name.startswith(f"{number}.")},
        )
        for number in range(count)
    ]


def absolute_priors(known: PriorTrajectory) -> AbsolutePriors:
    """Absolute poses that the manifest knows, for the adjustments."""
    return AbsolutePriors(
        gnss=known.gnss,
        antenna_in_rig_m=known.antenna_in_rig_m,
        rough_world_from_rig=known.rough_world_from_rig,
    )


def scene(
    run: Run, mapper: Mapper, found: Sequence[ImageFeatures], pairs: Sequence[PairMatches], known: PriorTrajectory
) -> Scene:
    """Georeferencing, the final adjustment with all priors, and how certain the result is."""
    run.begin(Stage.REFINEMENT)
    result, findings, report = _refined(run, mapper, found, pairs, known)
    run.report["findings"] += findings
    run.report["stages"].append(report)
    run.progress(Stage.REFINEMENT, 1, 1)
    return result


def components(
    run: Run,
    largest: Mapper,
    whole: Scene,
    others: Sequence[Mapper],
    known: PriorTrajectory,
) -> list[tuple[Scene, dict[str, Any]]]:
    """Scenes of the components besides the largest, each with its report; those that fall apart are findings.

    Their calibration is that of the largest, `whole`.
    """
    result: list[tuple[Scene, dict[str, Any]]] = []
    for mapper in others:
        inside = mapper.registered[mapper.image_unit]
        try:
            one, findings, stage = _refined(run, mapper, whole.features, whole.pairs, known, calibrated=largest)
        except ReconstructionError as problem:
            run.report["findings"].append(as_json(gaps.lost(mapper, problem)))
            continue
        header: dict[str, Any] = {
            name: run.report[name] for name in ("engine_version", "drive", "settings", "models") if name in run.report
        }
        one.features = [f if seen else _without_keypoints(f) for f, seen in zip(whole.features, inside, strict=True)]
        one.calibration, one.calibration_observability = whole.calibration, whole.calibration_observability
        one.pairs = [pair for pair in whole.pairs if inside[[pair.image_a, pair.image_b]].all()]
        result.append((one, {**header, "component": len(result) + 1, "findings": findings, "stages": [stage]}))
    return result


def _without_keypoints(features: ImageFeatures) -> ImageFeatures:
    """Features of an image that takes no part in a component."""
    scores = None if features.scores is None else features.scores[:0]
    return ImageFeatures(
        xy_px=features.xy_px[:0],
        descriptors=features.descriptors[:0],
        colors=features.colors[:0],
        scores=scores,
        left_out=features.left_out,
    )


def _refined(
    run: Run,
    mapper: Mapper,
    found: Sequence[ImageFeatures],
    pairs: Sequence[PairMatches],
    known: PriorTrajectory,
    *,
    calibrated: Mapper | None = None,
) -> tuple[Scene, list[dict[str, str]], dict[str, Any]]:
    """A component's scene, findings, and what the report says of the stage."""
    started = time.perf_counter()
    refinement = refine(
        mapper,
        absolute_priors(known),
        calibrated=calibrated,
        progress=run.step(Stage.REFINEMENT),
        cancel=run.cancel,
    )
    between = register_between_keyframes(mapper, max_error_px=run.config.mapping.filter_error_px)
    findings = [] if refinement.placement is None else list(refinement.placement.findings)
    if refinement.intrinsics is not None:
        findings += refinement.intrinsics.findings(mapper)
    findings += [
        miscalibration.finding(run.drive.cameras[wrong.camera].name, wrong) for wrong in refinement.miscalibrations
    ]
    findings += refinement.late_cameras
    if refinement.wrong_pair is not None:
        names = [camera.name for camera in run.drive.cameras]
        findings.append(miscalibration.pair_finding(names, refinement.wrong_pair))
    findings += mapping_report.motion_findings(mapper)
    report = {
        "stage": Stage.REFINEMENT,
        "seconds": round(time.perf_counter() - started, 3),
        "reused": False,
        **mapping_report.describe_refinement(mapper, refinement),
        **mapping_report.describe_between(mapper, between),
    }
    result = build_scene(mapper, refinement, found, pairs, known, notes=run.drive.manifest.notes)
    result.own_cars = run.own_cars
    return result, [as_json(finding) for finding in findings], report


def pictures(run: Run, result: Scene, scratch: Path) -> PictureFiles:
    """The pictures of a scene as files by name, large ones in the folder `scratch`; see `draw_pictures`."""
    if not run.config.output.pictures:
        return {}

    def step(done: int, total: int) -> None:
        if run.cancel():
            raise CancelledError
        run.progress(Stage.PICTURES, done, total)

    started = time.perf_counter()
    run.begin(Stage.PICTURES)
    files, report = draw_pictures(result, scratch=scratch, seed=run.config.seed, progress=step)
    seconds = round(time.perf_counter() - started, 3)
    run.report["stages"].append({"stage": Stage.PICTURES, "seconds": seconds, "reused": False, **report})
    run.progress(Stage.PICTURES, 1, 1)
    return files


def store_of(out: Path) -> StageStore:
    """Store of finished stages in a scene's folder."""
    return StageStore(out / CHECKPOINT_FOLDER)
