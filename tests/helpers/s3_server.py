"""An S3 server on loopback."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import boto3
import pytest

from tests.helpers.live_api import HOST, free_port
from tests.helpers.service_world import wait_until


@contextmanager
def s3_server() -> Iterator[str]:
    """The URL of a server that runs as long as the context."""
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-H", HOST, "-p", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )

    def listens() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex((HOST, port)) == 0

    try:
        wait_until(listens, "the S3 server's start")
        yield f"http://{HOST}:{port}"
    finally:
        process.kill()
        process.wait()


def settings_of_bucket(endpoint: str, name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Make a bucket of about this name; the settings of an artifact store in it."""
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    bucket = name.lower().replace("_", "-")[:60]
    boto3.client("s3", endpoint_url=endpoint, region_name="us-east-1").create_bucket(Bucket=bucket)
    return {"artifacts_url": f"s3://{bucket}/prefix", "s3_endpoint": endpoint}
