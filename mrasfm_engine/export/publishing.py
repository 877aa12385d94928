"""Puts a folder of results in place whole or not at all."""

from __future__ import annotations

import errno
import fcntl
import glob
import json
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from mrasfm_engine.errors import InputError, StorageError, storage_error
from schemas.artifacts import CHECKPOINT_FOLDER, REPORT_FILE
from schemas.file_names import MANIFEST_NAME, is_ignored

COMPLETE_MARK = REPORT_FILE
LEFTOVER_AGE_S = 3600.0
SCRATCH_PREFIX = ".scratch-"
MOST_REMOVED = 100  # times that other runs remove a folder before it is locked
LOCK = "lock"  # in a scratch folder, held while its run lives


@contextmanager
def publishing(
    out: Path, needed_bytes: int, *, replaced: Sequence[str] | Callable[[], Sequence[str]] = ()
) -> Iterator[Path]:
    """A temporary folder whose content replaces that of `out` when the `with` block ends well.

    A new folder appears at once; into an existing one the files move one by one, its old `report.json` goes first and
    the new one comes last. Other files in it are kept. Of two runs into one folder, the later one replaces the other's
    result as a whole.

    Parameters
    ----------
    replaced
        Names that an older result may have left in `out`: they go where the new one does not have them. A function is
        called just before anything moves, and may refuse to replace what has come to be there by raising.

    Raises
    ------
    StorageError
        Where the disk is full or cannot be written.
    """
    out = out.resolve()
    try:
        # Inside an existing folder, because that may be another file system than its parent.
        home = out if out.is_dir() else out.parent
        _prepare(needed_bytes, out, home)
        work = home / f".{out.name}.partial-{os.getpid()}-{secrets.token_hex(4)}"
        work.mkdir()
        try:
            with _held(work):
                yield work
            if not _appears(work, out):
                with while_nothing_moves(out):
                    _put_in_place(work, out, replaced() if callable(replaced) else replaced)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        remedy = "Free space on this disk, or choose a folder that can be written."
        raise StorageError(f"{out} cannot be written: {error.strerror or error}", remedy=remedy) from error


def require_free(out: Path, *, result: str) -> None:
    """Refuse a file, a drive, and a folder with files in which no result was made before.

    A folder with a result, or with finished stages of a run that was interrupted, is that result's, whatever else lies
    in it. Hidden files alone, and those that a file manager leaves, make no folder somebody's.

    Parameters
    ----------
    result
        The kind of result, for the message: `scene` or `map`.

    Raises
    ------
    InputError
        That names one of them.
    """
    remedy = f"Give the {result} a new or empty folder with --out."
    there = next((path for path in (out, *out.parents) if os.path.lexists(path)), out)
    if os.path.lexists(there) and not there.is_dir():
        raise InputError(f"{there} is a file, and no folder for a {result}", remedy=remedy, code="bad-out-folder")
    if (out / MANIFEST_NAME).is_file():
        raise InputError(
            f"{out} is the folder of a drive, whose files a {result} would lie among",
            remedy=remedy,
            code="bad-out-folder",
        )
    if _holds_result(out) or (out / CHECKPOINT_FOLDER).is_dir():
        return
    shown = (path for path in out.glob("*") if not path.name.startswith("."))
    foreign = min((path for path in shown if not is_ignored(path.name)), default=None)
    if foreign is not None:
        raise InputError(
            f"{foreign} was made by no {result}, and the files of a {result} would lie among what is in {out}",
            remedy=remedy,
            code="bad-out-folder",
        )


def _holds_result(folder: Path) -> bool:
    """Return whether the report in a folder is that of a scene or map, and not another program's."""
    try:
        return "registered_units" in json.loads((folder / COMPLETE_MARK).read_bytes())["summary"]
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return False


@contextmanager
def while_nothing_moves(out: Path) -> Iterator[None]:
    """Keep other runs from moving their results into `out`: until they have, what is there is no whole result.

    The lock is that of `out` alone: whoever runs this may hold the folder around it. Nothing moves one by one into a
    folder that is not there.
    """
    with _held(out.resolve(), wait=True):
        yield


@contextmanager
def only_run(out: Path) -> Iterator[None]:
    """Keep other runs from making a result in `out` meanwhile; a killed process gives the folder up.

    The lock is that of the folder of finished stages, which goes away where it stays empty.

    Raises
    ------
    InputError
        Where another run is at it.
    StorageError
        Where the folder cannot be made.
    """
    stages = out / CHECKPOINT_FOLDER
    made = [path for path in (stages, *stages.parents) if not path.exists()]
    with ExitStack() as stack:
        _lock_stages(stages, stack)
        try:
            yield
        finally:
            with suppress(OSError):  # not empty
                for path in made:
                    path.rmdir()


