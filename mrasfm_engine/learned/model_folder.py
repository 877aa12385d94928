"""The folder that models lie in: what is there, what is taken in, what is refused.

| file | what |
|---|---|
| `NAME.json` | the record of a model; a model is there when its record is |
| `NAME-HASH.onnx` | its bytes, named after their hash, so that record and bytes change in one step |
"""

from __future__ import annotations

import json
import os
import re
import secrets
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mrasfm_engine.errors import InputError, StorageError
from mrasfm_engine.learned import catalogue
from mrasfm_engine.learned.catalogue import KnownModel, by_sha256, known_model
from mrasfm_engine.learned.network import Network
from mrasfm_engine.learned.onnx_file import read_model, sha256_of
from mrasfm_engine.learned.signatures import Signature

FOLDER_VARIABLE = "MRASFM_MODELS"
NAME_PATTERN = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
HASH_DIGITS = 16  # of the file name; the record has all
OWN_LICENCE = "that of the file"


@dataclass(frozen=True, kw_only=True)
class InstalledModel:
    """A model that is in the folder."""

    name: str
    known: KnownModel  # what it is used as
    sha256: str
    file: Path

    @property
    def is_published(self) -> bool:
        """The file is bit for bit the one that the catalogue names."""
        return self.sha256 == self.known.sha256

    @property
    def licence(self) -> str:
        """The catalogue's; for another file of the same signature it cannot be known."""
        return self.known.licence if self.is_published or not self.known.is_published else OWN_LICENCE

    @property
    def commercial_use(self) -> bool | None:
        """The licence allows commercial use; None where that is not known."""
        return self.known.commercial_use if self.is_published or not self.known.is_published else None


