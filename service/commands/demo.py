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

if TYPE_CHECKING:
    from service.client import Client
    from service.client.display import Display

MAX_RMSE_M = 0.2
SEEDS = (1, 2)
CAMERAS = 6
EXIT_FAILED, EXIT_REFUSED, EXIT_INTERRUPTED = 1, 2, 130
_START_PATIENCE_S = 120.0
_STOP_PATIENCE_S = 90.0
# -P: a folder named like our package in the current directory must not be run instead.
_PYTHON = (sys.executable, "-P")
_MRASFM = (*_PYTHON, "-c", "from mrasfm_engine.cli import main; raise SystemExit(main())")


class DemoError(Exception):
    """A part of the demo failed; the message says which, and where its log is."""


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "demo",
        help="show the whole service at work",
        description="Render two drives, send them to a service of their own, get their scenes, compare with the truth.",
        epilog=f"exit codes: 0 done; 1 a part failed, or an error is over {MAX_RMSE_M} m; 2 OUT is not empty",
    )
    parser.add_argument("--out", type=Path, default=Path("demo"), metavar="OUT", help="folder for all of it: demo")
    parser.add_argument("--units", type=int, default=20, help="instants of each drive (default: 20)")
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
        self._numbers = range(1, len(SEEDS) + 1)
        self._seconds: dict[str, float] = {}

    def run(self) -> int:
        from service.client import Client

        with self._timed("render"):
            for number, seed in zip(self._numbers, SEEDS, strict=True):
                self._render(number, seed)
        key = self._make_key()
        port = _free_port()
        with self._service(port), Client(f"http://127.0.0.1:{port}", key) as client:
            self._use(client)
        with self._timed("evaluate"):
            errors = [self._evaluate(number) for number in self._numbers]
        self._print(errors)
        worst_m = max(float(error["metric"]["rmse_m"]) for error in errors)
        if not worst_m <= MAX_RMSE_M:  # also where it is not a number
            self._display.say(f"mrasfm: error: the position error of {worst_m:.3f} m is over {MAX_RMSE_M} m")
            return EXIT_FAILED
        return 0

    def _drive(self, number: int) -> Path:
        return self._out / f"drive-{number}"

    def _scene(self, number: int) -> Path:
        return self._out / f"scene-{number}"

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        began_s = time.monotonic()
        yield
        self._seconds[part] = time.monotonic() - began_s

    def _render(self, number: int, seed: int) -> None:
        self._display.say(f"rendering {self._drive(number)}: {CAMERAS} cameras, {self._units} units")
        options = ("--cameras", str(CAMERAS), "--units", str(self._units), "--seed", str(seed))
        _output_of([*_MRASFM, "synth", *options, "--out", str(self._drive(number))])

    def _make_key(self) -> str:
        from service.data_folder import write_private_file

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

        until_s = time.monotonic() + _START_PATIENCE_S
        while time.monotonic() < until_s:
            if process.poll() is not None:
                raise DemoError(f"the service ended with exit code {process.returncode}. {self._log()}")
            try:
                if httpx.get(f"http://127.0.0.1:{port}/readyz", trust_env=False).is_success:
                    return
            except httpx.TransportError:
                time.sleep(0.2)
        raise DemoError(f"the service was not ready after {_START_PATIENCE_S:.0f} s. {self._log()}")

    def _log(self) -> str:
        return f"See {self._out / 'service.log'} and {self._out / 'service' / 'logs'}."

    def _use(self, client: Client) -> None:
        from service.client import DriveFolder, follow, start_reconstruction, upload_drive

        jobs = []
        with self._timed("upload"):
            for number in self._numbers:
                self._display.say(f"uploading {self._drive(number)}")
                sent = upload_drive(client, DriveFolder.read(self._drive(number)), report=self._display.report)
                jobs.append(start_reconstruction(client, sent.drive_id).id)
        with self._timed("reconstruct"):
            for number, job_id in zip(self._numbers, jobs, strict=True):
                self._display.say(f"reconstructing {self._drive(number)}: {client.url}/v1/jobs/{job_id}")
                job = follow(client, job_id, tell=self._display.tell)
                if job.scene_id is None:
                    why = "" if job.problem is None else f": {job.problem.detail}\n{job.problem.log_tail or ''}"
                    raise DemoError(f"job {job_id} {job.state}{why}. {self._log()}")
                self._download(client, number, job.scene_id)

    def _download(self, client: Client, number: int, scene_id: str) -> None:
        from service.client import download_scene

        self._display.say(f"downloading {self._scene(number)}")
        download_scene(client, scene_id, self._scene(number), report=self._display.report)

    def _evaluate(self, number: int) -> dict[str, Any]:
        truth = str(self._drive(number) / "truth.tum")
        printed = _output_of([*_MRASFM, "evaluate", str(self._scene(number)), "--truth", truth, "--json"])
        errors: dict[str, Any] = json.loads(printed)
        return errors

    def _print(self, errors: Sequence[dict[str, Any]]) -> None:
        print("\nTwo drives went in over HTTP, two scenes came out:")
        for number, error in zip(self._numbers, errors, strict=True):
            print(
                f"  {self._scene(number)}: {error['registered_images']} of {error['total_images']} images registered, "
                f"position error {error['metric']['rmse_m']:.3f} m RMS against the truth (bound {MAX_RMSE_M} m)"
            )
        parts = ", ".join(f"{part} {seconds:.0f} s" for part, seconds in self._seconds.items())
        print(f"It took {sum(self._seconds.values()):.0f} s: {parts}.")
        print("In each scene: points.ply for a viewer, model/ for COLMAP, report.json for the figures.")
        print("To look at the service itself, start it again with what it has:")
        print(f"  mrasfm standalone --data {self._out / 'service'}")
        print(f"  then http://127.0.0.1:8000/docs, with the key in {self._out / 'api-key'}")


def _output_of(argv: Sequence[str]) -> str:
    """What a program prints.

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
        process.wait(_STOP_PATIENCE_S)
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
