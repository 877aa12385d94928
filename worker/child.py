"""The child process of one attempt: `python -m worker.child REQUEST`.

COLMAP's checks abort their process and memory can run out: here that ends an attempt, and no worker. A result file says
how the work ended; where there is none, the exit code or the signal does.
"""

from __future__ import annotations

import faulthandler
import os
import resource
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from service.pdeathsig import end_with_parent
from worker.child_protocol import ChildRequest

EXIT_DONE = 0  # there is a result
EXIT_CRASHED = 70
EXIT_OUT_OF_MEMORY = 71
EXIT_ORPHANED = 72

_NICE = 5  # a third of the weight of what serves requests or keeps leases; all of the machine where nobody else works
_OOM_SCORE = 500  # as if half of the machine's memory more were used: the kernel's choice before any supervisor


def main(argv: Sequence[str]) -> int:
    """Do what the request asks; the exit code."""
    end_with_parent()
    request = ChildRequest.read(Path(argv[0]))
    if os.getppid() != request.parent_pid:
        return EXIT_ORPHANED  # it died before the kernel knew that this one should follow
    _be_expendable()
    _give_way()
    try:
        # The engine takes a second and 200 MB to load, and nothing above needs it.
        from worker.engine import work

        faulthandler.enable()  # on top of the handlers that COLMAP installs when it is loaded: both print their stacks
        work(request).write(request.result_file)
    except MemoryError:
        traceback.print_exc()
        return EXIT_OUT_OF_MEMORY
    except BrokenPipeError:
        return EXIT_ORPHANED
    except Exception:
        traceback.print_exc()
        return EXIT_CRASHED
    return EXIT_DONE


def _be_expendable() -> None:
    """No core dump of many gigabytes, and first in line where memory runs out."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_OOM_SCORE))


def _give_way() -> None:
    """Let the API and the worker's own processes run first where they share the machine.

    Linux may weigh sessions instead of processes, and this process leads one.
    """
    os.nice(_NICE)
    with suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(_NICE))


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # the result is written: native libraries' teardown could only spoil it
