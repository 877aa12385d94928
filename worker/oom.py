"""Whether the kernel has killed for lack of memory in this process's control group."""

from __future__ import annotations

import re
from pathlib import Path

_COUNT = re.compile(r"^oom_kill (\d+)$", re.MULTILINE)


def oom_kills(*, groups: Path = Path("/proc/self/cgroup"), mounts: Path = Path("/sys/fs/cgroup")) -> int | None:
    """How many processes of this control group the kernel has killed so far; None where it does not say.

    Reads both versions of control groups. In a container the group's path is often the host's: then its counts are at
    the mount's root.
    """
    try:
        lines = groups.read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number == "0":
            mount, file = mounts, "memory.events"
        elif "memory" in controllers.split(","):
            mount, file = mounts / "memory", "memory.oom_control"
        else:
            continue
        for folder in (mount / path.lstrip("/"), mount):
            count = _count(folder / file)
            if count is not None:
                return count
    return None


def _count(path: Path) -> int | None:
    try:
        found = _COUNT.search(path.read_text(encoding="utf-8"))
    except OSError:
        return None
    return int(found[1]) if found else None
