"""Gets a published model, when asked to, and keeps it only if it is the one that was published."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.request
from pathlib import Path
from tempfile import TemporaryDirectory

from mrasfm_engine.errors import InputError, StorageError
from mrasfm_engine.learned.catalogue import KnownModel
from mrasfm_engine.learned.model_folder import InstalledModel, ModelFolder, how_to_get
from mrasfm_engine.learned.onnx_file import read_model, sha256_of
from mrasfm_engine.types import CountProgress

TIMEOUT_S = 30.0
CHUNK_BYTES = 1 << 20
MAX_BYTES = 1 << 30  # no model of the catalogue comes near; a wrong answer shall not fill the disk


def pull(
    model: KnownModel, folder: ModelFolder, *, progress: CountProgress = lambda done, total: None
) -> InstalledModel:
    """Download a model into the folder; where it is there already nothing is asked of the network.

    Parameters
    ----------
    progress
        Called with the bytes so far and in all, 0 where the server does not say.

    Raises
    ------
    InputError
        Where the model is not published, cannot be reached, or what comes is not what was published.
    StorageError
        Where the folder cannot be written.
    """
    there = folder.find(model.name)
    if there is not None and there.is_published and _is_whole(there):
        return there
    if model.url is None or model.sha256 is None:
        raise InputError(f"{model.name} cannot be pulled", remedy=how_to_get(model.name), code="not-published")
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".pull-", dir=folder.path) as work:
            file = Path(work) / "model.onnx"
            _download(model, model.url, file, progress)
            return folder.add_data(_verified(model, file), model.name, what=model.url)
    except OSError as error:
        raise StorageError(
            f"{model.name} cannot be written to {folder.path}: {error.strerror}", remedy="Free space there."
        ) from error


def _download(model: KnownModel, url: str, file: Path, progress: CountProgress) -> None:
    try:
        response = urllib.request.urlopen(url, timeout=TIMEOUT_S)
    except urllib.error.HTTPError as error:
        error.close()
        raise _unreachable(model, f"the server answers {error.code}") from error
    except (urllib.error.URLError, http.client.HTTPException, OSError) as error:
        raise _unreachable(model, str(getattr(error, "reason", error)), offline=True) from error
    with response, file.open("wb") as out:
        total, done = int(response.headers.get("Content-Length") or 0), 0
        while chunk := _read(model, response):
            done += len(chunk)
            if done > MAX_BYTES:
                raise _unreachable(model, f"it sends more than {MAX_BYTES} bytes")
            out.write(chunk)
            progress(done, total)


def _read(model: KnownModel, response: http.client.HTTPResponse) -> bytes:
    # Apart from writing: where the connection breaks the disk is not at fault.
    try:
        return response.read(CHUNK_BYTES)
    except (http.client.HTTPException, OSError) as error:
        raise _unreachable(model, f"the connection broke ({error or type(error).__name__})") from error


def _verified(model: KnownModel, file: Path) -> bytes:
    found = sha256_of(file.read_bytes())
    if found != model.sha256:
        raise InputError(
            f"what {model.url} sends is not {model.name}: SHA-256 {model.sha256} is expected, {found} was found",
            remedy="Nothing was kept. Try again; a proxy or a sign-in page may have answered in its place.",
            code="bad-model",
        )
    return read_model(file)


def _is_whole(model: InstalledModel) -> bool:
    try:
        return sha256_of(read_model(model.file)) == model.sha256
    except InputError:
        return False


def _unreachable(model: KnownModel, why: str, *, offline: bool = False) -> InputError:
    return InputError(
        f"{model.name} cannot be pulled from {model.url}: {why}",
        remedy=f"{'This machine seems to be offline. ' if offline else ''}"
        f"Get the file elsewhere and run mrasfm models add FILE --name {model.name}.",
        code="offline" if offline else "pull-failed",
    )
