"""The check of a manifest alone, in the library and as a command."""

from __future__ import annotations

import copy
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mrasfm_engine.cli import main
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.preflight.drive_check import UnsoundDriveError, is_sound
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive, require_sound
from mrasfm_engine.scene.drive import matrix_from_pose, pose_from_matrix
from schemas import Pose
from schemas.findings import Finding
from schemas.manifest_check import check_manifest
from schemas.parsing import parse_manifest

Document = dict[str, Any]
WriteDrive = Callable[[Document], Path]


def parsed(document: Document, **options: Any) -> list[Finding]:
    return check_manifest(parse_manifest(json.dumps(document).encode()), **options)


def codes(findings: list[Finding]) -> list[str]:
    return [finding.code for finding in findings]


def one_frame(d: Document) -> None:
    d["frames"] = d["frames"][:1]


def milliseconds(d: Document) -> None:
    for frame in d["frames"]:
        frame["timestamp_us"] //= 1000
    del d["gnss"]


def inverted(d: Document) -> None:
    for camera in d["rig"]["cameras"]:
        pose = pose_from_matrix(se3.inverse(matrix_from_pose(Pose(**camera["rig_from_cam"]))))
        camera["rig_from_cam"] = pose.model_dump()


def one_camera(d: Document) -> None:
    for frame in d["frames"]:
        del frame["images"]["right"]
    del d["gnss"]


def rough_poses_elsewhere(d: Document) -> None:
    pose = {"rotation_xyzw": [0.0, 0.0, 0.0, 1.0], "translation_m": [0.0, 0.0, 0.0]}
    d["rough_poses"] = {"poses": [{"timestamp_us": 9_000_000, "world_from_rig": pose}]}


def gnss_goes_back(d: Document) -> None:
    d["gnss"]["samples"].reverse()


@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (one_frame, "too-few-frames"),
        (milliseconds, "frame-rate"),
        (inverted, "rig-axes"),
        (one_camera, "no-metric-scale"),
        (rough_poses_elsewhere, "rough-poses-not-covering"),
        (gnss_goes_back, "gnss-order"),
    ],
)
def test_needs_no_file(drive_document: Document, damage: Callable[[Document], None], code: str) -> None:
    assert parsed(drive_document) == []
    damage(drive_document)
    findings = parsed(drive_document)
    assert code in codes(findings)
    assert not is_sound(findings)


def test_gnss_that_is_not_used_is_not_checked(drive_document: Document) -> None:
    gnss_goes_back(drive_document)
    assert parsed(drive_document, use_gnss=False) == []


@pytest.mark.parametrize(
    ("step_us", "complaint"),
    [
        (1, "look like seconds"),
        (100, "look like milliseconds"),
        (10**8, "look like nanoseconds"),
        (10**11, "are not microseconds"),
    ],
)
def test_units_of_timestamps(drive_document: Document, step_us: int, complaint: str) -> None:
    for i, frame in enumerate(drive_document["frames"]):
        frame["timestamp_us"] = 10**12 + i * step_us
    (finding,) = parsed(drive_document, use_gnss=False)
    assert finding.code == "frame-rate"
    assert finding.what.endswith(f"their timestamps {complaint}")


def placed(d: Document, *positions_m: list[float], sigma_m: float | None = None) -> None:
    for camera, position_m in zip(d["rig"]["cameras"], positions_m, strict=True):
        camera["rig_from_cam"]["translation_m"] = position_m
        if sigma_m is not None:
            camera["sigma_translation_m"] = sigma_m


