"""The service under SIGKILL: `python -m tests.benchmarks.chaos` kills its processes at random while clients use it.

Starts `mrasfm standalone` with everything that belongs to it, and clients that send drives, ask for scenes and maps and
repeat what is not answered. Afterwards everything that was accepted must be there once, byte for byte. Prints the seed
and its figures as JSON, on standard error the kills and who was killed, and exits with 1 where a figure is out of
bounds.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import httpx

from tests.benchmarks.chaos.installation import DidNotStartError
from tests.benchmarks.chaos.run import Limits, Run


def main(argv: list[str] | None = None) -> int:
    """Kill, wait, check, print."""
    parser = argparse.ArgumentParser(
        prog="chaos", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=200, help="how many (default: %(default)s)")
    parser.add_argument("--seed", type=int, help="of what is killed, and of what the clients do (default: another one)")
    parser.add_argument("--minutes", type=float, default=60.0, help="for the kills at most (default: %(default)s)")
    parser.add_argument("--pause-s", type=float, default=4.0, help="between kills, on average (default: %(default)s)")
    parser.add_argument(
        "--drain-minutes", type=float, default=10.0, help="after the last kill: what has not ended then is stuck"
    )
    parser.add_argument("--keep", type=Path, metavar="DIR", help="where the service's folder is kept, with its logs")
    arguments = parser.parse_args(argv)
    if arguments.kills < 1:
        parser.error("--kills must be at least 1")
    seed = random.SystemRandom().randrange(2**31) if arguments.seed is None else arguments.seed
    limits = Limits(
        kills=arguments.kills,
        kill_s=arguments.minutes * 60,
        drain_s=arguments.drain_minutes * 60,
        pause_s=arguments.pause_s,
    )
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # so that nothing is left running
    print(f"seed {seed}", file=sys.stderr, flush=True)
    folder = Path(tempfile.mkdtemp(prefix="chaos-")).resolve()
    try:
        figures = Run(folder, seed, limits).measure()
    except (DidNotStartError, httpx.HTTPError) as error:
        print(f"chaos: the service cannot be checked: {error}", file=sys.stderr)
        return 1
    finally:
        if arguments.keep is not None:
            shutil.move(folder, arguments.keep)
        shutil.rmtree(folder, ignore_errors=True)
    print(json.dumps(figures, indent=1))
    return 0 if figures["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