def _lock_stages(stages: Path, stack: ExitStack) -> None:
    removed = 0
    while True:
        try:
            stages.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(stages, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            # A run that ends has just removed it; or none can be made there, as in a folder that was deleted.
            removed += 1
            if isinstance(error, FileNotFoundError) and removed < MOST_REMOVED:
                continue
            raise storage_error(stages, error) from error
        stack.callback(os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"another run is making a result in {stages.parent}",
                remedy="Wait until it has ended, or give another folder with --out.",
                code="output-in-use",
            ) from None
        except OSError:  # a file system without locks
            return
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), stages.stat()):
                return


@contextmanager
def _held(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold a folder's lock, which a killed process gives up.

    A file system without locks has none to hold, and a folder that cannot be listed cannot be locked.
    """
    with ExitStack() as stack:
        with suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield


def _is_held(folder: Path) -> bool:
    """Return whether a run that lives holds a folder's lock."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False


@contextmanager
def scratch_folder(out: Path) -> Iterator[Path]:
    """An empty folder inside `out`, on its disk, that is gone when the `with` block ends; those of killed runs go too.

    Raises
    ------
    StorageError
        Where it cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        _remove_scratch(out)
        scratch = Path(tempfile.mkdtemp(prefix=SCRATCH_PREFIX, dir=out))
    except OSError as error:
        raise storage_error(out, error) from error
    try:
        with ExitStack() as stack:
            try:
                stack.enter_context(_locked(scratch))
                files = scratch / "files"
                files.mkdir()
            except OSError as error:
                raise storage_error(out, error) from error
            yield files
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def _locked(scratch: Path) -> Iterator[None]:
    """Hold the lock of a scratch folder; a killed process gives it up."""
    new = scratch / f"new {LOCK}"
    with new.open("wb") as lock:
        with suppress(OSError):  # a file system without locks: nobody else gets this one there, either
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        new.rename(scratch / LOCK)  # it has its name only when it is held
        yield


def _remove_scratch(out: Path) -> None:
    """Remove scratch folders whose run lives no more, and old ones that were killed before they had a lock."""
    for scratch in out.glob(f"{SCRATCH_PREFIX}*"):
        try:
            with (scratch / LOCK).open("r+b") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(scratch, ignore_errors=True)
        except FileNotFoundError:
            _remove_if_old(scratch)
        except OSError:  # a run that lives holds it
            continue


def _remove_leftovers(folder: Path, pattern: str) -> None:
    for leftover in folder.glob(pattern):
        if not _is_held(leftover):
            _remove_if_old(leftover)


def _remove_if_old(folder: Path) -> None:
    with suppress(FileNotFoundError):  # another run may remove it meanwhile
        if time.time() - folder.stat().st_mtime > LEFTOVER_AGE_S:
            shutil.rmtree(folder, ignore_errors=True)


def _prepare(needed: int, out: Path, home: Path) -> None:
    """Make the folder to work in, clear what killed runs left there, and see that the files will fit."""
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "it is a file, not a folder")
    home.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(home, f".{glob.escape(out.name)}.partial-*")
    require_space(needed, home, what=out)


def require_space(needed_bytes: int, folder: Path, *, what: Path) -> None:
    """Refuse to write what does not fit on the disk of a folder; the message names `what`.

    Raises
    ------
    StorageError
        Where there is less space.
    """
    free = shutil.disk_usage(folder).free
    if free < needed_bytes:
        raise StorageError(
            f"{what} needs about {needed_bytes / 1e6:.0f} MB and its disk has {free / 1e6:.0f} MB free",
            remedy="Free space on this disk, or choose another folder.",
        )


def _appears(work: Path, out: Path) -> bool:
    """Move the folder to where nothing is; False where there is something, also since just now."""
    if out.exists():
        return False
    try:
        work.rename(out)
    except OSError as problem:
        if problem.errno in (errno.ENOTEMPTY, errno.EEXIST):
            return False
        raise
    return True


def _put_in_place(work: Path, out: Path, replaced: Sequence[str]) -> None:
    items = sorted(work.iterdir(), key=lambda item: item.name == COMPLETE_MARK)
    moved: list[tuple[Path, Path]] = []  # from, to

    def move(source: Path, target: Path) -> None:
        source.rename(target)
        moved.append((source, target))

    try:
        if (out / COMPLETE_MARK).exists():
            move(out / COMPLETE_MARK, work / f"old-{COMPLETE_MARK}")
        # An older result's that this one does not have: it would be taken for this one's.
        for name in replaced:
            if (out / name).exists() and not (work / name).exists():
                move(out / name, work / f"old-{name}")
        for item in items:
            target = out / item.name
            if target.exists():
                move(target, work / f"old-{item.name}")
            move(item, target)
    except BaseException:  # what was there is there again
        for source, target in reversed(moved):
            target.rename(source)
        raise
