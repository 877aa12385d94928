"""The API is killed again and again while a resumable upload runs."""

from __future__ import annotations

import hashlib
import random
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.helpers.live_api import ApiProcess, api_process, settings_of
from tests.helpers.slow import slow
from tests.helpers.tus_client import begin, checksum, head, offset_of, patch
from tests.service.test_uploads import PATH, image, stored

SIZE_BYTES = 24_000_000
PIECE_BYTES = 16_384


class _Killer:
    """Kills the API once so many bytes of a request were sent."""

    def __init__(self, api: ApiProcess, at_byte: int) -> None:
        self._api = api
        self._at_byte = at_byte
        self.killed = False

    def pieces(self, data: bytes) -> Iterator[bytes]:
        for start in range(0, len(data), PIECE_BYTES):
            if start + PIECE_BYTES > self._at_byte and not self.killed:
                time.sleep(random.uniform(0, 0.01))
                self._api.kill()
                self.killed = True
            yield data[start : start + PIECE_BYTES]


@pytest.mark.parametrize("kills", [1, *slow(50)])
def test_kills_at_random_bytes(tmp_path: Path, kills: int) -> None:
    """Each time HEAD says how far it is, no bytes are wrong, and none that was told to be there is missing."""
    rng = random.Random(kills)
    data = image(SIZE_BYTES, seed=kills)
    right = hashlib.sha256(data).hexdigest()
    told = 0  # the farthest offset that the API has ever answered
    with api_process(settings_of(tmp_path / "data"), tmp_path) as api:
        client = api.client()
        drive_id = client.create()
        url = begin(client, drive_id, PATH, data, sha256=right)
        done_kills = 0
        while (offset := offset_of(client, url)) < len(data):
            assert offset >= told, "bytes that were told to be there are missing"
            told = offset
            left_kills = kills - done_kills
            # Pieces short enough that all kills find something to interrupt; every third one with its checksum.
            end = len(data) if left_kills == 0 else min(len(data) - 1, offset + rng.randrange(1, len(data) // kills))
            piece = data[offset:end]
            compared = {"Upload_Checksum": checksum(piece)} if rng.random() < 0.3 else {}
            killer = _Killer(api, rng.randrange(len(piece)) if left_kills else 2**60)
            try:
                answer = patch(client, url, offset, killer.pieces(piece), **compared)
            except httpx.TransportError:
                assert killer.killed
            else:
                assert answer.status_code == 204, answer.text
                told = int(answer.headers["upload-offset"])
            if killer.killed:
                done_kills += 1
                api.start()
                assert head(client, url).headers["upload-length"] == str(len(data))
        assert done_kills == kills
        assert stored(client, drive_id) == right
        (kept,) = [path for path in api.objects(client.project_id) if path.stat().st_size == len(data)]
        assert hashlib.sha256(kept.read_bytes()).hexdigest() == right
