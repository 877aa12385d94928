"""The run's figures, and which of them are out of bounds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tests.benchmarks.chaos.checks import Findings, Shown
from tests.benchmarks.chaos.conversation import Board
from tests.benchmarks.chaos.ledger import Ledger
from tests.benchmarks.chaos.records import Records
from tests.benchmarks.chaos.victims import Killer, counted, has_ended_a_publication, histogram, shares_of

# A POST whose process was killed can be repeated under its key once the service believes that process dead.
MOST_HELD_S = 30.0
_LINES = 20  # of each kind of finding


def figures_of(
    *, wanted: int, killer: Killer, board: Board, ledger: Ledger, records: Records, shown: Shown, findings: Findings
) -> dict[str, Any]:
    """All of a run's figures.

    Parameters
    ----------
    wanted
        Kills that were asked for.
    """
    kills, restarts_s = killer.kills, killer.restarts_s
    shares, done = shares_of(wanted), counted(kills, records)
    jobs = shown.jobs.values()
    return {
        "kills": len(kills),
        "kills_in_fact": {purpose.value: count for purpose, count in done.items()},
        "publications_that_kills_ended": sum(has_ended_a_publication(kill, records) for kill in kills),
        "kills_missing": {
            purpose.value: shares[purpose] - count for purpose, count in done.items() if count < shares[purpose]
        },
        "victims": histogram(kills),
        "restarts": len(restarts_s),
        "slowest_restart_s": round(max(restarts_s, default=0.0), 1),
        "ended_by_itself": killer.ended_by_itself,
        "drives_accepted": len(ledger.drives),
        "jobs_accepted": _counts(job.kind for job in ledger.jobs.values()),
        "jobs": _counts(f"{job['kind']} {job['state']}" for job in jobs),
        "attempts_of_a_job": _counts(len(job["attempts"]) for job in jobs),
        "outcomes_of_attempts": _counts(attempt["outcome"] for job in jobs for attempt in job["attempts"]),
        "scenes": len(shown.scenes),
        "maps": len(shown.maps),
        "requests": board.outcomes,
        "longest_held_s": round(board.longest_held_s, 1),
        "broken_promises": _bounded(ledger.broken_promises),
        **{name: len(lines) for name, lines in vars(findings).items()},
        "findings": {name: _bounded(lines) for name, lines in vars(findings).items() if lines},
    }


def out_of_bounds(figures: Mapping[str, Any], *, wanted: int) -> list[str]:
    """Names of the figures that keep a run with so many kills from passing."""
    bad = [name for name in (*vars(Findings()), *_EMPTY) if figures[name]]
    bad += ["kills"] if figures["kills"] < wanted else []
    bad += ["longest_held_s"] if figures["longest_held_s"] > MOST_HELD_S else []
    return bad


_EMPTY = ("kills_missing", "ended_by_itself", "broken_promises")


def table(victims: Mapping[str, Mapping[str, int]]) -> str:
    """The histogram of victims as text."""
    lines = ["killed, and what was under way:"]
    for role, works in victims.items():
        lines.append(f"{sum(works.values()):5d} {role}")
        lines += [f"{count:11d} {work}" for work, count in works.items()]
    return "\n".join(lines)


def _counts(values: Iterable[object]) -> dict[str, int]:
    return {str(value): count for value, count in Counter(values).most_common()}


def _bounded(lines: Sequence[str]) -> list[str]:
    more = [f"and {len(lines) - _LINES} more"] if len(lines) > _LINES else []
    return [*lines[:_LINES], *more]
