"""Calls the engine, in a child process, and puts how that ended into a result."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mrasfm_engine import stages
from mrasfm_engine.aggregation import aggregate
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError, InputError, MrasfmError, ReconstructionError, StorageError
from mrasfm_engine.export.contract import ExportOptions
from mrasfm_engine.export.run_export import ExportRequest, run_export
from mrasfm_engine.learned.model_folder import default_folder
from mrasfm_engine.pipeline import plan_submaps, reconstruct, reconstruct_submap
from mrasfm_engine.preflight.drive_check import UnsoundDriveError, is_sound
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.preflight.image_content import inspect_drive
from schemas.api.problems import PROBLEM_TYPE, Problem
from schemas.artifacts import MAP_FILE, REPORT_FILE, Stage, drive_of_scene
from schemas.findings import Finding, as_json, error, warning
from worker.child_protocol import ChildError, ChildRequest, ChildResult, SubmapPlan, Work
from worker.engine_settings import engine_config
from worker.file_client import FilesOnDemand
from worker.progress_pipe import ProgressWriter

CANCEL_INTERVAL_S = 0.2
_PARTS = 1000  # of each format, in which an export's progress is told
_AT_ONE_TIME = 2  # a single sub-map is mapped by the process that goes on with it

# Other errors than these are a disk's, or a scene that contradicts itself or does not read back as it was written.
_FINAL = (InputError, ReconstructionError, CancelledError)
_PASSING = {"submap-process"}  # a process of the engine's own was killed


def work(request: ChildRequest) -> ChildResult:
    """Do what is asked. The engine's own errors are results; anything else is raised."""
    progress = ProgressWriter(request.progress_fd)
    cancelled = CancelFile(request.cancel_file)
    try:
        config = engine_config(request.settings, threads=request.threads)
        plan = _plan(request, config, progress, cancelled)
        if plan is not None:
            return ChildResult(plan=plan)
        return ChildResult(report=_WORK[request.work](request, config, progress, cancelled))
    except MrasfmError as problem:
        return ChildResult(error=described(problem, request))


class CancelFile:
    """Sees the file that asks to stop; once seen, always so.

    The engine asks thousands of times a second, the disk is asked a few times.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found = False
        self._look_at_s = 0.0

    def __call__(self) -> bool:
        """True where the child is to stop."""
        now_s = time.monotonic()
        if not self._found and now_s >= self._look_at_s:
            self._look_at_s = now_s + CANCEL_INTERVAL_S
            self._found = self._path.exists()
        return self._found


def _plan(
    request: ChildRequest, config: EngineConfig, progress: ProgressWriter, cancelled: Callable[[], bool]
) -> SubmapPlan | None:
    """The sub-maps of a long drive that others can map at one time; None where this process does all that is left."""
    if request.submap_workers < _AT_ONE_TIME:
        return None
    submaps = plan_submaps(
        _drive_of(request),
        request.out,
        config,
        workers=request.submap_workers,
        progress=progress,
        cancel=cancelled,
        content_sha256=request.content_sha256,
        bring=_bring(request),
    )
    unfinished = [(s.number, s.first_unit, s.last_unit) for s in submaps if not s.is_finished]
    return SubmapPlan(total=len(submaps), unfinished=unfinished) if len(unfinished) >= _AT_ONE_TIME else None


def _map_submap(
    request: ChildRequest, config: EngineConfig, progress: ProgressWriter, cancelled: Callable[[], bool]
) -> dict[str, Any]:
    report = reconstruct_submap(
        _drive_of(request),
        request.out,
        config,
        request.submap,
        progress=progress,
        cancel=cancelled,
        content_sha256=request.content_sha256,
        bring=_bring(request),
    )
    return {"stages": [{"stage": stage["stage"], "reused": stage["reused"]} for stage in report["stages"]]}


def _reconstruct(
    request: ChildRequest, config: EngineConfig, progress: ProgressWriter, cancelled: Callable[[], bool]
) -> dict[str, Any]:
    reconstruct(
        _drive_of(request),
        request.out,
        config,
        progress=progress,
        cancel=cancelled,
        content_sha256=request.content_sha256,
        bring=_bring(request),
    )
    return _written_report(request.out)


def _aggregate(
    request: ChildRequest, config: EngineConfig, progress: ProgressWriter, cancelled: Callable[[], bool]
) -> dict[str, Any]:
    def complete(report: dict[str, Any]) -> None:
        """Name the map, and the drives without a scene: the engine knows of those alone that fit into no map."""
        report["name"] = request.name
        unfit = [
            {**_member(request, found["scene"]), "name": found["scene"], "problem": _problem(found)}
            for found in report.pop("left_out")
        ]
        report["failed_drives"] = [*request.failed, *unfit]
        report["findings"][:0] = [as_json(_left_out(drive)) for drive in request.failed]  # of others the engine has one

    aggregate(
        request.scenes,
        request.out,
        config,
        into=request.into,
        remove=request.remove,
        leave_out=request.leave_out,
        require_components=not request.leave_out,
        progress=progress,
        cancel=cancelled,
        complete_report=complete,
    )
    figures = _figures(json.loads((request.out / MAP_FILE).read_text(encoding="utf-8")))
    return {**_written_report(request.out), "map": figures}


def _member(request: ChildRequest, name: str) -> Mapping[str, Any]:
    """The drive that a scene, or a component, was made of."""
    return request.members[name] if name in request.members else request.members[drive_of_scene(name)]


def _left_out(drive: Mapping[str, Any]) -> Finding:
    """Finding on a drive that has no scene."""
    problem = drive["problem"]
    return warning("drive-left-out", f"drive {drive['name']} is not in the map: {problem['detail']}", problem["remedy"])


def _problem(found: dict[str, Any]) -> dict[str, Any]:
    """Problem of a scene that is not in the map."""
    problem = Problem(
        type=PROBLEM_TYPE + found["code"],
        title="The scene fits into no map",
        detail=found["what"],
        remedy=found["remedy"],
        retryable=False,
    )
    return problem.model_dump(mode="json", exclude_defaults=True)


def _figures(document: dict[str, Any]) -> dict[str, Any]:
    """The figures of `map.json` that are recorded with the map's version."""
    return {
        "scenes": len(document["scenes"]),
        "names": [scene["name"] for scene in document["scenes"]],
        "seams": sum(bool(seam["accepted"]) for seam in document["seams"]),
        "unconnected": document["unconnected"],
    }


