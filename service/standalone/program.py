"""API, broker, workers and reconciler as one program, with all state in one folder.

With settings for an outside database, store or broker the same processes use those instead.
"""

from __future__ import annotations

import http.client
import ipaddress
import os
import socket
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

from service.database.connections import migrate
from service.database.startup_errors import UnusableDatabaseError, unusable_is_told
from service.domain.keys import ensure_first_key
from service.settings import Settings
from service.standalone import broker
from service.standalone.liveness_probe import Pulse
from service.standalone.supervisor import ChildSpec, Supervisor
from service.storage.data_folder import exclusive_use, make_private_folder, require_data_folder

PROBE_TIMEOUT_S = 2.0
# A worker that is told to stop ends its stage and gives its job back to the queue; the next start goes on from there.
WORKER_GRACE_S = 30.0
API_GRACE_S = 25.0  # a little more than it gives the requests that are under way

Say = Callable[[str], None]


class StandaloneError(Exception):
    """Something that the processes need is not there; the message says what to do."""


def run_standalone(settings: Settings, *, workers: int, log_level: str, say: Say) -> None:
    """Prepare the folder and run everything until a signal says stop.

    Parameters
    ----------
    settings
        Port 0 takes a free one.
    workers
        Reconstructions at a time.
    log_level
        Of all processes: debug, info, warning or error.
    say
        Takes a line for the person at the terminal.

    Raises
    ------
    DataFolderError, BrokerServerError, StandaloneError, SupervisorError
        Where it cannot run; the message says why and what to do.
    """
    port = settings.port or _free_port(settings.host)
    settings = settings.model_copy(update={"data_dir": settings.data_dir.resolve(), "port": port})
    require_data_folder(settings.data_dir)
    make_private_folder(settings.data_dir)
    with exclusive_use(settings.data_dir) as lock:
        _prepare_records(settings, say)
        embedded = broker.prepare(_broker_folder(settings)) if settings.redis_url is None else None
        say("starting")
        Supervisor(
            child_specs(settings, embedded, workers=workers, log_level=log_level),
            log_folder=settings.data_dir / "logs",
            say=say,
            on_ready=lambda: _announce(settings, say),
            kept_descriptors=[lock],
        ).run()


def child_specs(
    settings: Settings, embedded: broker.EmbeddedBroker | None, *, workers: int, log_level: str
) -> list[ChildSpec]:
    """Processes of standalone, dependencies first."""
    address = (settings.host, settings.port)
    # The broker's password is in the environment of our own processes only: command lines can be read by everybody.
    environment = _environment(settings, embedded, workers=workers)
    after_broker = ["broker"] if embedded else []
    api = ChildSpec(
        name="api",
        argv=_python("service", "api", "--log-level", log_level),
        environment=environment,
        depends_on=after_broker,  # it does without, but the broker shall end last
        is_ready=lambda: _is_ready(*address),
        ask=lambda: Pulse(_reachable(settings.host), settings.port, "/livez"),
        listens_on=address,
        port_remedy="Stop the other program, or take another port with --port.",
        grace_s=API_GRACE_S,
    )

    def background(name: str, *arguments: str) -> ChildSpec:
        return ChildSpec(
            name=name,
            argv=_python("worker", *arguments, "--log-level", log_level),
            environment=environment,
            depends_on=after_broker,
            grace_s=WORKER_GRACE_S,
        )

    return [
        *([_broker_spec(embedded, settings)] if embedded else []),
        api,
        background("checker", "worker", "--queues", "checks", "--concurrency", "1"),
        background("worker", "worker", "--queues", "reconstructions", "--concurrency", str(workers)),
        background("reconciler", "reconciler"),
    ]


def _broker_spec(embedded: broker.EmbeddedBroker, settings: Settings) -> ChildSpec:
    return ChildSpec(
        name="broker",
        argv=embedded.argv,
        is_ready=lambda: broker.is_up(embedded.url),
        repair=lambda lines: broker.set_damaged_journal_aside(_broker_folder(settings), lines),
        listens_on=(broker.HOST, embedded.port),
        port_remedy="Start again: another port is chosen then.",
    )


def _broker_folder(settings: Settings) -> Path:
    return settings.data_dir / "broker"


def _environment(settings: Settings, embedded: broker.EmbeddedBroker | None, *, workers: int) -> Mapping[str, str]:
    environment = {
        "MRASFM_DATA_DIR": str(settings.data_dir),
        "MRASFM_HOST": settings.host,
        "MRASFM_PORT": str(settings.port),
        "PYTHONUNBUFFERED": "1",  # so that the last words of a killed child are in its log
    }
    if embedded is not None:
        environment["MRASFM_REDIS_URL"] = embedded.url
    if workers > 1 and settings.engine_threads == 0:
        environment["MRASFM_ENGINE_THREADS"] = str(max(1, (os.cpu_count() or 1) // workers))
    return environment


def _python(package: str, *arguments: str) -> list[str]:
    # -P: a folder named like our package in the current directory must not be run instead.
    return [sys.executable, "-P", "-m", package, *arguments]


def _prepare_records(settings: Settings, say: Say) -> None:
    try:
        with unusable_is_told(settings):
            migrate(settings)
            key = ensure_first_key(settings)
    except UnusableDatabaseError as error:
        raise StandaloneError(str(error)) from error
    if key is not None:
        say(f"the first API key, shown this once: {key}")


def _announce(settings: Settings, say: Say) -> None:
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    say(f"ready at http://{host}:{settings.port}")
    say(f"  state in {settings.data_dir}, logs in {settings.data_dir / 'logs'}")
    say(f"  another API key: mrasfm keys --data {settings.data_dir} create")
    say("  stop with Ctrl-C")
    if not _is_loopback(settings.host):
        say(
            f"WARNING: {settings.host} can be reached from the network and there is no TLS: keys and drives travel "
            "unencrypted. Put a proxy with TLS before it, or listen on 127.0.0.1."
        )


def _is_ready(host: str, port: int) -> bool:
    with closing(http.client.HTTPConnection(_reachable(host), port, timeout=PROBE_TIMEOUT_S)) as connection:
        try:
            connection.request("GET", "/readyz")
            return connection.getresponse().status == http.HTTPStatus.OK
        except (OSError, http.client.HTTPException):
            return False


def _reachable(host: str) -> str:
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)


def _free_port(host: str) -> int:
    try:
        family, _, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with closing(socket.socket(family, socket.SOCK_STREAM)) as listener:
            listener.bind(address)
            return int(listener.getsockname()[1])
    except OSError as error:
        raise StandaloneError(f"cannot listen on {host}: {error.strerror}. Give an address of this machine.") from error


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
