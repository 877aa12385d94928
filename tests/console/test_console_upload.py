"""A drive that is uploaded in the browser: only what its manifest names, and only once."""

from __future__ import annotations

import io
import json
import tarfile
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Page, Request, Route, expect

from tests.console.conftest import Open, World, go, log_in
from tests.helpers.live_api import Client
from tests.helpers.slow import slow
from tests.helpers.tiny_drive import TinyDrive, manifest, png, tiny_drive

PIECE_BYTES = 8 << 20
LONG_FRAMES = 2600  # of two cameras: more files than a list on a page has entries
TRIES = 6
# A page with this script waits a fiftieth of the time before it tries again.
IMPATIENT = "const wait = window.setTimeout; window.setTimeout = (work, ms) => wait(work, ms / 50);"


def folder_of(drive: TinyDrive, folder: Path) -> Path:
    for path, data in {**drive.files, "drive.json": drive.raw, "notes.txt": b"mine", "more/a.bin": b"x"}.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    return folder


def upload(page: Page, url: str, what: Path) -> list[str]:
    """Upload a folder or an archive; the paths of the files that were sent."""
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if request.method == "PUT" else None)
    go(page, url, "upload")
    choose(page, what)
    page.locator("[data-step=done],[role=alert]").wait_for()
    assert page.get_by_role("alert").all_inner_texts() == []
    return [urlsplit(one).path.partition("/files/")[2] for one in sent]


def choose(page: Page, what: Path) -> None:
    page.locator(f"input[name={'folder' if what.is_dir() else 'archive'}]").set_input_files(what)


@pytest.mark.parametrize("host", ["127.0.0.1", *slow("mrasfm.test")])
def test_a_folder_is_uploaded_once(open_console: Open, world: World, tmp_path: Path, host: str) -> None:
    """Also on a host name that is no secure context, where browsers have no crypto.subtle."""
    client, drive = world.api.client(), tiny_drive("uploaded", seed=f"uploaded {host}")
    folder = folder_of(drive, tmp_path / "drive")
    url = world.api.url.replace("127.0.0.1", host)
    watched = open_console(url)
    page = watched.new_page()
    log_in(page, url, client.key)
    assert page.evaluate("window.isSecureContext") is (host == "127.0.0.1")
    assert sorted(upload(page, url, folder)) == sorted(drive.files)
    expect(page.get_by_text("2 files of the folder are not named by the manifest and stay here.")).to_be_visible()
    (first,) = client.get("/v1/drives").json()["items"]
    assert (first["state"], first["files_stored"]) == ("COMMITTED", len(drive.files))
    assert upload(page, url, folder) == []
    assert len(client.get("/v1/drives").json()["items"]) == 2
    page.get_by_role("link", name="Open uploaded").click()
    page.get_by_role("heading", name="uploaded").wait_for()


def test_another_browser_goes_on(open_console: Open, world: World, tmp_path: Path) -> None:
    client, drive = world.api.client(), tiny_drive("interrupted", seed="interrupted", frames=12)
    folder = folder_of(drive, tmp_path / "drive")
    first = open_console(world.api.url).new_page()
    log_in(first, world.api.url, client.key)
    go(first, world.api.url, "upload")
    names = sorted(drive.files)

    def stop_later(route: Any) -> None:
        if stored_files(client) < len(names) // 4:
            route.continue_()

    first.route("**/files/**/*.png", stop_later)
    choose(first, folder)
    while stored_files(client) < len(names) // 4:
        first.wait_for_timeout(50)
    first.close()
    stored = {f["path"] for f in client.get(f"/v1/drives/{drive_of(client)}/files?stored=true").json()["items"]}
    assert len(names) // 4 <= len(stored) < len(names)
    second = open_console(world.api.url).new_page()
    log_in(second, world.api.url, client.key)
    sent = upload(second, world.api.url, folder)
    assert set(sent).isdisjoint(stored)
    assert 0 < len(sent) <= len(names) - len(stored)  # the service may have finished what the first had in flight
    assert client.get(f"/v1/drives/{drive_of(client)}").json()["state"] == "COMMITTED"


