"""One run from its first start to its figures."""

from __future__ import annotations

import random
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from tests.benchmarks.chaos import checks
from tests.benchmarks.chaos.checks import Findings, Shown
from tests.benchmarks.chaos.drives import RenderedPair
from tests.benchmarks.chaos.installation import Installation
from tests.benchmarks.chaos.processes import left_of
from tests.benchmarks.chaos.records import Records
from tests.benchmarks.chaos.report import figures_of, out_of_bounds, table
from tests.benchmarks.chaos.traffic import Traffic
from tests.benchmarks.chaos.victims import Kill, Killer

COLLECTED_WITHIN_S = 120.0  # what the service keeps for a while, once that while is over
GONE_WITHIN_S = 10.0
_AGED_S = 25 * 3600
_OURS_IN_TEMPORARY = "mrasfm*"


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How many kills, and how long everything may take."""

    kills: int
    kill_s: float
    drain_s: float
    pause_s: float


class Run:
    """A service in a folder of its own, its clients, and what kills it."""

    def __init__(self, folder: Path, seed: int, limits: Limits) -> None:
        self._seed, self._limits = seed, limits
        self._temporary_before = _temporary()
        self._pair = RenderedPair(folder / "rendered")
        self._installation = Installation(folder, random.Random(f"{seed} installation"))
        self._records = Records(self._installation.data)
        self._findings = Findings()

    def measure(self) -> dict[str, Any]:
        """Kill, wait and check; the figures.

        Raises
        ------
        DidNotStartError, httpx.HTTPError
            Where there is no service any more that could be checked.
        """
        try:
            self._installation.start()
            return self._measured()
        finally:
            self._installation.kill()
            end_s = time.monotonic() + GONE_WITHIN_S  # what it started ends with it, but not at once
            while left_of(self._installation.data, []) and time.monotonic() < end_s:
                time.sleep(0.1)

    def _measured(self) -> dict[str, Any]:
        limits, installation = self._limits, self._installation
        traffic = Traffic(installation.url, installation.key, self._pair, self._seed)
        rng = random.Random(f"{self._seed} kills")
        killer = Killer(installation, traffic.board, rng, pause_s=limits.pause_s)
        began_s = time.monotonic()

        def tell(done: Kill) -> None:
            elapsed_s, count = time.monotonic() - began_s, len(killer.kills)
            _say(f"[{elapsed_s:6.1f} s] {count:3d} {done.purpose}: {done.role} ({done.under_way})")

        try:
            traffic.start()
            killer.run(limits.kills, until_s=began_s + limits.kill_s, meanwhile=traffic.tend, tell=tell)
            killed_s = time.monotonic()
            self._drain(traffic, killer)
            drained_s = time.monotonic()
        finally:
            traffic.abandon()
        shown = self._check_service(traffic)
        kept = self._check_stopped(traffic, killer)
        figures = figures_of(
            wanted=limits.kills,
            killer=killer,
            board=traffic.board,
            ledger=traffic.ledger,
            records=self._records,
            shown=shown,
            findings=self._findings,
        )
        _say(table(figures["victims"]))
        bad = out_of_bounds(figures, wanted=limits.kills)
        return {
            "seed": self._seed,
            "kill_minutes": round((killed_s - began_s) / 60, 1),
            "drained_after_s": round(drained_s - killed_s, 1),
            **figures,
            **kept,
            "out_of_bounds": bad,
            "passed": not bad,
        }

    def _drain(self, traffic: Traffic, killer: Killer) -> None:
        """Let everything end that was begun; the operator goes on to start what has ended."""
        _say("all kills are done; waiting for what was begun")
        end_s = time.monotonic() + self._limits.drain_s
        while time.monotonic() < end_s:
            killer.operate()
            if traffic.finish(time.monotonic() + 1.0) and not self._is_at_work():
                return
        self._findings.stuck.append(f"clients or jobs, {self._limits.drain_s:g} s after the last kill")

    def _is_at_work(self) -> bool:
        """Whether a job has not ended, checks included, which no client follows."""
        return bool(self._records.rows("SELECT 1 FROM jobs WHERE finished_us IS NULL LIMIT 1"))

    def _check_service(self, traffic: Traffic) -> Shown:
        ledger, findings = traffic.ledger, self._findings
        headers = {"Authorization": f"Bearer {self._installation.key}", "Accept-Encoding": "identity"}
        with httpx.Client(base_url=self._installation.url, headers=headers, timeout=60, trust_env=False) as client:
            shown = checks.shown_by(client)
            checks.check_drives(client, ledger, shown, findings)
            checks.check_jobs(ledger, shown, findings)
            checks.check_scenes(client, shown, findings)
            checks.check_maps(client, ledger, shown, findings)
        return shown

    def _check_stopped(self, traffic: Traffic, killer: Killer) -> dict[str, int]:
        """After an orderly stop; what is kept for a while must go once that is over. How much was kept."""
        data, findings = self._installation.data, self._findings
        self._stop(killer)
        kept = checks.kept_files(data)
        if kept:
            _say(f"{len(kept)} files of killed requests are kept for a while; starting again when that is over")
            checks.age(kept, _AGED_S)
            self._installation.start()
            end_s = time.monotonic() + COLLECTED_WITHIN_S
            while checks.kept_files(data) and time.monotonic() < end_s:
                time.sleep(1)
            killer.operate()
            self._stop(killer)
        checks.check_records(self._records, findings)
        orphans = checks.check_store(self._records, data, traffic.ledger, findings)
        temporary = [*self._installation.temporary.iterdir(), *(_temporary() - self._temporary_before)]
        checks.check_folders(data, temporary, findings)
        return {"files_kept_for_a_while": len(kept), "objects_kept_for_a_day": orphans}

    def _stop(self, killer: Killer) -> None:
        """In order; who is left then is a finding."""
        try:
            code = self._installation.stop()
        except subprocess.TimeoutExpired:
            self._findings.left.append("the service did not stop")
            self._installation.kill()
        else:
            if code != 0:
                self._findings.damaged.append(f"the service stopped with exit code {code}")
        left = left_of(self._installation.data, killer.known)
        self._findings.left += [f"process {process}" for process in left]


def _temporary() -> set[Path]:
    """What the service's programs may have left in this machine's temporary folder."""
    return set(Path(tempfile.gettempdir()).glob(_OURS_IN_TEMPORARY))


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
