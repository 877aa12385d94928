"""Whether a process answers, asked without waiting."""

from __future__ import annotations

import socket
import time
from contextlib import closing
from pathlib import Path

from service.standalone.liveness_probe import Pulse
from tests.helpers.live_api import api_in_thread, settings_of, wait_until

HOST = "127.0.0.1"


def test_the_api_answers(tmp_path: Path) -> None:
    with api_in_thread(settings_of(tmp_path)) as api:
        port = int(api.url.rpartition(":")[2])
        wait_until(lambda: answers(port, "/livez"), "an answer")
        assert not answers(port, "/nothing")


def test_who_listens_and_does_not_answer() -> None:
    with closing(socket.create_server((HOST, 0), backlog=1)) as silent:
        port = silent.getsockname()[1]
        began_s = time.monotonic()
        asked = [Pulse(HOST, port, "/livez") for _ in range(5)]  # more than it has room for
        assert not any(pulse.end() for pulse in asked)
        assert time.monotonic() - began_s < 5


def test_nobody_listens() -> None:
    with closing(socket.socket()) as nobody:
        nobody.bind((HOST, 0))
        assert not Pulse(HOST, nobody.getsockname()[1], "/livez").end()


def answers(port: int, path: str) -> bool:
    pulse = Pulse(HOST, port, path)
    time.sleep(0.5)
    return pulse.end()
