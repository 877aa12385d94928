from __future__ import annotations

from pathlib import Path

import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers.tables import read_gnss_csv

HEADER = "timestamp_us,latitude_deg,longitude_deg,ellipsoidal_height_m,sigma_horizontal_m,sigma_vertical_m"
ROWS = [f"{100_000 * i},{49 + i / 1000},8.4,{110 + i},0.5,1.0" for i in range(4)]


def refused(file: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_gnss_csv(file)
    assert str(file) in caught.value.what
    assert caught.value.remedy
    return caught.value.what


def test_columns_are_found_by_name(tmp_path: Path) -> None:
    file = tmp_path / "gnss.csv"
    names = HEADER.split(",")
    shuffled = [
        ",".join(["fix", *(f'"{name}"' for name in reversed(names))]),
        *(",".join(["3", *reversed(row.split(","))]) for row in ROWS),
    ]
    file.write_text("\ufeff" + "\r\n".join(shuffled) + "\r\n\r\n", encoding="utf-8")
    samples = read_gnss_csv(file)
    assert [sample.timestamp_us for sample in samples] == [0, 100_000, 200_000, 300_000]
    assert [sample.height_m for sample in samples] == [110, 111, 112, 113]
    assert (samples[3].latitude_deg, samples[3].longitude_deg) == (49.003, 8.4)
    assert (samples[3].sigma_horizontal_m, samples[3].sigma_vertical_m) == (0.5, 1.0)


@pytest.mark.parametrize(
    ("line", "new", "message"),
    [
        (1, HEADER.replace("latitude_deg", "lat"), "line 1: has no column 'latitude_deg'"),
        (1, HEADER + ",timestamp_us", "line 1: has more than one column 'timestamp_us'"),
        (3, "100000,49,8.4,110", "line 3: has 4 values, the header has 6"),
        (3, "100000,49,8.4,high,0.5,1", "line 3, column ellipsoidal_height_m: 'high' is not a number"),
        (3, "0.1,49,8.4,110,0.5,1", "line 3, column timestamp_us: '0.1' is not an integer number of microseconds"),
        (3, "-5,49,8.4,110,0.5,1", "line 3, column timestamp_us: -5 is not a time"),
        (3, "100000,nan,8.4,110,0.5,1", "line 3, column latitude_deg: nan is not a finite number"),
        (3, "100000,98.4,49,110,0.5,1", "are latitude and longitude swapped?"),
        (3, "100000,49,8.4,inf,0.5,1", "line 3, column ellipsoidal_height_m: inf is not a finite number"),
        (3, "100000,49,8.4,110,0,1", "line 3, column sigma_horizontal_m: 0 must be a standard deviation above zero"),
        (3, "100000,49,8.4,110,0.5,-1", "line 3, column sigma_vertical_m: -1 must be"),
        (3, "1" + "0" * 400 + ",49,8.4,110,0.5,1", "line 3, column timestamp_us"),
        (3, "1714730400000000000,49,8.4,110,0.5,1", "1714730400000000000 is not a time in microseconds"),
    ],
)
def test_bad_tables(tmp_path: Path, line: int, new: str, message: str) -> None:
    lines = [HEADER, *ROWS]
    lines[line - 1] = new
    (tmp_path / "gnss.csv").write_text("\n".join(lines))
    assert message in refused(tmp_path / "gnss.csv")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (HEADER.encode() + b"\n\n", "has no samples"),
        (b"\xff\xfe\x00", "is not a text file"),
        (b"", "is empty"),
        (b"\n\n", "line 1: has no column 'timestamp_us'"),
        (HEADER.encode() + b'\n"0,1,2', "line 2: has 3 values"),
        (HEADER.encode() + b"\n" + b"1" * 200_000 + b",49,8.4,110,0.5,1", "line 2, column timestamp_us"),
    ],
)
def test_what_is_no_table(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "gnss.csv").write_bytes(content)
    assert message in refused(tmp_path / "gnss.csv")


def test_missing_file(tmp_path: Path) -> None:
    assert "does not exist" in refused(tmp_path / "gnss.csv")
