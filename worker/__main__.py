"""`python -m worker COMMAND`: the workers' commands without loading those of other packages."""

from __future__ import annotations

import argparse
import sys

from worker.commands import reconciler, worker


def main() -> int:
    """Run one command."""
    parser = argparse.ArgumentParser(prog="python -m worker")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in (worker, reconciler):
        module.register(subparsers)
    arguments = parser.parse_args()
    return int(arguments.run(arguments))


if __name__ == "__main__":
    sys.exit(main())
