"""An API that most tests share, each with a project of its own; and the databases that tests run on."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import create_engine, make_url, text

from service.database.connections import Database, migrate
from service.database.tables import new_id
from service.domain.keys import create_project
from service.settings import Settings
from tests.helpers.live_api import Api, Client, api_in_thread, settings_of
from tests.helpers.migrated import migrated

StartApi = Callable[..., Api]


@pytest.fixture(scope="session")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """One API for all tests that need no settings of their own."""
    with api_in_thread(settings_of(tmp_path_factory.mktemp("api"))) as running:
        yield running


@pytest.fixture(scope="session")
def page(api: Api) -> dict[str, Any]:
    """The OpenAPI page."""
    with api.anonymous() as client:
        return dict(client.get("/openapi.json").json())


@pytest.fixture(scope="session")
def postgres_api(tmp_path_factory: pytest.TempPathFactory, postgres_url: str) -> Iterator[Api]:
    """As `api`, over PostgreSQL."""
    with _postgres_database(postgres_url) as url:
        settings = settings_of(tmp_path_factory.mktemp("postgres-api"), database_url=url)
        with api_in_thread(settings) as running:
            yield running


@pytest.fixture
def set_clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """A function that sets this process's clock so many microseconds off, as another host's; not the database's."""

    def set_off(off_us: int) -> None:
        host = SimpleNamespace(time_ns=lambda: time.time_ns() + 1000 * off_us)
        monkeypatch.setattr("service.database.tables._base.time", host)

    return set_off


@pytest.fixture
def client(api: Api) -> Client:
    """A client of a project of its own."""
    return api.client()


@pytest.fixture
def start_api(tmp_path: Path) -> Iterator[StartApi]:
    """A function that starts an API with settings of the test's."""
    with ExitStack() as running:

        def start(**changed: Any) -> Api:
            return running.enter_context(api_in_thread(settings_of(tmp_path / "data", **changed)))

        yield start


@pytest.fixture(scope="session")
def postgres_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A PostgreSQL server: the one that is named, or one started here; skips where there is none."""
    named = os.environ.get("MRASFM_TEST_DATABASE_URL")
    if named:
        yield named
        return
    binaries = _postgres_binaries()
    if binaries is None:
        pytest.skip("no PostgreSQL: set MRASFM_TEST_DATABASE_URL, or install its server")
    # A short path: the socket's may have 107 bytes. Not of ours: the server refuses to run as root.
    folder = Path(tempfile.mkdtemp(prefix="pg"))
    as_user: list[str] = []
    if os.geteuid() == 0:
        shutil.chown(folder, "nobody")
        as_user = ["setpriv", "--reuid", "nobody", "--clear-groups", "--"]
    data = folder / "data"
    start = [binaries / "pg_ctl", "-D", data, "-w", "-t", "60", "-l", folder / "log"]
    options = f"-c listen_addresses='' -c unix_socket_directories={folder} -c fsync=off"
    try:
        _run(*as_user, binaries / "initdb", "-D", data, "-U", "test", "-A", "trust", "--encoding=UTF8", cwd=folder)
        _run(*as_user, *start, "-o", options, "start", cwd=folder)
        yield f"postgresql+psycopg://test@/postgres?host={folder}"
    finally:
        if (data / "postmaster.pid").exists():
            _run(*as_user, *start, "-m", "immediate", "stop", cwd=folder)
        shutil.rmtree(folder)


def _postgres_binaries() -> Path | None:
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    found = str(installed[-1]) if installed else shutil.which("initdb")
    return None if found is None else Path(found).parent


def _run(*command: str | Path, cwd: Path) -> None:
    subprocess.run(command, check=True, cwd=cwd, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


@pytest.fixture(params=["sqlite", "postgresql"])
def database_settings(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Settings]:
    """Settings of an empty database, of either kind; of a migrated one for who asks for `database` as well."""
    if request.param == "sqlite":
        yield settings_of(tmp_path)
        return
    template = request.getfixturevalue("postgres_template") if "database" in request.fixturenames else ""
    with _postgres_database(request.getfixturevalue("postgres_url"), template) as url:
        yield settings_of(tmp_path, database_url=url)


@pytest.fixture
def postgres_database(postgres_url: str) -> Iterator[str]:
    """URL of an empty PostgreSQL database."""
    with _postgres_database(postgres_url) as url:
        yield url


@pytest.fixture(scope="session")
def postgres_template(postgres_url: str) -> Iterator[str]:
    """Name of a migrated PostgreSQL database that nobody is connected to, so that it can be copied."""
    with _postgres_database(postgres_url) as url:
        migrate(Settings(database_url=url))
        yield make_url(url).database or ""


@contextmanager
def _postgres_database(server: str, template: str = "") -> Iterator[str]:
    """URL of a database that is empty, or the copy of another one."""
    name = new_id("t")
    _on_server(server, f'CREATE DATABASE "{name}"' + (f' TEMPLATE "{template}"' if template else ""))
    yield make_url(server).set(database=name).render_as_string(hide_password=False)
    _on_server(server, f'DROP DATABASE "{name}" WITH (FORCE)')


def _on_server(url: str, statement: str) -> None:
    engine = create_engine(url, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(statement))
    engine.dispose()


@pytest.fixture
def database(database_settings: Settings) -> Iterator[Database]:
    """A migrated database, of either kind."""
    if make_url(database_settings.resolved_database_url).get_backend_name() == "sqlite":
        migrated(database_settings)
    opened = Database.from_settings(database_settings)
    yield opened
    opened.close()


@pytest.fixture
def project_id(database: Database, database_settings: Settings) -> str:
    """A project of that database."""
    with database.write() as session:
        return create_project(session, "test", database_settings).id