def drive_of(client: Client) -> str:
    (drive,) = client.get("/v1/drives").json()["items"]
    return str(drive["id"])


def stored_files(client: Client) -> int:
    return sum(drive["files_stored"] for drive in client.get("/v1/drives").json()["items"])


@pytest.mark.slow
def test_a_large_file_goes_in_pieces_and_on_in_another_browser(
    open_console: Open, world: World, tmp_path: Path
) -> None:
    client, drive = world.api.client(), tiny_drive("large", seed="large")
    name = next(iter(drive.files))
    drive.files[name] += bytes(2 * PIECE_BYTES + PIECE_BYTES // 2)  # after the picture's end
    folder = folder_of(drive, tmp_path / "drive")
    pieces: list[int] = []

    def page_of_a_new_browser(url: str) -> Page:
        page = open_console(url).new_page()
        log_in(page, url, client.key)
        page.on("request", lambda r: pieces.append(int(r.headers["upload-offset"])) if r.method == "PATCH" else None)
        return page

    first = page_of_a_new_browser(world.api.url)
    first.route(
        "**/uploads/*", lambda route: route.continue_() if len(pieces) < 2 else None
    )  # the second is on its way
    go(first, world.api.url, "upload")
    choose(first, folder)
    while len(pieces) < 2:
        first.wait_for_timeout(20)
    first.close()
    assert pieces == [0, PIECE_BYTES]
    insecure = world.api.url.replace("127.0.0.1", "mrasfm.test")
    upload(page_of_a_new_browser(insecure), insecure, folder)
    # Of the piece that was cut the service may have a part; that piece at most comes twice.
    assert PIECE_BYTES <= pieces[2] < len(drive.files[name])
    stored = client.get(f"/v1/drives/{drive_of(client)}/files/{name}")
    assert stored.content == drive.files[name]


def with_large_file(name: str) -> tuple[TinyDrive, str]:
    """A drive with one file that is sent in two pieces, and that file's path."""
    drive = tiny_drive(name, seed=name)
    path = min(drive.files)
    drive.files[path] += bytes(PIECE_BYTES + 5000)  # after the picture's end
    return drive, path


def offset_of(request: Request) -> int:
    return int(request.headers["upload-offset"])


def test_a_large_file_goes_on_where_the_service_is(open_console: Open, world: World, tmp_path: Path) -> None:
    """An answer is lost, the upload is locked for a while, another browser sends a part: no byte comes twice."""
    client, (drive, path) = world.api.client(), with_large_file("lost answer")
    watched = open_console(world.api.url)
    watched.expected = ("ERR_CONNECTION_RESET", "status of 409", "status of 423")
    page = watched.new_page()
    page.add_init_script(IMPATIENT)
    methods: list[str] = []
    offsets: list[int] = []

    def append(request: Request, size_bytes: int) -> None:
        names = ("tus-resumable", "upload-offset", "content-type")
        headers = {name: request.headers[name] for name in names}
        client.patch(request.url, content=drive.files[path][offset_of(request) :][:size_bytes], headers=headers)

    def disturb(route: Route) -> None:
        request = route.request
        methods.append(request.method)
        if request.method == "PATCH":
            offsets.append(offset_of(request))
        match request.method, methods.count(request.method):
            case "PATCH", 1:
                append(request, PIECE_BYTES)
                route.abort("connectionreset")
            case "HEAD", 1:
                route.fulfill(status=423)
            case "PATCH", 2:
                append(request, 1000)
                route.continue_()
            case _:
                route.continue_()

    page.route("**/uploads/*", disturb)
    log_in(page, world.api.url, client.key)
    upload(page, world.api.url, folder_of(drive, tmp_path / "drive"))
    assert offsets == [0, PIECE_BYTES, PIECE_BYTES + 1000]
    assert client.get(f"/v1/drives/{drive_of(client)}/files/{path}").content == drive.files[path]


def test_a_large_file_that_gets_no_further_is_given_up(open_console: Open, world: World, tmp_path: Path) -> None:
    client, (drive, _) = world.api.client(), with_large_file("no further")
    watched = open_console(world.api.url)
    watched.expected = ("ERR_CONNECTION_RESET",)
    page = watched.new_page()
    page.add_init_script(IMPATIENT)
    offsets: list[int] = []

    def cut(route: Route) -> None:
        if route.request.method == "PATCH":
            offsets.append(offset_of(route.request))
        if len(offsets) > 1 and route.request.method == "PATCH":
            route.abort("connectionreset")
        else:
            route.continue_()

    page.route("**/uploads/*", cut)
    log_in(page, world.api.url, client.key)
    go(page, world.api.url, "upload")
    choose(page, folder_of(drive, tmp_path / "drive"))
    page.get_by_role("alert").wait_for()
    assert offsets == [0, *[PIECE_BYTES] * TRIES]


def test_a_corrected_image_replaces_the_one_that_was_sent(open_console: Open, world: World, tmp_path: Path) -> None:
    """As long as the drive is open; in one piece and in several."""
    client, (drive, large) = world.api.client(), with_large_file("corrected")
    small = max(drive.files)
    before = {
        path: png(seed=f"before {path}") if path in (small, large) else data for path, data in drive.files.items()
    }
    drive_id = client.create(drive)
    client.send_files(drive_id, TinyDrive(drive.manifest, before))
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, client.key)
    assert upload(page, world.api.url, folder_of(drive, tmp_path / "drive")) == [small]
    assert drive_of(client) == drive_id
    for path in (small, large):
        assert client.get(f"/v1/drives/{drive_id}/files/{path}").content == drive.files[path]


