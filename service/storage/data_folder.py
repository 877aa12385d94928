"""The folder that holds one installation's state: private to its owner, used by one `mrasfm standalone` at a time."""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from schemas.artifacts import CHECKPOINT_FOLDER
from schemas.file_names import is_ignored

LOCK_FILE = "standalone.lock"
DATABASE_FILE = "mrasfm.sqlite3"
# Folders of the state, which may have been restored without the other files, and that of a new disk.
FOLDERS = frozenset(
    {"artifacts", "broker", "logs", "lost+found", "metrics", "scratch", "spool", "temporary", "uploads"}
)
# What an earlier run left behind is killed within milliseconds of its supervisor's death, but not at once.
LOCK_TIMEOUT_S = 10.0
LOCK_POLL_S = 0.1


class DataFolderError(Exception):
    """The folder cannot be used; the message says why and what to do."""


def require_data_folder(folder: Path) -> None:
    """Refuse a folder with other files and without the state of a service, which would lie among them.

    Hidden files, and those that a file manager leaves, make no folder somebody's.

    Raises
    ------
    DataFolderError
        That names one of the files, or where the folder cannot be listed.
    """
    with _explained(folder):
        names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if LOCK_FILE in names or DATABASE_FILE in names:
        return
    shown = {name for name in names if not name.startswith(".") or name == CHECKPOINT_FOLDER}
    foreign = min((name for name in shown - FOLDERS if not is_ignored(name)), default=None)
    if foreign is not None:
        raise DataFolderError(
            f"{folder.resolve()} holds no state of a service, but other files, such as {foreign}. Give --data and a "
            "new or empty folder, or the one that mrasfm standalone was started with."
        )


def make_private_folder(folder: Path) -> None:
    """Make a folder that only its owner may enter; one that is there already is narrowed to that.

    Raises
    ------
    DataFolderError
        Where it cannot be made or written, or belongs to somebody else.
    """
    with _explained(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)


def write_state_file(path: Path, text: str) -> None:
    """As `write_private_file`, in a data folder.

    Raises
    ------
    DataFolderError
        Where it cannot be written.
    """
    with _explained(path.parent):
        write_private_file(path, text)


def write_private_file(path: Path, text: str) -> None:
    """Write a file that only its owner may read, whole or not at all."""
    scratch = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    descriptor = os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(path)
    except BaseException:
        scratch.unlink(missing_ok=True)
        raise


@contextmanager
def exclusive_use(folder: Path, *, timeout_s: float = LOCK_TIMEOUT_S) -> Iterator[int]:
    """Hold the folder for this process and the children that inherit the descriptor.

    The lock ends with the last process that has the descriptor open. So a new run never starts beside what an
    earlier one, killed a moment ago, left behind: two brokers appending to one file would destroy it.

    Yields
    ------
    int
        The descriptor of the lock file, for `pass_fds`.

    Raises
    ------
    DataFolderError
        Where another run, or a process that one left behind, still has the folder after `timeout_s`, or where the
        lock cannot be written.
    """
    with _explained(folder):
        descriptor = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        with _explained(folder):
            _wait_for_lock(descriptor, folder, timeout_s)
            os.truncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        yield descriptor
    finally:
        os.close(descriptor)


def _wait_for_lock(descriptor: int, folder: Path, timeout_s: float) -> None:
    deadline_s = time.monotonic() + timeout_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError as error:
            if time.monotonic() < deadline_s:
                time.sleep(LOCK_POLL_S)
                continue
            holder = os.pread(descriptor, 32, 0).decode("ascii", "replace").strip() or "unknown"
            raise DataFolderError(
                f"the data folder {folder} is in use by another `mrasfm standalone` (process {holder}). "
                "Stop that one, or give another folder with --data."
            ) from error


@contextmanager
def _explained(folder: Path) -> Iterator[None]:
    """Errors of the file system as errors that say what to do."""
    try:
        yield
    except OSError as error:
        remedy = "Give a folder that belongs to you with --data, or correct its owner."
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            remedy = "Make room on its disk, or give a folder on another one with --data."
        raise DataFolderError(f"the data folder {folder} cannot be used: {error.strerror}. {remedy}") from error
