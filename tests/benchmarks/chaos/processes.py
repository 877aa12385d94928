"""The service's processes: which there are, what each of them is, and how exactly one of them is killed."""

from __future__ import annotations

import os
import select
import signal
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

_PROC = Path("/proc")
_DEAD_WITHIN_MS = 10_000
_PARENT, _STARTED = 1, 19  # of the words of /proc/PID/stat that follow the command


class Role(StrEnum):
    """What a process of the service does."""

    SUPERVISOR = "supervisor"
    GUARD = "guard"
    BROKER = "broker"
    API = "api"  # the one that watches the others
    API_CHILD = "api child"
    API_TRACKER = "api tracker"  # multiprocessing's
    MANIFEST_READER = "manifest reader"
    CHECKER = "checker"  # the worker of drives' checks, and the process in its pool
    CHECKER_POOL = "checker pool"
    WORKER = "worker"
    WORKER_POOL = "worker pool"
    RECONCILER = "reconciler"
    ENGINE = "engine"
    STARTING = "starting"  # has not become what it shall be


@dataclass(frozen=True)
class Identity:
    """What no other process ever has: the number, and when it was started (in ticks since the machine was)."""

    pid: int
    started: int


@dataclass(frozen=True, kw_only=True)
class Process:
    """A process as it was seen."""

    identity: Identity
    parent: int
    command: tuple[str, ...]
    role: Role

    @property
    def pid(self) -> int:
        return self.identity.pid


def tree_of(root: int) -> list[Process]:
    """A supervisor and all that descend from it, parents first."""
    seen = {process.pid: process for process in _seen()}
    if root not in seen:
        return []
    found = [_as(seen.pop(root), Role.SUPERVISOR)]
    for parent in found:  # grows
        children = [process for process in seen.values() if process.parent == parent.pid]
        found += [_as(child, role_of(child.command, parent)) for child in children]
    return found


def role_of(command: Sequence[str], parent: Process) -> Role:
    """By what the process was started as, and by whom: a pool's processes have their worker's command."""
    words = set(command)
    if tuple(command) == parent.command and parent.role in (Role.CHECKER, Role.WORKER):
        return Role.CHECKER_POOL if parent.role is Role.CHECKER else Role.WORKER_POOL
    if tuple(command) == parent.command or not command:
        return Role.STARTING
    if parent.role is Role.SUPERVISOR:
        return _of_supervisor(words)
    if parent.role in (Role.CHECKER_POOL, Role.WORKER_POOL):
        return Role.ENGINE if "worker.child" in words else Role.STARTING
    if parent.role is Role.API:
        joined = " ".join(command)
        if "resource_tracker" in joined:
            return Role.API_TRACKER
        return Role.API_CHILD if "spawn_main" in joined else Role.STARTING
    return Role.MANIFEST_READER if parent.role is Role.API_CHILD else parent.role


def _of_supervisor(words: set[str]) -> Role:
    if any(word.endswith("orphan_reaper.py") for word in words):
        return Role.GUARD
    if {"service", "api"} <= words:
        return Role.API
    if {"worker", "checks"} <= words:
        return Role.CHECKER
    if {"worker", "reconstructions"} <= words:
        return Role.WORKER
    return Role.RECONCILER if {"worker", "reconciler"} <= words else Role.BROKER


def kill(process: Process) -> bool:
    """Send SIGKILL to this process and to no other, and wait for its end; whether it was there.

    The number is pinned before it is compared, so that it cannot come to mean another process in between.
    """
    try:
        descriptor = os.pidfd_open(process.pid)
    except ProcessLookupError:
        return False
    try:
        if identity_of(process.pid) != process.identity or _command_of(process.pid) != process.command:
            return False
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(descriptor, signal.SIGKILL)
        ended = select.poll()
        ended.register(descriptor, select.POLLIN)
        return bool(ended.poll(_DEAD_WITHIN_MS))
    finally:
        os.close(descriptor)


def identity_of(pid: int) -> Identity | None:
    """Of the process that has this number now; None where there is none, or only a zombie."""
    stat = _stat_of(pid)
    return None if stat is None else Identity(pid, int(stat[_STARTED]))


def left_of(data: Path, known: Sequence[Identity]) -> list[str]:
    """Processes that work for the installation in `data`, or were seen in its tree, and live; as text."""
    alive = {identity for identity in known if identity_of(identity.pid) == identity}
    left = []
    for process in _seen():
        if process.pid != os.getpid() and (process.identity in alive or _mentions(process, str(data))):
            left.append(f"{process.pid} {' '.join(process.command)}"[:300])
    return left


def holder_of(processes: Sequence[Process], *, local_port: int, remote_port: int) -> Process | None:
    """The process that has the server's end of a connection."""
    inode = _socket_between(local_port, remote_port)
    return next((process for process in processes if inode is not None and inode in _sockets_of(process.pid)), None)


def _socket_between(local_port: int, remote_port: int) -> str | None:
    for line in (_PROC / "net" / "tcp").read_text(encoding="ascii").splitlines()[1:]:
        words = line.split()
        local, remote = (int(address.rpartition(":")[2], 16) for address in words[1:3])
        if (local, remote) == (local_port, remote_port):
            return words[9]
    return None


def _sockets_of(pid: int) -> set[str]:
    found = set()
    with suppress(OSError):
        for link in (_PROC / str(pid) / "fd").iterdir():
            with suppress(OSError):
                found.add(os.readlink(link).removeprefix("socket:[").removesuffix("]"))
    return found


def _seen() -> Iterator[Process]:
    for entry in os.listdir(_PROC):
        if entry.isdecimal():
            stat = _stat_of(int(entry))
            if stat is not None:
                identity = Identity(int(entry), int(stat[_STARTED]))
                command = _command_of(identity.pid)
                yield Process(identity=identity, parent=int(stat[_PARENT]), command=command, role=Role.STARTING)


def _stat_of(pid: int) -> list[str] | None:
    try:
        stat = (_PROC / str(pid) / "stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    words = stat.rpartition(")")[2].split()
    return None if words[0] in "ZX" else words


def _command_of(pid: int) -> tuple[str, ...]:
    try:
        words = (_PROC / str(pid) / "cmdline").read_bytes().rstrip(b"\0").split(b"\0")
    except OSError:
        return ()
    return tuple(word.decode(errors="replace") for word in words if word)


def _mentions(process: Process, data: str) -> bool:
    """Whether it was started for the folder, or works in it: the broker writes a title over its command."""
    if any(data in word for word in process.command):
        return True
    folder = _PROC / str(process.pid)
    with suppress(OSError):
        if f"MRASFM_DATA_DIR={data}".encode() in (folder / "environ").read_bytes().split(b"\0"):
            return True
    with suppress(OSError):
        return os.readlink(folder / "cwd").startswith(data)
    return False


def _as(process: Process, role: Role) -> Process:
    return Process(identity=process.identity, parent=process.parent, command=process.command, role=role)
