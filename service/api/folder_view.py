"""The console over one folder: what `mrasfm view` serves in place of a service, with the same resources, to read."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response, StreamingResponse

from schemas.api.maps import MapResource, MapSummary, MapVersionResource
from schemas.api.scenes import SceneResource, SceneSummary
from schemas.api.session import SessionResource
from schemas.artifacts import MAP_FILE, REPORT_FILE
from service.api.middleware.security_headers import CONTENT_SECURITY_POLICY, SecurityHeaders
from service.api.routes.console import FOLDER, add_console, console_policy
from service.domain.scenes import media_type

SCENE_ID, MAP_ID = "local", "local"
_HOSTS = ["127.0.0.1", "localhost"]  # another site's name that leads here reads nothing
_FIGURES = {
    "registered_units": "registered_units",
    "units": "total_units",
    "registered_images": "registered_images",
    "images": "total_images",
    "points": "points",
    "georeferenced": "georeferenced",
}


class FolderViewError(Exception):
    """A folder that cannot be shown; the message names it and says what to do."""


@dataclass(frozen=True, kw_only=True)
class DriveFolder:
    """The images of a drive.

    Names in its manifest lie inside the folder. Links of the file system are followed: images are often kept elsewhere,
    and whoever has put a link there may read what it leads to.
    """

    name: str
    folder: Path
    images: frozenset[str]

    @classmethod
    def read(cls, folder: Path) -> DriveFolder:
        """A folder with `drive.json`.

        Raises
        ------
        FolderViewError
        """
        manifest = _document(folder / "drive.json")
        try:
            images = {image["file"] for frame in manifest["frames"] for image in frame["images"].values()}
            outside = sorted(path for path in images if not _is_inside(path))
            name = str(manifest["name"])
        except (KeyError, TypeError, AttributeError) as error:
            raise FolderViewError(f"{folder / 'drive.json'} is no manifest: check it with mrasfm preflight.") from error
        if outside:
            raise FolderViewError(
                f"{folder / 'drive.json'} names {outside[0]}, which is not in its folder. Correct it: the command "
                "mrasfm preflight lists all such names."
            )
        return cls(name=name, folder=folder.resolve(), images=frozenset(images))


def create_view(folder: Path, drives: Sequence[DriveFolder] = ()) -> tuple[FastAPI, str]:
    """An application that shows a scene or map, and the address of its page.

    Raises
    ------
    FolderViewError
        Where the folder holds neither.
    """
    if not (folder / REPORT_FILE).is_file():
        raise FolderViewError(f"{folder} has no {REPORT_FILE}: give the folder of a complete scene or map.")
    is_map = (folder / MAP_FILE).is_file()
    app = FastAPI(title="MRASfM view", docs_url=None, redoc_url=None, openapi_url=None)
    app.add_middleware(SecurityHeaders)
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=_HOSTS)
    _add_page(app)
    _add_session(app, folder)
    try:
        (_add_map if is_map else _add_scene)(app, folder, drives)
    except (KeyError, TypeError, AttributeError, ValueError) as error:  # as of the report of an export
        what = f"{REPORT_FILE} and {MAP_FILE} are not those of a map" if is_map else f"{REPORT_FILE} is not a scene's"
        raise FolderViewError(f"{folder}: {what}: give the folder of a complete scene or map.") from error
    _add_images(app, drives)
    add_console(app)
    return app, f"#/maps/{MAP_ID}/3d" if is_map else f"#/scenes/{SCENE_ID}/3d"


def _add_page(app: FastAPI) -> None:
    page = (FOLDER / "index.html").read_text(encoding="utf-8")
    page = page.replace("<title>", '<meta name="mrasfm-session" content="open">\n<title>', 1)

    @app.get("/")
    def show() -> HTMLResponse:
        return HTMLResponse(page, headers={CONTENT_SECURITY_POLICY: console_policy(), "Cache-Control": "no-cache"})


def _add_session(app: FastAPI, folder: Path) -> None:
    shown = SessionResource(
        project=folder.name,
        key_id="none",
        key_name="none",
        key_created_at=datetime.now(UTC),
        used_bytes=0,
        max_bytes=0,
        max_active_jobs=0,
        max_drives=0,
    )

    @app.get("/v1/session")
    def get_session() -> SessionResource:
        return shown

    @app.get("/v1/jobs")
    def list_jobs() -> JSONResponse:
        return _page([])

    @app.get("/v1/events")
    async def stream() -> StreamingResponse:
        async def events() -> Any:
            # Nothing of a folder changes: the stream ends, and is asked for again in a while.
            yield 'event: ready\ndata: {"after":0}\nretry: 60000\n\n'

        return StreamingResponse(events(), media_type="text/event-stream")


def _add_scene(app: FastAPI, folder: Path, drives: Sequence[DriveFolder]) -> None:
    report = _document(folder / REPORT_FILE)
    files = _files(folder)
    name = str(report.get("drive", folder.name))
    url = f"/v1/scenes/{SCENE_ID}"
    summary = SceneSummary(**_figures(report), components=report.get("components", []))
    scene = SceneResource(
        id=SCENE_ID,
        name=name,
        drive_id="drive-0" if len(drives) == 1 else _drive_id(drives, name),
        job_id="none",
        summary=summary,
        files=_resources(files, url),
        created_at=_time_of(folder),
    )

    @app.get("/v1/scenes")
    def list_scenes() -> JSONResponse:
        return _page([scene.model_dump(mode="json") | {"files": []}])

    @app.get(url)
    def get_scene() -> SceneResource:
        return scene

    _add_files(app, url, files)

    @app.get("/v1/maps")
    def list_maps() -> JSONResponse:
        return _page([])


def _add_map(app: FastAPI, folder: Path, drives: Sequence[DriveFolder]) -> None:
    report, document = _document(folder / REPORT_FILE), _document(folder / MAP_FILE)
    files = _files(folder)
    url = f"/v1/maps/{MAP_ID}/versions/1"
    unconnected = [str(one) for one in document.get("unconnected", [])]
    scenes = [
        {
            "name": scene["name"],
            "drive_id": _drive_id(drives, scene.get("drive", scene["name"])),
            "scene_id": SCENE_ID,
            "connected": scene["name"] not in unconnected,
        }
        for scene in document["scenes"]
    ]
    seams = [seam for seam in document["seams"] if seam["accepted"]]
    connected = sum(scene["connected"] for scene in scenes)
    summary = MapSummary(**_figures(report), scenes=len(scenes), connected=connected, seams=len(seams))
    shown = MapVersionResource.model_validate(
        {
            "map_id": MAP_ID,
            "number": 1,
            "is_current": True,
            "name": folder.name,
            "job_id": "none",
            "summary": summary,
            "scenes": scenes,
            "unconnected": unconnected,
            "failed": [],
            "files": _resources(files, url),
            "created_at": _time_of(folder),
        }
    )
    whole = MapResource(id=MAP_ID, name=folder.name, current_version=1, version=shown, created_at=_time_of(folder))

    @app.get("/v1/maps")
    def list_maps() -> JSONResponse:
        return _page([whole.model_dump(mode="json")])

    @app.get(f"/v1/maps/{MAP_ID}")
    def get_map() -> MapResource:
        return whole

    @app.get(f"/v1/maps/{MAP_ID}/versions")
    def list_versions() -> JSONResponse:
        return _page([shown.model_dump(mode="json")])

    @app.get(url)
    def get_version() -> MapVersionResource:
        return shown

    _add_files(app, url, files)

    @app.get("/v1/scenes")
    def list_scenes() -> JSONResponse:
        return _page([])


def _add_files(app: FastAPI, url: str, files: Mapping[str, Path]) -> None:
    @app.get(f"{url}/files/{{path:path}}")
    def download(path: str) -> Response:
        return _sent(files.get(path), path)


def _add_images(app: FastAPI, drives: Sequence[DriveFolder]) -> None:
    @app.get("/v1/drives/{drive_id}/files/{path:path}")
    def download(drive_id: str, path: str) -> Response:
        drive = {f"drive-{number}": drive for number, drive in enumerate(drives)}.get(drive_id)
        return _sent(drive.folder / path if drive is not None and path in drive.images else None, path)


def _is_inside(path: str) -> bool:
    parts = PurePosixPath(path)
    return not parts.is_absolute() and ".." not in parts.parts


def _sent(file: Path | None, path: str) -> Response:
    if file is None or not file.is_file():
        raise HTTPException(404, f"there is no file {path}")
    return FileResponse(file, media_type=media_type(path), headers={"Cache-Control": "no-cache"})


def _files(folder: Path) -> dict[str, Path]:
    """Files of a result by their path in it; links out of it are none."""
    root = folder.resolve()
    found = (path for path in sorted(root.rglob("*")) if path.is_file() and path.resolve().is_relative_to(root))
    return {name: path for path in found if not (name := path.relative_to(root).as_posix()).startswith(".")}


def _resources(files: Mapping[str, Path], url: str) -> Any:
    """Files as the API shows them. What they hold is not read for this: the digest names path, size and time."""
    shown = []
    for name, path in files.items():
        state = path.stat()
        digest = sha256(f"{name} {state.st_size} {state.st_mtime_ns}".encode()).hexdigest()
        shown.append(
            {
                "path": name,
                "size_bytes": state.st_size,
                "sha256": digest,
                "media_type": media_type(name),
                "url": f"{url}/files/{quote(name)}",
            }
        )
    return shown


def _figures(report: Mapping[str, Any]) -> dict[str, Any]:
    summary = report["summary"]
    warnings = sum(finding["severity"] == "warning" for finding in report.get("findings", []))
    figures = {name: summary.get(of, 0) for name, of in _FIGURES.items()}
    return figures | {"warnings": warnings, "engine_version": str(report.get("engine_version", version("mrasfm")))}


def _drive_id(drives: Sequence[DriveFolder], name: str) -> str:
    """Id of the drive of this name."""
    numbers = [number for number, drive in enumerate(drives) if drive.name == name]
    return f"drive-{numbers[0]}" if numbers else "none"


def _page(items: Sequence[Any]) -> JSONResponse:
    return JSONResponse({"items": list(items), "next": None})


def _time_of(folder: Path) -> datetime:
    return datetime.fromtimestamp((folder / REPORT_FILE).stat().st_mtime, UTC)


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FolderViewError(f"{path} does not exist: give a folder that holds it.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise FolderViewError(f"{path} cannot be read: {error}. Write it again.") from error
    if not isinstance(document, dict):
        raise FolderViewError(f"{path} is no JSON object. Write it again.")
    return document