@pytest.mark.parametrize(
    ("right_m", "sigma_m", "is_known"),
    [(0.0, None, False), (0.0, 0.001, False), (0.03, None, False), (0.03, 0.001, True), (0.06, None, True)],
)
def test_a_rig_without_baselines_has_no_scale(
    drive_document: Document, right_m: float, sigma_m: float | None, is_known: bool
) -> None:
    """Cameras at one place, or closer than their sigmas: only positions of the vehicle can give a scale."""
    placed(drive_document, [1.5, 0.0, 1.6], [1.5, -right_m, 1.6], sigma_m=sigma_m)
    found = {finding.code: finding for finding in parsed(drive_document)}
    assert set(found) == (set() if is_known else {"baselines-missing"})
    assert is_sound([*found.values()])
    if not is_known:
        assert found["baselines-missing"].what.startswith("rig.cameras")
        assert "scale comes from GNSS alone" in found["baselines-missing"].what
        assert "translation_m" in found["baselines-missing"].remedy
    without = parsed(drive_document, use_gnss=False)
    assert codes(without) == ([] if is_known else ["no-metric-scale"])
    if not is_known:
        assert without[0].what.startswith("rig.cameras: all cameras are ")
        assert not is_sound(without)
        pose = {"rotation_xyzw": [0.0, 0.0, 0.0, 1.0], "translation_m": [0.0, 0.0, 0.0]}
        times_us = [frame["timestamp_us"] for frame in drive_document["frames"]]
        drive_document["rough_poses"] = {"poses": [{"timestamp_us": t, "world_from_rig": pose} for t in times_us]}
        assert codes(parsed(drive_document, use_gnss=False)) == ["baselines-missing"]


def test_a_rig_longer_than_any_vehicle(drive_document: Document) -> None:
    """The front and the back camera of a bus, and a stereo pair in centimetres."""
    placed(drive_document, [12.0, 0.0, 2.5], [0.0, 0.0, 2.5])
    assert parsed(drive_document) == []
    placed(drive_document, [0.0, 27.0, 90.0], [0.0, -27.0, 90.0])
    (finding,) = parsed(drive_document)
    assert finding.code == "rig-extent"
    assert "are 54.0 m apart" in finding.what
    assert "centimetres" in finding.remedy
    assert is_sound([finding])


def test_body_axes_are_converted(drive_document: Document, write_drive: WriteDrive) -> None:
    """Upright cameras of a rig whose axes are the camera's: x right, y down, z forward."""
    drive_document["rig"]["body_axes"] = "rdf"
    for camera in drive_document["rig"]["cameras"]:
        camera["rig_from_cam"]["rotation_xyzw"] = [0.0, 0.0, 0.0, 1.0]
    assert parsed(drive_document) == []
    assert check_drive(read_drive(write_drive(drive_document))) == []
    drive_document["rig"]["body_axes"] = "flu"
    assert "rig-axes" in codes(parsed(drive_document))


def test_check_of_the_drive_is_that_and_the_files(drive_document: Document, write_drive: WriteDrive) -> None:
    drive_document["frames"][1]["images"]["left"]["timestamp_us"] = drive_document["frames"][1]["timestamp_us"] + 70_000
    gnss_goes_back(drive_document)
    root = write_drive(drive_document)
    (root / "images/left/000002.png").unlink()
    assert codes(parsed(drive_document)) == ["gnss-order", "unsynchronised"]
    findings = check_drive(read_drive(root))
    assert codes(findings) == ["gnss-order", "missing-file", "unsynchronised"]
    with pytest.raises(UnsoundDriveError) as caught:
        require_sound(findings)
    assert isinstance(caught.value, InputError)
    assert caught.value.findings == tuple(findings)
    assert (caught.value.code, caught.value.what) == ("gnss-order", findings[0].what + " (1 more error)")


