"""One run: settings, store, report, and who watches; stages that are done, or found in the store."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from mrasfm_engine import __version__
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError, StorageError
from mrasfm_engine.features.extraction import Extractor
from mrasfm_engine.features.extraction_size import Size, at_sizes
from mrasfm_engine.freed_memory import return_freed_memory
from mrasfm_engine.io.repeated_images import repeated_images
from mrasfm_engine.io.stage_store import (
    Arrays,
    StageStore,
    StageWriter,
    StoredStage,
    content_sha256_of,
    drive_fingerprint,
    fingerprint,
)
from mrasfm_engine.matching.standing import Standing
from mrasfm_engine.registry import Components, load_components
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bools, CountProgress, StageProgress
from schemas.artifacts import CHECKPOINT_FOLDER, Stage

Result = TypeVar("Result")

# Raise a stage's version with every change after which the same input and settings give another result: what was
# finished under an older version is done again, with all that follows from it.
OWN_CAR_VERSION, EXTRACTION_SIZE_VERSION = 5, 4
VERSIONS = {Stage.FEATURES: 11, Stage.MATCHES: 18, Stage.MAPPING: 26, Stage.REFINEMENT: 31}


def new_report() -> dict[str, Any]:
    """The report of a run that has done nothing."""
    return {"engine_version": __version__, "findings": [], "stages": []}


@dataclass
class Run:
    """One reconstruction under way: settings, store, report, and who watches."""

    drive: Drive
    config: EngineConfig
    store: StageStore
    progress: StageProgress
    cancel: Callable[[], bool]
    content_sha256: Mapping[str, str] | None = None  # of the drive's files by name, where the caller knows them
    report: dict[str, Any] = field(default_factory=new_report)
    own_cars: list[Bools | None] = field(default_factory=list)  # by camera, once images were looked at
    side_px: Mapping[Size, int] = field(default_factory=dict)  # that images of a size are reduced to, once it is known
    probed: Mapping[str, ImageFeatures] = field(default_factory=dict)  # features of the probe's images, by file
    key: str = ""  # fingerprint of what has been done so far; where it is empty, the drive's counts
    standing: Standing | None = None  # where units are left out: which, and the drive with all of them
    whole_drive: Drive | None = None
    nothing_left_out: tuple[str, Arrays] | None = None  # key and arrays of a search for stops that is not stored
    is_planned: bool = False  # whether what is found once for the whole drive is in the store, and in no other way

    @cached_property
    def components(self) -> Components:
        """Extractor, matcher and segmenter; their models are loaded at the first use, once."""
        return load_components(self.config, self.drive.manifest.label_map, self.cancel)

    @property
    def extractor(self) -> Extractor:
        """The extractor at the sizes that were found."""
        return at_sizes(self.components.extractor, self.side_px)

    def share(self, other: Run) -> None:
        """Use what another run of the drive with the same settings has loaded, or will load, and knows of its files."""
        self.__dict__["components"] = other.components
        self.__dict__["repeated"] = other.repeated

    @property
    def feature_settings(self) -> object:
        """Dependencies of the features: settings, and the models by their hashes."""
        config = self.config
        models = self.components.fingerprint_of("extractor", "segmenter")
        own_car = OWN_CAR_VERSION if config.features.own_car else None
        size = EXTRACTION_SIZE_VERSION if config.features.max_side_px is None else None
        return [config.features.model_dump(), config.semantics.model_dump(), models, own_car, size]

    def require_unplanned(self) -> None:
        """Refuse to find anew what a plan has found for the whole drive: this run may have some of its files only.

        Raises
        ------
        StorageError
            Where the plan must be there, and is not.
        """
        if self.is_planned:
            raise StorageError(
                "the plan of the drive's sub-maps is not there any more", remedy="Ask for the reconstruction again."
            )

    def once(
        self, name: str, *settings: object, find: Callable[[], tuple[Arrays, dict[str, Any]]]
    ) -> tuple[Arrays, dict[str, Any]]:
        """Find what all sub-maps of a drive share before the extraction, or take it from the store.

        Raises
        ------
        StorageError
            Where the plan must have it, and has not.
        """
        key = fingerprint(self.key or self.drive_key, name, *settings)
        stored = self.store.load(name, key)
        if stored is None:
            self.require_unplanned()
            self.begin(Stage.FEATURES)  # which are extracted next
            stored = find()
            self.store.save(name, key, *stored)
        return stored

    def step(self, stage: Stage) -> CountProgress:
        """The progress callback of a stage."""
        return lambda done, total: self.progress(stage, done, total)

    def begin(self, stage: Stage) -> None:
        """Tell that a stage begins, of which nothing is done yet."""
        self.progress(stage, 0, 0)

    @cached_property
    def drive_key(self) -> str:
        """Fingerprint of the drive's manifest and files."""
        return drive_fingerprint(self.drive, self.contents)

    @cached_property
    def contents(self) -> Mapping[str, str]:
        """SHA-256 of the drive's files by name."""
        if self.content_sha256 is not None:
            return self.content_sha256
        return content_sha256_of(self.whole_drive or self.drive, threads=self.config.threads)

    @cached_property
    def repeated(self) -> frozenset[str]:
        """Files of images that are those before them once more, also before units that are left out."""
        return repeated_images(self.whole_drive or self.drive, self.contents)

    def next_key(self, stage: Stage, settings: object) -> str:
        """The fingerprint of a stage that follows those done so far."""
        return fingerprint(self.key or self.drive_key, stage, settings, VERSIONS[stage])

    def is_done(self, stage: Stage, settings: object) -> bool:
        """Return whether the next stage is in the store."""
        return self.store.has(stage, self.next_key(stage, settings))

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
            return_freed_memory()
        seconds = round(time.perf_counter() - started, 3)
        self.report["stages"].append({"stage": name, "seconds": seconds, "reused": reused, **report_of(found)})
        self.progress(name, 1, 1)
        return found


def store_of(out: Path) -> StageStore:
    """Store of finished stages in a scene's folder."""
    return StageStore(out / CHECKPOINT_FOLDER)