def default_folder(
    environment: Mapping[str, str] = os.environ, platform: str = sys.platform, home: Path | None = None
) -> Path:
    """`MRASFM_MODELS`, else where the platform keeps a user's data."""
    if chosen := environment.get(FOLDER_VARIABLE):
        return Path(chosen)
    home = Path.home() if home is None else home
    if platform == "win32":
        data = Path(environment.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif platform == "darwin":
        data = home / "Library" / "Application Support"
    else:
        # The convention ignores relative paths.
        given = Path(environment.get("XDG_DATA_HOME", ""))
        data = given if given.is_absolute() else home / ".local" / "share"
    return data / "mrasfm" / "models"


class ModelFolder:
    """Models on disk. Nothing is written before something is added."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def installed(self) -> list[InstalledModel]:
        """All models with a record, by name; damaged records are left out."""
        found = []
        for record in sorted(self.path.glob("*.json")) if self.path.is_dir() else []:
            try:
                found.append(self._read(record))
            except (OSError, ValueError, KeyError, TypeError, InputError):
                continue
        return found

    def find(self, name: str) -> InstalledModel | None:
        """The model of this name, None where it is not there."""
        return next((model for model in self.installed() if model.name == name), None)

    def load(self, name: str) -> tuple[InstalledModel, bytes]:
        """A model and its bytes, as they were when it was added.

        Raises
        ------
        InputError
            Where it is not there, or its file was changed.
        """
        model = self.find(name)
        if model is None:
            raise InputError(f"model {name} is not in {self.path}", remedy=how_to_get(name), code="missing-model")
        data = read_model(model.file)
        if sha256_of(data) != model.sha256:
            raise InputError(
                f"model {name} was changed: SHA-256 {model.sha256} was recorded, {sha256_of(data)} is in {model.file}",
                remedy="Add it again with mrasfm models add.",
                code="bad-model",
            )
        return model, data

    def add(self, file: Path, name: str | None = None) -> InstalledModel:
        """Take a copy of a model's file.

        Parameters
        ----------
        name
            One of the catalogue's, or one of the user's own; that of the model that it is found to be if None.

        Raises
        ------
        InputError
            Where the file is no model that is known by its hash or signature, is another than `name` says, or cannot be
            run here.
        StorageError
            Where the folder cannot be written.
        """
        data = read_model(file)
        return self.add_data(data, name, what=str(file))

    def add_data(self, data: bytes, name: str | None, *, what: str) -> InstalledModel:
        """As `add`, for a model's bytes; `what` names them in messages."""
        if name is not None and not NAME_PATTERN.fullmatch(name):
            raise InputError(
                f"{name!r} is no name for a model",
                remedy="Use small letters, digits, dots and dashes.",
                code="bad-name",
            )
        sha256 = sha256_of(data)
        known = _recognise(data, sha256, name, what)
        if name is None and known.is_published and known.sha256 != sha256:
            raise InputError(
                f"{what} has the signature of {known.name}, and is not the file that is published under that name",
                remedy="Give it a name of its own with --name.",
                code="bad-name",
            )
        model = InstalledModel(
            name=name or known.name,
            known=known,
            sha256=sha256,
            file=self.path / f"{name or known.name}-{sha256[:HASH_DIGITS]}.onnx",
        )
        self._write(model, data)
        return model

    def _read(self, record: Path) -> InstalledModel:
        document = json.loads(record.read_text(encoding="utf-8"))
        name, sha256 = str(document["name"]), str(document["sha256"])
        if name != record.stem or not NAME_PATTERN.fullmatch(name):
            raise ValueError(name)
        file = self.path / f"{name}-{sha256[:HASH_DIGITS]}.onnx"
        return InstalledModel(name=name, known=known_model(str(document["model"])), sha256=sha256, file=file)

    def _write(self, model: InstalledModel, data: bytes) -> None:
        record: dict[str, Any] = {"name": model.name, "model": model.known.name, "sha256": model.sha256}
        before = self.find(model.name)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            _replace(model.file, data)
            _replace(self.path / f"{model.name}.json", json.dumps(record, indent=1).encode() + b"\n")
            if before is not None and before.file != model.file:
                before.file.unlink(missing_ok=True)
        except OSError as error:
            raise StorageError(
                f"model {model.name} cannot be written to {self.path}: {error.strerror}",
                remedy=f"Free space, or set {FOLDER_VARIABLE} to a folder that can be written.",
            ) from error


def how_to_get(name: str) -> str:
    """Remedy for a missing model."""
    known = next((model for model in catalogue.known_models() if model.name == name), None)
    if known is None:
        return "`mrasfm models list` shows what is there; `mrasfm models add FILE --name NAME` adds one."
    if known.url is not None:
        return f"Run mrasfm models pull {name}."
    return f"Get it ({known.source}) and run mrasfm models add FILE --name {name}."


def _recognise(data: bytes, sha256: str, name: str | None, what: str) -> KnownModel:
    """Find the model of the catalogue that these bytes are or can stand for."""
    published = by_sha256(sha256)
    named = next((model for model in catalogue.known_models() if model.name == name), None)
    if named is not None and named.is_published and published is not named:
        raise InputError(
            f"{what} is not {name}: SHA-256 {named.sha256} is expected, {sha256} was found",
            remedy=f"Get it from its source ({named.source}), or give your own file another name.",
            code="bad-model",
        )
    # By hash alone a model would be accepted that this runtime cannot run.
    signature = Network(name or what, data, gpu=False).signature
    candidates = (
        [named] if named is not None else [published] if published is not None else list(catalogue.known_models())
    )
    fitting = [model for model in candidates if not model.signature.mismatches(signature)]
    if not fitting:
        raise _unlike(what, candidates, signature)
    return fitting[0]


def _unlike(what: str, candidates: list[KnownModel], found: Signature) -> InputError:
    nearest = min(candidates, key=lambda model: len(model.signature.mismatches(found)))
    problems = "; ".join(nearest.signature.mismatches(found))
    return InputError(
        f"{what} does not have the signature of {nearest.name}, {nearest.signature}: {problems}",
        remedy=f"Export it with these inputs and outputs ({nearest.source}).",
        code="bad-model",
    )


def _replace(path: Path, data: bytes) -> None:
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
