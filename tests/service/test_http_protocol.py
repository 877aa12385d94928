"""What a connection may send around bodies, how long it may take, and what of a body's framing is taken."""

from __future__ import annotations

import base64
import hashlib
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
import pytest

from service.api.http import protocol
from service.api.http.protocol import MAX_HEAD_BYTES
from service.api.manifests.bounded_process import LARGE_BYTES
from service.domain import drives
from tests.helpers.live_api import Api, Client, problem_of, wait_until
from tests.helpers.tiny_drive import png, tiny_drive
from tests.service.conftest import StartApi

NAME = "front/000000.png"


@contextmanager
def connected(api: Api) -> Iterator[socket.socket]:
    url = httpx.URL(api.url)
    with socket.create_connection((url.host, url.port), timeout=20) as connection:
        yield connection


def everything_from(connection: socket.socket) -> bytes:
    received = b""
    while data := connection.recv(65536):
        received += data
    return received


def answer_of(connection: socket.socket) -> httpx.Response:
    """The answer, after which the service hangs up."""
    return parsed(everything_from(connection))


def parsed(received: bytes) -> httpx.Response:
    head, _, body = received.partition(b"\r\n\r\n")
    status, *lines = head.decode().split("\r\n")
    headers = [(name, value) for name, _, value in (line.partition(": ") for line in lines)]
    return httpx.Response(int(status.split()[1]), headers=headers, content=body)


def send_until_refused(connection: socket.socket, piece: bytes, at_most_bytes: int) -> int:
    """How many bytes went out until the service hung up."""
    sent = 0
    try:
        while sent < at_most_bytes:
            connection.sendall(piece)
            sent += len(piece)
    except (BrokenPipeError, ConnectionResetError):
        pass
    return sent


@pytest.mark.parametrize(
    "begun",
    [
        b"GET /livez HTTP/1.1\r\nHost: x\r\nX-Endless: ",
        b"GET /",
        b"POST /v1/drives HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n1;endless=",
        b"POST /v1/drives HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n1\r\nx\r\n0\r\nX-Endless: ",
    ],
    ids=["header", "path", "chunk", "trailer"],
)
def test_what_surrounds_a_body_is_bounded_without_a_key(api: Api, begun: bytes) -> None:
    """The last two are answered, with 401, before their end comes."""
    with connected(api) as connection:
        connection.sendall(begun)
        assert send_until_refused(connection, b"x" * 16_384, 50_000_000) < 20_000_000


def test_a_head_that_is_too_large(api: Api) -> None:
    with connected(api) as connection:
        connection.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\nX-Long: " + b"x" * MAX_HEAD_BYTES)
        problem = problem_of(answer_of(connection), 431, "head-too-large")
    assert str(MAX_HEAD_BYTES) in problem["detail"]


