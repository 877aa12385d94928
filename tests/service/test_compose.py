"""docker-compose.yml, as far as it can be checked without Docker."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from mrasfm_engine.learned.model_folder import FOLDER_VARIABLE
from service.database.connections import Database
from service.settings import Settings, misspelt_variables

REPOSITORY = Path(__file__).resolve().parents[2]
COMPOSE = (REPOSITORY / "docker-compose.yml").read_text(encoding="utf-8")
EXAMPLE = (REPOSITORY / ".env.example").read_text(encoding="utf-8")


def test_every_setting_that_it_passes_exists() -> None:
    passed = set(re.findall(r"^ +(MRASFM_\w+):", COMPOSE, re.MULTILINE))
    assert passed >= {"MRASFM_DATABASE_URL", "MRASFM_REDIS_URL", "MRASFM_ARTIFACTS_URL"}
    of_the_service = {f"MRASFM_{name.upper()}" for name in Settings.model_fields}
    assert passed <= of_the_service | {FOLDER_VARIABLE}  # of the engine: where trained models lie


def test_every_setting_of_the_environment_file_reaches_the_service() -> None:
    """What the file of compose sets itself comes before it: `environment` does before `env_file`."""
    document = YAML(typ="safe").load(COMPOSE)
    of_the_service = {
        name: service for name, service in document["services"].items() if str(service["image"]).startswith("mrasfm:")
    }
    assert of_the_service.keys() == {"migrate", "api", "worker", "checker", "reconciler"}
    for service in of_the_service.values():
        assert service["env_file"] == [{"path": ".env", "required": False}]
        assert service["environment"]["MRASFM_DATA_DIR"] == "/data", "not a folder of the host"
    assert of_the_service["api"]["environment"]["MRASFM_PORT"] == "8000", "not the port of the host"
    others = document["services"].keys() - of_the_service.keys()
    assert not any("env_file" in document["services"][name] for name in others)


def test_what_compose_alone_reads_is_not_taken_for_a_misspelt_setting() -> None:
    read = set(re.findall(r"\$\{(MRASFM_\w+):", COMPOSE))
    assert {"MRASFM_WORKERS", "MRASFM_LISTEN", "MRASFM_WORKER_MEMORY", "MRASFM_VERSION"} <= read
    assert list(misspelt_variables(dict.fromkeys(read, "1"))) == []
    assert len(list(misspelt_variables({"MRASFM_MAX_ATTEMPT": "1", "MRASFM_WORKER": "1"}))) == 2


def test_secrets_are_required_and_have_no_value_anywhere() -> None:
    required = set(re.findall(r"\$\{(\w+):\?", COMPOSE))
    assert required == {"POSTGRES_PASSWORD", "VALKEY_PASSWORD", "S3_ACCESS_KEY_ID", "S3_SECRET_ACCESS_KEY"}
    assert set(re.findall(r"^(\w+)=$", EXAMPLE, re.MULTILINE)) == required
    assert not re.findall(r"^\w+=.", EXAMPLE, re.MULTILINE)
    assert not re.findall(rf"\$\{{(?:{'|'.join(required)})(?!:\?)", COMPOSE)


def test_every_variable_of_the_example_is_used() -> None:
    for name in re.findall(r"^#?([A-Z_0-9]+)=", EXAMPLE, re.MULTILINE):
        assert f"${{{name}:" in COMPOSE, name


def service_of(name: str) -> str:
    """The lines of one service."""
    return COMPOSE.partition(f"\n  {name}:\n")[2].partition("\n\n")[0]


def test_the_reconciler_alone_reaches_the_internet() -> None:
    """It sends the messages of webhooks, and its other network leads nowhere else."""
    assert "networks: [backend, egress]" in service_of("reconciler")
    assert re.search(r"^  backend:\n    internal: true", COMPOSE, re.MULTILINE)
    assert not re.search(r"^  egress:.*\n    internal", COMPOSE, re.MULTILINE)
    assert len(re.findall(r"networks: \[.*egress", COMPOSE)) == 1


def test_what_is_left_out_of_the_example_is_no_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compose passes an empty text."""
    optional = re.findall(r"^ +(MRASFM_\w+): \$\{MRASFM_\w+:-\}", COMPOSE, re.MULTILINE)
    assert {"MRASFM_EXPORT_RETENTION_DAYS", "MRASFM_METRICS_TOKEN", "MRASFM_CONSOLE_TILES"} <= set(optional)
    for name in optional:
        monkeypatch.setenv(name, "")
        assert getattr(Settings(), name.removeprefix("MRASFM_").lower()) is None


def test_images_are_pinned_and_only_the_api_is_published_on_loopback() -> None:
    for image in re.findall(r"image: (\S+)", COMPOSE):
        assert re.search(r":(v?\d|\$\{MRASFM_VERSION)", image), image
    assert re.findall(r"ports: (.*)", COMPOSE) == ['["${MRASFM_LISTEN:-127.0.0.1}:${MRASFM_PORT:-8000}:8000"]']


def test_one_service_alone_builds_the_image() -> None:
    """Several that build one tag at the same time end with "already exists" where containerd keeps the images."""
    assert len(re.findall(r"^ +build:", COMPOSE, re.MULTILINE)) == 1
    assert "\n    build: ." in service_of(
        "migrate"
    )  # all others wait for it, so that it is part of whatever is started


def test_the_log_of_no_container_grows_without_bound() -> None:
    hardened = COMPOSE.partition("x-hardened:")[2].partition("\n\n")[0]
    assert "logging: { driver: local" in hardened
    services = re.findall(r"^  (\w+):\n +<<: \*(\w+)$", COMPOSE.partition("\nservices:")[2], re.MULTILINE)
    assert {base for _, base in services} == {"hardened", "mrasfm", "background"}
    begun = COMPOSE.partition("\nservices:")[2].partition("\nnetworks:")[0]
    assert len(services) == len(re.findall(r"^  \w+:$", begun, re.MULTILINE))


def test_the_database_takes_more_connections_than_the_api_opens() -> None:
    """Where it does not, neither workers nor the operator's commands get one while the API waits for a lock."""
    given = re.search(r"max_connections=(\d+)", service_of("postgres"))
    database = Database("postgresql+psycopg://nobody@127.0.0.1/none")  # connects to nothing before it is used
    of_process = database.engine.pool.size() + database.engine.pool._max_overflow  # type: ignore[attr-defined]
    database.close()
    assert of_process == 40, "docs/service/deployment.md says so"
    assert given is not None
    assert int(given[1]) >= 2 * of_process + 100
