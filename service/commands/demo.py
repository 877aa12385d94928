"""`mrasfm demo`: the whole service at work on drives whose truth is known."""

from __future__ import annotations

import argparse
import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from schemas.artifacts import drive_of_scene
from schemas.command_line import output_folder

if TYPE_CHECKING:
    from service.client import Client
    from service.client.display import Display

MAX_RMSE_M = 0.2
MAX_SEAM_M = 0.1
SEED = 1
DRIVES = 2
CAMERAS = 6
EXIT_FAILED, EXIT_REFUSED, EXIT_INTERRUPTED = 1, 2, 130
_START_TIMEOUT_S = 120.0
_STOP_TIMEOUT_S = 90.0
# -P: a folder named like our package in the current directory must not be run instead.
_PYTHON = (sys.executable, "-P")
_MRASFM = (*_PYTHON, "-c", "from mrasfm_engine.cli import main; raise SystemExit(main())")


class DemoError(Exception):
    """A part of the demo failed; the message says which, and where its log is."""


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "demo",
        help="demonstrate the whole service on rendered drives",
        description="Render two drives of one street, send them to a service of their own, get scenes and a map, "
        "compare with the truth.",
        epilog=f"exit codes: 0 done; 1 a part failed, or an error is over {MAX_RMSE_M} m, at the seam {MAX_SEAM_M} m; "
        "2 OUT is not empty",
    )
    parser.add_argument(
        "--out", type=output_folder, default=Path("demo"), metavar="OUT", help="folder for all output (default: demo)"
    )
    parser.add_argument("--units", type=int, default=20, help="frames of each drive (default: 20)")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Make everything, say what there is, and stop the service whatever happens."""
    from service.client import ClientError
    from service.client.display import Display

    out: Path = arguments.out
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        print(f"mrasfm: error: {out} is not empty. Remove it, or give another folder with --out.", file=sys.stderr)
        return EXIT_REFUSED
    with _interrupted_by_signals(), Display() as display:
        try:
            return _Demo(out, arguments.units, display).run()
        except (DemoError, ClientError, OSError) as error:
            display.say(f"mrasfm: error: {error}")
            return EXIT_FAILED
        except KeyboardInterrupt:
            display.say(f"mrasfm: interrupted; the service is stopped, what was made is in {out}")
            return EXIT_INTERRUPTED


class _Demo:
    def __init__(self, out: Path, units: int, display: Display) -> None:
        self._out = out
        self._units = units
        self._display = display
        self._numbers = range(DRIVES)
        self._seconds: dict[str, float] = {}
        self._drive_ids: list[str] = []
        self._name_of: dict[str, str] = {}  # in the map, by the drive's id

    def run(self) -> int:
        from service.client import Client

        with self._timed("render"):
            self._render()
        key = self._make_key()
        port = _free_port()
        with self._service(port), Client(f"http://127.0.0.1:{port}", key) as client:
            self._use(client)
        with self._timed("evaluate"):
            errors = [self._evaluate(self._scene(number), self._truth(number)) for number in self._numbers]
            named = zip(self._numbers, self._drive_ids, strict=True)
            truths = [f"{self._name_of[drive_id]}={self._truth(number)}" for number, drive_id in named]
            of_map = self._evaluate(self._map, *truths)
        self._print(errors, of_map)
        return self._judge([*errors, of_map], of_map["seams"])

    def _judge(self, errors: Sequence[dict[str, Any]], seams: Sequence[dict[str, Any]]) -> int:
        """The exit code; comparisons are such that what is not a number fails, too."""
        worst_m = max(float(error["metric"]["rmse_m"]) for error in errors)
        if not worst_m <= MAX_RMSE_M:
            self._display.say(f"mrasfm: error: the position error of {worst_m:.3f} m is over {MAX_RMSE_M} m")
            return EXIT_FAILED
        if not seams or not all(float(seam["translation_m"]) <= MAX_SEAM_M for seam in seams):
            self._display.say(f"mrasfm: error: the drives are not put together within {MAX_SEAM_M} m: {list(seams)}")
            return EXIT_FAILED
        return 0

    @property
    def _map(self) -> Path:
        return self._out / "map"

    def _drive(self, number: int) -> Path:
        return self._out / "drives" / f"drive_{number}"

    def _truth(self, number: int) -> Path:
        return self._drive(number) / "truth.tum"

    def _scene(self, number: int) -> Path:
        return self._out / f"scene_{number}"

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        began_s = time.monotonic()
        yield
        self._seconds[part] = time.monotonic() - began_s

    def _render(self) -> None:
        out = self._out / "drives"
        self._display.say(
            f"rendering {DRIVES} drives of one street: {out}, {CAMERAS} cameras, {self._units} units each"
        )
        options = ("--drives", str(DRIVES), "--cameras", str(CAMERAS), "--units", str(self._units), "--seed", str(SEED))
        _output_of([*_MRASFM, "synth", *options, "--out", str(out)])

    def _make_key(self) -> str:
        from service.storage.data_folder import write_private_file

        data = str(self._out / "service")
        key = _output_of([*_PYTHON, "-m", "service", "keys", "--data", data, "create", "--name", "demo"]).strip()
        write_private_file(self._out / "api-key", key + "\n")  # whoever starts the service again needs one
        return key

    @contextmanager
    def _service(self, port: int) -> Iterator[None]:
        """The service on this port; stopped at the end, whatever happens."""
        self._display.say(f"starting the service on port {port}")
        argv = [*_PYTHON, "-m", "service", "standalone", "--data", str(self._out / "service"), "--port", str(port)]
        with (self._out / "service.log").open("wb") as log:
            # A process group of its own: Ctrl-C is for us, and we stop it in order.
            process = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=log, stderr=log, process_group=0)
        try:
            with self._timed("start"):
                self._await_ready(process, port)
            yield
        finally:
            with self._timed("stop"):
                _stop(process)
        if process.returncode != 0:
            raise DemoError(f"the service did not stop cleanly, its exit code is {process.returncode}. {self._log()}")

    def _await_ready(self, process: subprocess.Popen[bytes], port: int) -> None:
        import httpx

        until_s = time.monotonic() + _START_TIMEOUT_S
        with httpx.Client(trust_env=False) as client:
            while time.monotonic() < until_s:
                if process.poll() is not None:
                    raise DemoError(f"the service ended with exit code {process.returncode}. {self._log()}")
                try:
                    if client.get(f"http://127.0.0.1:{port}/readyz").is_success:
                        return
                except httpx.TransportError:
                    time.sleep(0.2)
        raise DemoError(f"the service was not ready after {_START_TIMEOUT_S:.0f} s. {self._log()}")

    def _log(self) -> str:
        return f"See {self._out / 'service.log'} and {self._out / 'service' / 'logs'}."

    def _use(self, client: Client) -> None:
        from schemas.api.aggregations import AggregationRequest
        from service.client import DriveFolder, download, start_aggregation, upload_drive, watch_job

        with self._timed("upload"):
            drive_ids = []
            for number in self._numbers:
                self._display.say(f"uploading {self._drive(number)}")
                sent = upload_drive(client, DriveFolder.read(self._drive(number)), report=self._display.report)
                drive_ids.append(sent.drive_id)
        with self._timed("reconstruct and aggregate"):
            asked = AggregationRequest(drives=drive_ids, name="demo", require_all=True)
            job = start_aggregation(client, asked)
            self._display.say(f"making a map of them: {client.url}/v1/jobs/{job.id}")
            job = watch_job(client, job.id, tell=self._display.tell)
        if job.map_id is None or job.map_version is None:
            why = "" if job.problem is None else f": {job.problem.detail}\n{job.problem.log_tail or ''}"
            raise DemoError(f"job {job.id} {job.state}{why}. {self._log()}")
        version = client.map_version(job.map_id, job.map_version)
        scene_of = {scene.drive_id: scene.scene_id for scene in version.scenes}
        self._name_of = {s.drive_id: s.name for s in version.scenes if s.name == drive_of_scene(s.name)}
        self._drive_ids = drive_ids
        with self._timed("download"):
            for number, drive_id in zip(self._numbers, drive_ids, strict=True):
                self._display.say(f"downloading {self._scene(number)}")
                download(client, client.scene(scene_of[drive_id]), self._scene(number), report=self._display.report)
            self._display.say(f"downloading {self._map}")
            download(client, version, self._map, report=self._display.report)

    def _evaluate(self, result: Path, *truths: Path | str) -> dict[str, Any]:
        words = [str(truth) for truth in truths]
        printed = _output_of([*_MRASFM, "evaluate", str(result), "--truth", *words, "--json"])
        errors: dict[str, Any] = json.loads(printed)
        return errors

    def _print(self, errors: Sequence[dict[str, Any]], of_map: dict[str, Any]) -> None:
        print("\nTwo drives of one street went in over HTTP, two scenes and the map of both came out:")
        for number, error in zip(self._numbers, errors, strict=True):
            print(
                f"  {self._scene(number)}: {error['registered_images']} of {error['total_images']} images registered, "
                f"position error {error['metric']['rmse_m']:.3f} m RMS against the truth (bound {MAX_RMSE_M} m)"
            )
        print(f"  {self._map}: position error {of_map['metric']['rmse_m']:.3f} m RMS (bound {MAX_RMSE_M} m)")
        for seam in of_map["seams"]:
            print(
                f"    seam {seam['a']} - {seam['b']}: {seam['translation_m']:.3f} m and {seam['rotation_deg']:.3f} deg "
                f"off (bound {MAX_SEAM_M} m)"
            )
        parts = ", ".join(f"{part} {seconds:.0f} s" for part, seconds in self._seconds.items())
        print(f"It took {sum(self._seconds.values()):.0f} s: {parts}.")
        print("In each: points.ply for a viewer, model/ for COLMAP, report.json for the figures, pictures/ to look at.")
        print("To look at the service itself, start it again with what it has:")
        print(f"  mrasfm standalone --data {self._out / 'service'}")
        print(f"  then http://127.0.0.1:8000/, with the key in {self._out / 'api-key'}")
        images = " ".join(f"--drive {self._drive(number)}" for number in self._numbers)
        print("To open the map in the browser:")
        print(f"  mrasfm view {self._map} {images}")


def _output_of(argv: Sequence[str]) -> str:
    """Run a program and return its output.

    Raises
    ------
    DemoError
        Where it fails, with what it complained of.
    """
    done = subprocess.run(argv, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if done.returncode:
        what = " ".join(argv[argv.index("-m") + 1 :] if "-m" in argv else argv[len(_MRASFM) :])
        raise DemoError(f"'{what}' ended with exit code {done.returncode}:\n{done.stderr.strip()}")
    return done.stdout


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Stop the service in order; a second Ctrl-C, or one that hangs, is answered by force."""
    process.terminate()
    try:
        process.wait(_STOP_TIMEOUT_S)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        process.kill()
        process.wait()


def _free_port() -> int:
    with closing(socket.socket()) as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@contextmanager
def _interrupted_by_signals() -> Iterator[None]:
    """Treat being told to end as Ctrl-C, so that the service is stopped then too."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