def _written_report(out: Path) -> dict[str, Any]:
    """The report as written, and not as returned: the file has been through the writer's conversions."""
    written: dict[str, Any] = json.loads((out / REPORT_FILE).read_text(encoding="utf-8"))
    return written


def _drive_of(request: ChildRequest) -> Path:
    assert request.drive is not None, "only aggregations and exports have none"
    return request.drive


def _bring(request: ChildRequest) -> FilesOnDemand | None:
    """Asks for the drive's files where they do not lie in its folder."""
    return None if request.files is None else FilesOnDemand(request.files)


def _preflight(
    request: ChildRequest, config: EngineConfig, progress: ProgressWriter, cancelled: Callable[[], bool]
) -> dict[str, Any]:
    """The findings of a reconstruction's first seconds: manifest, files, images, and the calibration's direction."""
    run = stages.Run(
        read_drive(_drive_of(request), bring=_bring(request)),
        config,
        stages.store_of(request.out),
        progress,
        cancelled,
        request.content_sha256,
    )
    findings = inspect_drive(
        run.drive,
        use_gnss=config.use_gnss,
        progress=run.step(Stage.PREFLIGHT),
        cancel=cancelled,
        content_sha256=run.content_sha256,
    )
    if is_sound(findings):
        progress(Stage.CALIBRATION, 0, 1)
        try:
            stages.probe(run)
        except InputError as problem:
            findings.insert(0, error(problem.code, _without_paths(problem.what, request), problem.remedy))
        progress(Stage.CALIBRATION, 1, 1)
    if cancelled():
        raise CancelledError
    return {"findings": [as_json(finding) for finding in findings], "sound": is_sound(findings)}


def _export(
    request: ChildRequest, config: EngineConfig, progress: ProgressWriter, cancelled: Callable[[], bool]
) -> dict[str, Any]:
    """The formats of an export, as the API shows them; the files lie in folders of their names."""
    assert request.source is not None, "every export has one"
    formats = list(request.formats)

    def pass_on(name: str, done: int, total: int) -> None:
        """Pass the progress of a format on as a part of that of all."""
        within = done / total if total > 0 else 0.0
        progress(Stage.EXPORT, round(_PARTS * (formats.index(name) + within)), _PARTS * len(formats))

    report = run_export(
        ExportRequest(
            folder=request.source,
            out=request.out,
            formats=formats,
            options=ExportOptions(**request.options),
            drives=request.drives,
            threads=config.threads,
        ),
        progress=pass_on,
        cancel=cancelled,
    )
    return {"results": [_export_result(name, result) for name, result in report["formats"].items()]}


def _export_result(name: str, result: Mapping[str, Any]) -> dict[str, Any]:
    files = result.get("files", ())
    return {
        "format": name,
        "files": len(files),
        "size_bytes": sum(file["bytes"] for file in files),
        "withheld": result.get("withheld"),
        "notes": list(result.get("notes", ())),
    }


_WORK = {
    Work.RECONSTRUCTION: _reconstruct,
    Work.PREFLIGHT: _preflight,
    Work.AGGREGATION: _aggregate,
    Work.SUBMAP: _map_submap,
    Work.EXPORT: _export,
}


def described(problem: MrasfmError, request: ChildRequest) -> ChildError:
    """An error of the engine, without the paths of this machine."""
    findings = problem.findings if isinstance(problem, UnsoundDriveError) else ()
    return ChildError(
        code=problem.code,
        what=_without_paths(problem.what, request),
        remedy=problem.remedy,
        retryable=not isinstance(problem, _FINAL) or problem.code in _PASSING,
        is_storage=isinstance(problem, StorageError),
        findings=[as_json(finding) for finding in findings],
    )


def _without_paths(what: str, request: ChildRequest) -> str:
    """Files by their names in the drive or scene: where these lie on this machine is of no interest to who asked."""
    given = (
        request.drive, request.into, request.source, request.out, *request.scenes.values(), *request.drives.values()
    )  # fmt: skip
    for folder in (folder for folder in given if folder is not None):
        for path in (folder, folder.resolve()):
            what = what.replace(f"{path}/", "").replace(str(path), path.name)
    return what.replace(str(default_folder()), "the models' folder of the worker")