def paths_of(document: dict[str, Any]) -> list[str]:
    return sorted(image["file"] for frame in document["frames"] for image in frame["images"].values())


def test_all_files_of_a_long_drive_are_known(open_console: Open, world: World, tmp_path: Path) -> None:
    client, document = world.api.client(), manifest("long", frames=LONG_FRAMES)
    *others, last = paths_of(document)
    archive = archive_of(TinyDrive(document, dict.fromkeys(others, png())), tmp_path / "drive.zip")
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, client.key)
    go(page, world.api.url, "upload")
    choose(page, archive)
    missing = f"1 of {2 * LONG_FRAMES} files that the manifest names are missing: {last}."
    expect(page.get_by_role("alert")).to_contain_text(missing)


@pytest.mark.parametrize("frames", [501, *slow(LONG_FRAMES)])
def test_many_files_are_declared_in_parts(open_console: Open, world: World, tmp_path: Path, frames: int) -> None:
    """The service knows the content of all files but two, so that these alone are sent."""
    client, same = world.api.client(), png(seed="same")
    client.filled(TinyDrive(manifest("known"), dict.fromkeys(tiny_drive().files, same)))
    document = manifest("many", frames=frames)
    paths = paths_of(document)
    others = {path: png(seed=path) for path in (paths[0], paths[-1])}
    folder = folder_of(TinyDrive(document, {**dict.fromkeys(paths, same), **others}), tmp_path / "drive")
    page = open_console(world.api.url).new_page()
    page.set_default_timeout(60_000)  # a digest is taken of each file
    declared: list[int] = []

    def count(request: Request) -> None:
        if request.url.endswith("/files:declare"):
            declared.append(len(request.post_data_json["files"]))

    page.on("request", count)
    log_in(page, world.api.url, client.key)
    assert sorted(upload(page, world.api.url, folder)) == sorted(others)
    assert declared == [1000] * (len(paths) // 1000) + [len(paths) % 1000]
    newest, _ = client.get("/v1/drives").json()["items"]
    assert (newest["state"], newest["files_stored"]) == ("COMMITTED", len(paths))


def archive_of(drive: TinyDrive, path: Path, *, top: str = "my drive/", **others: bytes) -> Path:
    """An archive with a folder around the drive's files, of the kind that the path's suffix says."""
    members = {"drive.json": drive.raw, **drive.files}
    members = {top + name: data for name, data in members.items()} | {
        name.replace("__", "/"): data for name, data in others.items()
    }
    if path.suffix == ".zip":
        with zipfile.ZipFile(path, "w") as archive:
            for number, (name, data) in enumerate(members.items()):
                archive.writestr(name, data, zipfile.ZIP_DEFLATED if number % 2 else zipfile.ZIP_STORED)
        return path
    with tarfile.open(path, "w:gz" if path.suffix == ".gz" else "w") as tar:
        for name, data in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    return path


@pytest.mark.slow
def test_archives_are_uploaded_once(open_console: Open, world: World, tmp_path: Path) -> None:
    page = open_console(world.api.url).new_page()
    client = world.api.client()
    log_in(page, world.api.url, client.key)
    beside = {"my drive__.DS_Store": b"litter", "my drive__truth.tum": b"0 0 0 0 0 0 0 1"}
    beside["my drive__.mrasfm-upload.json"] = b"{}"
    for number, suffix in enumerate((".zip", ".tar", ".tar.gz"), 1):
        drive = tiny_drive(f"as {suffix}", seed=f"as {suffix}")
        path = archive_of(drive, tmp_path / f"drive{suffix}", **beside)
        assert sorted(upload(page, world.api.url, path)) == sorted(drive.files), suffix
        assert upload(page, world.api.url, path) == [], suffix
        drives = client.get("/v1/drives").json()["items"]
        assert len(drives) == 2 * number
        assert {one["state"] for one in drives} == {"COMMITTED"}
        name, data = list(drive.files.items())[-1]
        assert client.get(f"/v1/drives/{drives[0]['id']}/files/{name}").content == data


def test_an_archive_with_a_wrong_name_is_refused_before_its_bytes_are_sent(
    open_console: Open, world: World, tmp_path: Path
) -> None:
    page, client = open_console(world.api.url).new_page(), world.api.client()
    log_in(page, world.api.url, client.key)
    go(page, world.api.url, "upload")
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if request.method in ("PUT", "PATCH") else None)
    alert = page.get_by_role("alert")
    wrong = {
        "strange": ({"my drive__notes__mine.txt": b"mine"}, "'notes/mine.txt'", "Leave them out of the archive"),
        "outside": ({"..__..__etc__passwd": b""}, "'../../etc/passwd' leaves the drive's folder", "relative names"),
        "absolute": ({"__etc__passwd": b""}, "'/etc/passwd' has an absolute name", "relative names"),
    }
    for suffix in (".zip", ".tar", ".tar.gz"):
        for name, (others, says, remedy) in wrong.items():
            choose(page, archive_of(tiny_drive("wrong", seed="wrong"), tmp_path / f"{name}{suffix}", **others))
            expect(alert).to_contain_text(says)
            expect(alert).to_contain_text(remedy)
    (tmp_path / "drive.7z").write_bytes(b"7z\xbc\xaf\x27\x1c" + bytes(600))
    choose(page, tmp_path / "drive.7z")
    expect(alert).to_contain_text("packed with 7z")
    assert sent == []
    assert client.get("/v1/drives").json()["items"] == [], "no drive is left open"


