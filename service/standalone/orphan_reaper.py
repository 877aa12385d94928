"""Kills a supervisor's process groups when the supervisor is gone.

A program of its own, `python -I -S orphan_reaper.py [PGID ...]`, because only another process outlives a SIGKILL. The
groups of its command line it knows before the supervisor can tell it anything: one that takes the place of another
never runs without them. Its standard input is a pipe that the supervisor alone writes to: `+PGID` and `-PGID`, one a
line. The kernel closes the pipe when the supervisor ends, however it ends. Knows nothing but the standard library and
starts in a few milliseconds.
"""

import os
import signal
import sys


def main() -> None:
    """Follow the supervisor until it ends, then kill what is left of its groups."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # sent to a whole control group, these are the supervisor's to handle
    groups = {int(group) for group in sys.argv[1:]}
    for line in sys.stdin:
        group = int(line[1:])
        if line.startswith("+"):
            groups.add(group)
        else:
            groups.discard(group)
    for group in groups:
        try:
            os.killpg(group, signal.SIGKILL)
        except (ProcessLookupError, PermissionError):
            continue


if __name__ == "__main__":
    main()