def test_a_head_below_the_bound_and_a_body_above_it(client: Client) -> None:
    """Chunks of one byte have five around each, and are fine."""
    headers = {"X-Long": "x" * (MAX_HEAD_BYTES // 2)}
    assert client.get("/v1/drives", headers=headers).status_code == 200
    raw = tiny_drive().raw + b" " * 20_000
    assert client.post("/v1/drives", content=(raw[i : i + 1] for i in range(len(raw)))).status_code == 201
    assert client.post("/v1/drives", content=raw + b" " * 2 * MAX_HEAD_BYTES, headers=headers).status_code == 201


def test_what_is_not_http(api: Api) -> None:
    with connected(api) as connection:
        connection.sendall(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n")
        problem_of(answer_of(connection), 400, "malformed-request")


def post_in_chunks(client: Client, chunk: bytes) -> bytes:
    head = (
        f"POST /v1/drives HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {client.key}\r\nTransfer-Encoding: chunked\r\n"
    )
    return head.encode() + b"\r\n" + chunk


def logged(caplog: pytest.LogCaptureFixture, path: str) -> list[int]:
    """Statuses of the requests for a path, as the request log has them."""
    fields = [getattr(record, "fields", {}) for record in caplog.records if record.message == "request"]
    return [of["status"] for of in fields if of["path"] == path]


@pytest.mark.parametrize("first", [b"", b"5\r\nhello\r\n"], ids=["first chunk", "second chunk"])
def test_a_malformed_chunk_is_answered(client: Client, caplog: pytest.LogCaptureFixture, first: bytes) -> None:
    with caplog.at_level("INFO", "mrasfm.api"), connected(client.api) as connection:
        connection.sendall(post_in_chunks(client, first))
        time.sleep(0.1)  # the application waits for the body
        connection.sendall(b"this is no length\r\n")
        received = everything_from(connection)
        wait_until(lambda: logged(caplog, "/v1/drives"), "the application's end")
    assert received.count(b"HTTP/1.1 ") == 1, "nothing is written behind the answer"
    problem_of(parsed(received), 400, "malformed-request")
    assert logged(caplog, "/v1/drives") == [400], "the application learns that nothing more comes"
    assert client.get("/v1/drives").json()["items"] == []


def test_a_complete_request_is_answered_before_a_malformed_one(client: Client) -> None:
    with connected(client.api) as connection:
        raw = tiny_drive().raw
        connection.sendall(post_in_chunks(client, b"%x\r\n%b\r\n0\r\n\r\n" % (len(raw), raw)) + b"\0 no request\r\n")
        received = everything_from(connection)
    assert received.startswith(b"HTTP/1.1 201 ")
    assert received.count(b"HTTP/1.1 ") == 1


def test_answers_stay_in_the_order_of_their_requests(client: Client) -> None:
    with connected(client.api) as connection:
        raw = tiny_drive().raw
        first = post_in_chunks(client, b"%x\r\n%b\r\n0\r\n\r\n" % (len(raw), raw))
        connection.sendall(first + post_in_chunks(client, b"this is no length\r\n"))
        received = everything_from(connection)
    assert [part[:3] for part in received.split(b"HTTP/1.1 ")[1:]] == [b"201", b"400"]


def test_an_answer_that_has_begun_gets_no_other_behind_it(client: Client) -> None:
    """Without a key the answer comes before the body."""
    with connected(client.api) as connection:
        connection.sendall(b"POST /v1/drives HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n1\r\nx\r\n")
        assert connection.recv(100).startswith(b"HTTP/1.1 401 ")
        connection.sendall(b"this is no length\r\n")
        assert b"HTTP/1.1 " not in everything_from(connection)


def test_every_answer_has_the_headers_that_browsers_go_by(api: Api, client: Client) -> None:
    scene_id = client.scene({"points.ply": b"ply"})
    scene = client.get(f"/v1/scenes/{scene_id}").json()
    (url,) = (file["url"] for file in scene["files"])
    etag = client.get(url).headers["etag"]
    answers = [
        client.get("/v1/drives"),
        client.get(url),
        client.get(url, headers={"If-None-Match": etag}),
        client.get(url, headers={"Range": "bytes=9-"}),
        client.get("/v1/nothing"),
        client.patch("/v1/drives"),
        client.post("/v1/drives", content=b"{"),
        client.post("/v1/drives", headers={"Content-Encoding": "gzip"}, content=b"x"),
        client.get(f"/v1/jobs/{scene['job_id']}/events"),
        *(
            api.anonymous().get(path)
            for path in ("/v1/drives", "/openapi.json", "/docs/files/swagger-ui.css", "/livez")
        ),
    ]
    for malformed in (b"no http\r\n\r\n", b"GET /livez HTTP/1.1\r\nX: " + b"x" * MAX_HEAD_BYTES):
        with connected(api) as connection:
            connection.sendall(malformed)
            answers.append(answer_of(connection))
    assert {answer.status_code for answer in answers} == {200, 304, 400, 401, 404, 405, 415, 416, 422, 431}
    for answer in answers:
        assert answer.headers.get_list("content-security-policy") == ["default-src 'none'; frame-ancestors 'none'"]
        assert answer.headers.get_list("x-content-type-options") == ["nosniff"]


def test_a_failure_of_the_service_has_them_too(start_api: StartApi, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*given: object, **more: object) -> None:
        raise RuntimeError

    monkeypatch.setattr(drives, "stored_of", fails)
    answer = start_api().client().get("/v1/drives")
    problem_of(answer, 500, "internal-error")
    assert answer.headers["content-security-policy"] == "default-src 'none'; frame-ancestors 'none'"
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_connections_that_ask_nothing_end(start_api: StartApi, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol, "HEAD_WITHIN_S", 0.3)
    api = start_api()
    with connected(api) as silent, connected(api) as unfinished, connected(api) as second:
        unfinished.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\n")
        second.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n")
        assert second.recv(100).startswith(b"HTTP/1.1 200 ")
        second.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\n")
        assert silent.recv(100) == b""
        problem_of(answer_of(unfinished), 408, "too-slow")
        assert b"HTTP/1.1 408 " in everything_from(second)


def bytes_sent(caplog: pytest.LogCaptureFixture, route: str) -> list[int]:
    """By the request log, of every answer of a route that has ended."""
    fields = [getattr(record, "fields", {}) for record in caplog.records]
    return [noted["sent_bytes"] for noted in fields if noted.get("route") == route]


def test_an_answer_that_nobody_takes_ends(
    start_api: StartApi, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Its connection, its file and what was read of it were held for ever."""
    monkeypatch.setattr(protocol, "UNTAKEN_WITHIN_S", 1.0)
    api, size = start_api(), 24_000_000
    client = api.client()
    scene_id = client.scene({"points.ply": bytes(size)})
    route = "/v1/scenes/{scene_id}/files/{path:path}"
    asked = (
        f"GET /v1/scenes/{scene_id}/files/points.ply HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {client.key}\r\n\r\n"
    )
    with caplog.at_level("INFO", logger="mrasfm.api"):
        with connected(api) as connection:
            connection.sendall(asked.encode())
            received = 0
            while received < size:  # as slowly as it likes
                received += len(connection.recv(2_000_000))
                time.sleep(0.1)
        wait_until(lambda: bytes_sent(caplog, route) == [size], "the answer that was taken")
        with connected(api) as connection:
            connection.sendall(asked.encode())
            wait_until(lambda: len(bytes_sent(caplog, route)) == 2, "the end of the other one")
    assert bytes_sent(caplog, route)[1] < size


@pytest.mark.parametrize("target", [f"files/{NAME}", "archive", "files:declare"])
def test_a_body_that_stops_coming_ends(start_api: StartApi, target: str) -> None:
    api = start_api(upload_idle_seconds=0.3)
    client = api.client()
    drive_id = client.create()
    method = "POST" if target == "files:declare" else "PUT"
    with connected(api) as connection:
        connection.sendall(
            f"{method} /v1/drives/{drive_id}/{target} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {client.key}\r\n"
            "Content-Length: 100000\r\n\r\n".encode()
            + png()
        )
        problem_of(answer_of(connection), 408, "too-slow")
    assert api.spooled() == []


def test_a_body_may_take_longer_than_it_may_be_silent(start_api: StartApi) -> None:
    api = start_api(upload_idle_seconds=0.4)
    client = api.client()
    drive_id, data = client.create(), png()

    def slowly() -> Iterator[bytes]:
        for i in range(0, len(data), len(data) // 4):
            time.sleep(0.2)
            yield data[i : i + len(data) // 4]

    assert client.put(f"/v1/drives/{drive_id}/files/{NAME}", content=slowly()).status_code == 201


def test_who_announces_large_bodies_and_sends_none_holds_nobody_up(api: Api, client: Client) -> None:
    other = api.client()
    with connected(api) as a, connected(api) as b, connected(api) as c, connected(api) as d, connected(api) as e:
        for connection in (a, b, c, d, e):
            connection.sendall(
                f"POST /v1/drives HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {other.key}\r\n"
                "Content-Length: 9000000\r\n\r\n ".encode()
            )
        raw = tiny_drive().raw + b" " * LARGE_BYTES
        assert client.post("/v1/drives", content=raw, timeout=15).status_code == 201


def test_encoded_bodies_are_refused(client: Client) -> None:
    drive_id = client.create()
    gzip = {"Content-Encoding": "gzip"}
    for answer in (
        client.put(f"/v1/drives/{drive_id}/files/{NAME}", content=png(), headers=gzip),
        client.post("/v1/drives", content=tiny_drive().raw, headers=gzip),
    ):
        problem_of(answer, 415, "encoded-body")
        assert answer.headers["accept-encoding"] == "identity"
    plain = {"Content-Encoding": "identity"}
    assert client.put(f"/v1/drives/{drive_id}/files/{NAME}", content=png(), headers=plain).status_code == 201


def test_a_part_is_not_stored_as_the_whole(client: Client) -> None:
    drive_id, data = client.create(), png()
    part = {"Content-Range": f"bytes 0-{len(data) - 1}/{2 * len(data)}"}
    problem = problem_of(
        client.put(f"/v1/drives/{drive_id}/files/{NAME}", content=data, headers=part), 400, "partial-body"
    )
    assert "uploads" in problem["remedy"]
    assert client.get(f"/v1/drives/{drive_id}").json()["files_stored"] == 0


def field(data: bytes, algorithm: str = "sha-256") -> str:
    digest = hashlib.new(algorithm.replace("-", ""), data).digest()
    return f"{algorithm}=:{base64.b64encode(digest).decode()}:"


@pytest.mark.parametrize(
    ("fields", "status", "code"),
    [
        ([("Content-Digest", field(b"other", "sha-512")), ("Content-Digest", field(b"other"))], 422, "wrong-digest"),
        ([("Content-Digest", field(png())), ("Content-Digest", field(b"other"))], 400, "malformed-digest"),
        ([("Repr-Digest", field(b"other"))], 422, "wrong-digest"),
        ([("Content-Digest", field(png(), "sha-512"))], 400, "malformed-digest"),
        ([("Content-Digest", field(png())), ("Repr-Digest", field(png()))], 201, ""),
    ],
    ids=["second line", "contradiction", "of the file", "unknown", "both"],
)
def test_no_digest_goes_unchecked(client: Client, fields: list[tuple[str, str]], status: int, code: str) -> None:
    drive_id = client.create()
    answer = client.put(f"/v1/drives/{drive_id}/files/{NAME}", content=png(), headers=httpx.Headers(fields))
    if status == 201:
        assert answer.status_code == 201, answer.text
    else:
        problem_of(answer, status, code)
    if code == "malformed-digest":
        assert answer.headers["want-content-digest"] == "sha-256=10"


def test_an_archive_that_the_quota_has_no_room_for_is_refused_before_it_comes(api: Api) -> None:
    client = api.client(max_bytes=100_000)
    drive = tiny_drive()
    drive_id = client.create(drive)
    with connected(api) as connection:
        connection.sendall(
            f"PUT /v1/drives/{drive_id}/archive HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {client.key}\r\n"
            "Content-Length: 40000000\r\nExpect: 100-continue\r\n\r\n".encode()
        )
        assert connection.recv(100).startswith(b"HTTP/1.1 413 ")
    zipped = drive.zipped()
    assert client.put(f"/v1/drives/{drive_id}/archive", content=zipped).status_code == 200
    with api.database.write() as session:
        used = api.project(client.project_id).used_bytes
        session.get_one(type(api.project(client.project_id)), client.project_id).max_bytes = used
    assert client.put(f"/v1/drives/{drive_id}/archive", content=zipped).status_code == 200, "it may come once more"