@pytest.mark.slow
def test_what_is_dropped_is_taken(open_console: Open, world: World, tmp_path: Path) -> None:
    page, client = open_console(world.api.url).new_page(), world.api.client()
    log_in(page, world.api.url, client.key)
    drive = tiny_drive("dropped", seed="dropped")
    archive = archive_of(drive, tmp_path / "drive.zip", top="")
    for what in (folder_of(drive, tmp_path / "drive"), archive):
        go(page, world.api.url, "jobs")
        go(page, world.api.url, "upload")
        box = page.locator(".drop").bounding_box()
        assert box is not None
        at = {"x": box["x"] + 20, "y": box["y"] + 20}
        data = {"items": [], "files": [str(what)], "dragOperationsMask": 1}
        session = page.context.new_cdp_session(page)
        for kind in ("dragEnter", "dragOver", "drop"):
            session.send("Input.dispatchDragEvent", {"type": kind, **at, "data": data})
        page.locator("[data-step=done]").wait_for()
    states = [one["state"] for one in client.get("/v1/drives").json()["items"]]
    assert states == ["COMMITTED"] * 2


def test_what_is_dropped_beside_the_place_for_it_leaves_the_page(open_console: Open, world: World) -> None:
    """By default a browser opens the file in the page's place, which would end an upload."""
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, "upload")
    for kind in ("dragover", "drop"):
        event = f"new DragEvent('{kind}', {{bubbles: true, cancelable: true}})"
        assert page.evaluate(f"document.querySelector('h1').dispatchEvent({event})") is False