def program(raw: bytes, *, memory_mb: int = 800) -> subprocess.CompletedProcess[bytes]:
    """The check as the service runs it, in a process that loads nothing else."""
    command = [sys.executable, "-m", "schemas.manifest_check", str(memory_mb)]
    return subprocess.run(command, input=raw, capture_output=True, timeout=60, check=False)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, Document]:
    code = main(["preflight", *map(str, arguments), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_program_on_a_manifest(drive_document: Document) -> None:
    result = program(json.dumps(drive_document).encode())
    assert (result.returncode, json.loads(result.stdout), result.stderr) == (0, {"findings": []}, b"")
    gnss_goes_back(drive_document)
    (finding,) = json.loads(program(json.dumps(drive_document).encode()).stdout)["findings"]
    assert (finding["code"], finding["severity"]) == ("gnss-order", "error")
    assert "gnss.samples.1.timestamp_us goes back" in finding["what"]
    (finding,) = json.loads(program(b"{}").stdout)["findings"]
    assert (finding["code"], finding["severity"]) == ("bad-document", "error")
    assert "rig: is missing" in finding["what"]


def test_command_on_a_manifest(drive_document: Document, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "upload-1"
    path.write_text(json.dumps(drive_document), encoding="utf-8")
    assert run(capsys, "--manifest-only", path) == (0, {"findings": [], "sound": True})
    gnss_goes_back(drive_document)
    path.write_text(json.dumps(drive_document), encoding="utf-8")
    assert main(["preflight", "--manifest-only", str(path)]) == 2
    printed = capsys.readouterr().out
    assert "error: gnss.samples.1.timestamp_us goes back" in printed
    assert "cannot be reconstructed" in printed


def test_program_loads_only_what_it_needs() -> None:
    script = "import sys, schemas.manifest_check; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert "schemas.gnss_check" in loaded
    assert {"numba", "pyproj", "scipy", "rich", "mrasfm_engine", "sqlalchemy"} & set(loaded) == set()


def test_command_on_a_folder(
    drive_document: Document, write_drive: WriteDrive, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_drive(drive_document)
    assert run(capsys, root) == (0, {"findings": [], "sound": True})
    (root / "images/left/000002.png").unlink()
    code, printed = run(capsys, root)
    assert (code, printed["sound"]) == (2, False)
    assert [finding["code"] for finding in printed["findings"]] == ["missing-file"]
    assert set(printed["findings"][0]) == {"severity", "code", "what", "remedy"}
    assert run(capsys, root, "--manifest-only")[0] == 0


def test_command_without_gnss(drive_document: Document, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gnss_goes_back(drive_document)
    path = tmp_path / "drive.json"
    path.write_text(json.dumps(drive_document), encoding="utf-8")
    assert run(capsys, path, "--manifest-only")[0] == 2
    assert run(capsys, path, "--manifest-only", "--no-gnss") == (0, {"findings": [], "sound": True})


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"{", "is not valid JSON"),
        (b"\xff", "is not UTF-8"),
        (b'{"name": NaN}', "NaN"),
        (b"[" * 100_000, "nested too deeply"),
        (b"{}", "rig: is missing"),
    ],
)
def test_command_on_a_broken_manifest(
    tmp_path: Path, content: bytes, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "upload-7f3a"
    path.write_bytes(content)
    code, printed = run(capsys, path, "--manifest-only")
    (finding,) = printed["findings"]
    assert (code, printed["sound"], finding["severity"]) == (2, False, "error")
    assert words in finding["what"]
    assert "drive.json" in finding["what"]
    assert "upload-7f3a" not in finding["what"]
    assert finding["remedy"]


def only_equals_one(d: Document) -> None:
    d["version"] = True


def differ_in_case(d: Document) -> None:
    left, right = (d["frames"][0]["images"][name] for name in ("left", "right"))
    left["file"], right["file"] = "images/A.png", "images/a.png"


@pytest.mark.parametrize(("change", "words"), [(only_equals_one, "version"), (differ_in_case, "is one file with")])
def test_command_on_what_only_new_drives_may_not_have(
    drive_document: Document,
    write_drive: WriteDrive,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[Document], None],
    words: str,
) -> None:
    change(drive_document)
    root = write_drive(drive_document)
    for options in ([], ["--manifest-only"]):
        code, printed = run(capsys, root, *options)
        (finding,) = printed["findings"]
        assert (code, finding["code"], finding["severity"]) == (2, "bad-document", "error")
        assert words in finding["what"]
        assert "Correct" in finding["remedy"]
    assert main(["reconstruct", str(root), "--out", str(root.parent / "scene")]) == 2
    assert words in capsys.readouterr().err
    assert check_drive(read_drive(root)) == []


def test_command_on_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options in ([], ["--manifest-only"]):
        code, printed = run(capsys, tmp_path / "nowhere", *options)
        assert code == 2
        assert "does not exist" in printed["findings"][0]["what"]
    code, printed = run(capsys, tmp_path)
    assert (code, printed["findings"][0]["code"]) == (2, "no-manifest")


def test_monstrous_manifest_is_read_in_bounded_memory(drive_document: Document) -> None:
    """Twelve megabytes that unpack to many hundred."""
    monstrous = copy.deepcopy(drive_document)
    monstrous["frames"] = []
    text = json.dumps(monstrous).replace('"frames": []', '"frames": [' + ",".join(["{}"] * 3_900_000) + "]")
    result = program(text.encode(), memory_mb=200)
    assert result.stdout == b""
    assert result.returncode in (-signal.SIGABRT, -signal.SIGSEGV) or b"MemoryError" in result.stderr
