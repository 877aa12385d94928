"""The kernel's count of kills for lack of memory around this process."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

_COUNT = re.compile(r"^oom_kill (\d+)$", re.MULTILINE)
_PROC = Path("/proc")
_MOUNTS = Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class MemoryKills:
    """The kernel's count of processes that it killed for lack of memory, at one moment.

    Attributes
    ----------
    counter
        Which counter that is: another control group, and the same one after the machine started again, count anew.
    count
        Since the counter began.
    """

    counter: str
    count: int

    def since(self, before: MemoryKills | None) -> int | None:
        """Number of kills since an earlier count; None where that is another counter's, or is not known."""
        if before is None or before.counter != self.counter or before.count > self.count:
            return None
        return self.count - before.count

    def write(self, path: Path) -> None:
        """Leave the count for whoever finds this process dead.

        Raises
        ------
        OSError
            Where it cannot be written.
        """
        path.write_text(json.dumps(asdict(self)), encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> MemoryKills | None:
        """Read the count that `write` left; None where it did not come so far."""
        with suppress(OSError, ValueError, TypeError):
            found = cls(**json.loads(path.read_text(encoding="utf-8")))
            if isinstance(found.counter, str) and isinstance(found.count, int):
                return found
        return None


def memory_kills(*, proc: Path = _PROC, mounts: Path = _MOUNTS) -> MemoryKills | None:
    """The count of this process's control group; without one, that of the machine; None where the kernel has neither.

    Reads both versions of control groups. In a container the group's path is often the host's: then its counts are at
    the mount's root.
    """
    for path in (*_group_files(proc, mounts), proc / "vmstat"):
        count = _count(path)
        if count is not None:
            return MemoryKills(f"{_boot(proc)}:{path.stat().st_dev}:{path.stat().st_ino}", count)
    return None


def kills_since(before: MemoryKills | None) -> int | None:
    """Number of kills since then; None where the kernel does not say."""
    now = memory_kills()
    return None if now is None else now.since(before)


def _group_files(proc: Path, mounts: Path) -> list[Path]:
    try:
        lines = (proc / "self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    files = []
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number == "0":
            mount, name = mounts, "memory.events"
        elif "memory" in controllers.split(","):
            mount, name = mounts / "memory", "memory.oom_control"
        else:
            continue
        files += [folder / name for folder in (mount / path.lstrip("/"), mount)]
    return files


def _boot(proc: Path) -> str:
    try:
        return (proc / "sys/kernel/random/boot_id").read_text(encoding="utf-8").strip()
    except OSError:
        return "unknown"


def _count(path: Path) -> int | None:
    try:
        found = _COUNT.search(path.read_text(encoding="utf-8"))
    except OSError:
        return None
    return int(found[1]) if found else None