def test_a_drive_whose_commit_has_no_answer_is_asked_for_again(
    open_console: Open, world: World, tmp_path: Path
) -> None:
    """The service froze the drive: sent anew, the folder would be a second one."""
    client, drive = world.api.client(), tiny_drive("lost", seed="lost")
    watched = open_console(world.api.url)
    watched.expected = ("ERR_CONNECTION_RESET",)
    page = watched.new_page()
    page.add_init_script(IMPATIENT)
    log_in(page, world.api.url, client.key)
    lost: list[str] = []

    def lose_first(route: Route) -> None:
        if route.request.method != "POST" or route.request.url in lost:
            return route.fallback()
        lost.append(route.request.url)
        route.fetch()
        return route.abort("connectionreset")

    page.route("**/v1/drives", lose_first)
    page.route("**/v1/drives/*:commit", lose_first)
    upload(page, world.api.url, folder_of(drive, tmp_path / "drive"))
    assert len(lost) == 2
    (only,) = client.get("/v1/drives").json()["items"]
    assert only["state"] == "COMMITTED"


def test_an_upload_that_failed_sends_nothing_more(open_console: Open, world: World, tmp_path: Path) -> None:
    """Else it would go on beside the next one, and both would say how far they are."""
    client, drive = world.api.client(), tiny_drive("failed", seed="failed", frames=40)
    watched = open_console(world.api.url)
    watched.expected = ("422",)
    page = watched.new_page()
    log_in(page, world.api.url, client.key)
    go(page, world.api.url, "upload")
    refusal = {"type": "urn:mrasfm:problem:bad-image", "title": "No", "detail": "no image", "remedy": "Check it."}
    sent: list[str] = []

    def refuse_first(route: Route) -> None:
        sent.append(route.request.url)
        if len(sent) == 1:
            body = json.dumps(refusal)
            route.fulfill(status=422, body=body, content_type="application/problem+json")
        else:
            page.wait_for_timeout(20)
            route.fallback()

    page.route("**/files/**/*.png?*", refuse_first)
    choose(page, folder_of(drive, tmp_path / "drive"))
    expect(page.get_by_role("alert")).to_contain_text("no image")
    page.wait_for_timeout(1000)
    assert len(sent) < 10 < len(drive.files)


def test_a_folder_without_a_manifest_is_refused_with_a_remedy(open_console: Open, world: World, tmp_path: Path) -> None:
    page = open_console(world.api.url).new_page()
    log_in(page, world.api.url, world.client.key)
    go(page, world.api.url, "upload")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "a.txt").write_text("a")
    choose(page, tmp_path / "folder")
    expect(page.get_by_role("alert")).to_contain_text("There is no drive.json in it.")
    expect(page.get_by_role("alert")).to_contain_text("mrasfm import")
