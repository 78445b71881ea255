"""Recordings: what is written is read back, what is wrong is refused, what is killed survives."""

from __future__ import annotations

import csv
import errno
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stiffopt.errors import FileError, InputError
from stiffopt.logs import (
    Body,
    Log,
    LogLayout,
    LogRow,
    LogWriter,
    McapLogWriter,
    StiffnessTable,
    read_log,
    read_mcap_log,
    read_stiffness_table,
    write_log,
    write_stiffness_table,
)
from stiffopt.logs.mcap_file import McapContents
from stiffopt.logs.mcap_log import log_of_contents

DATA = Path(os.environ.get("STIFFOPT_DATA", Path(__file__).resolve().parent.parent.parent)) / (
    "shared/data"
)
RECORDINGS = sorted(DATA.glob("*/*.csv"))
NAMES = "time_s,p1_pa,p2_pa,tip_x_m,tip_y_m,tip_z_m"
FULL = LogLayout(
    n=2, measured=True, tip_quaternion=True, bodies={"mid": True, "base": False}, force=True,
    stage=True,
)  # fmt: skip


def file_of(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode())
    return path


def random_log(count: int = 20, layout: LogLayout = FULL) -> Log:
    """A log that a file holds exactly: values in the steps in which they are written."""
    random = np.random.default_rng(1)

    def values(*shape: int, digits: int) -> np.ndarray:
        found = np.round(random.normal(size=(count, *shape)), digits)
        found[random.random(found.shape) < 0.2] = np.nan
        return found

    bodies = {
        name: Body(values(3, digits=7), values(4, digits=6) if turns else None)
        for name, turns in layout.bodies.items()
    }
    return Log(
        time=np.round(np.cumsum(random.uniform(0.01, 0.1, count)), 6),
        commanded=np.round(random.uniform(0, 1e5, (count, layout.n)), 1),
        measured=values(layout.n, digits=1) if layout.measured else None,
        tip_position=values(3, digits=7),
        tip_quaternion=values(4, digits=6) if layout.tip_quaternion else None,
        bodies=bodies,
        force=values(digits=6) if layout.force else None,
        stage=values(digits=7) if layout.stage else None,
    )


def assert_same(one: Log, other: Log) -> None:
    assert one.layout == other.layout
    for a, b in zip(one.rows(), other.rows(), strict=True):
        np.testing.assert_array_equal(a.values(one.layout), b.values(one.layout))


# -- reading --------------------------------------------------------------------------------------


@pytest.mark.skipif(not RECORDINGS, reason="the recordings are not here")
@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.name)
def test_real_recordings_are_read_as_a_plain_reader_reads_them(path: Path) -> None:
    log = read_log(path)
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(log) == len(rows)
    for i in (0, len(rows) // 2, -1):
        row = rows[i]
        assert log.time[i] == float(row["time_s"])
        assert log.commanded[i].tolist() == [float(row[f"p{k + 1}_pa"]) for k in range(log.n)]
        assert log.tip_position[i].tolist() == [float(row[f"tip_{axis}_m"]) for axis in "xyz"]
        if log.measured is not None:
            assert log.measured[i, -1] == float(row[f"pm{log.n}_pa"])
            assert log.bodies["mid"].quaternion is not None
            assert log.bodies["mid"].quaternion[i, 3] == float(row["mid_qz"])
    assert (log.n == 6) == ("asu" in str(path) or "2x55mm" in str(path))


def test_an_empty_field_is_missing_wherever_it_is(tmp_path: Path) -> None:
    log = read_log(file_of(tmp_path, f"{NAMES}\n0,,,,,\n1,5,,1e-3,,-.5\r\n2,,,,,7\n"))
    np.testing.assert_array_equal(log.time, [0, 1, 2])
    np.testing.assert_array_equal(log.commanded, [[np.nan] * 2, [5, np.nan], [np.nan] * 2])
    np.testing.assert_array_equal(log.tip_position[1], [1e-3, np.nan, -0.5])
    assert log.measured is None
    assert log.tip_quaternion is None


def test_columns_may_be_in_any_order(tmp_path: Path) -> None:
    log = read_log(file_of(tmp_path, "tip_z_m,time_s,p1_pa,tip_x_m,tip_y_m\n3,0,9,1,2\n"))
    assert log.tip_position.tolist() == [[1, 2, 3]]
    assert log.commanded.tolist() == [[9]]


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("", 1, "empty"),
        ("time_s,p1_pa,tip_x_m,tip_y_m\n0,1,2,3\n", 1, "'tip_z_m' is missing"),
        (f"{NAMES.replace('time_s', 'time')}\n", 1, "'time_s' is missing (is 'time' meant"),
        (f"{NAMES.replace('p1_pa', 'p3_pa')}\n", 1, "'p1_pa' is missing; a log"),
        (f"{NAMES.replace('p1_pa', 'p1_bar')}\n", 1, "'p1_pa' is missing (is 'p1_bar' meant"),
        (f"{NAMES.replace('tip_x_m', 'tip_x_mm')}\n", 1, "(is 'tip_x_mm' meant to be that, in m?)"),
        ("0,1,2,-3e-3,4,5\n1,1,2,3,4,5\n", 1, "starts with a row of numbers; expected a row of"),
        (f"{NAMES.replace('p2_pa', 'p2_kpa')}\n", 1, "'p2_kpa'; did you mean 'p2_pa'?"),
        ("time_s,p1_pa,x,y,z\n0,1,2,3,4\n", 1, "missing; nothing is known of 'x', 'y', 'z'"),
        (f"{NAMES.replace(',', ';')}\n0;1;2;3,5;4;5\n", 1, "by semicolons; expected commas"),
        (f"{NAMES.replace(',', chr(9))}\n0\t1\t2\t3\t4\t5\n", 1, "separated by tabs"),
        ("# A lab.\nformat: stiffopt-rig/1\nrobot: x\n", 2, "is a rig file; expected a table"),
        (f"{NAMES},pm1_pa\n0,1,2,3,4,5,6\n", 1, "'pm2_pa' is missing"),
        (f"{NAMES},tip_qw\n0,1,2,3,4,5,6\n", 1, "'tip_qx' is missing"),
        (f"{NAMES},mid_x_m\n0,1,2,3,4,5,6\n", 1, "'mid_y_m' is missing"),
        (f"{NAMES},forze_n\n0,1,2,3,4,5,6\n", 1, "'forze_n'; did you mean 'force_n'"),
        (f"{NAMES},p1_pa\n0,1,2,3,4,5,6\n", 1, "'p1_pa' appears twice"),
        (f"{NAMES}\n0,1,2,3,4,5\n1,1,2,3,4\n2,1,2,3,4,5\n", 3, "expected 6 fields, found 5"),
        (f"{NAMES}\n0,1,2,3,4,5\n1,1,2", 3, "cut short"),
        (f"{NAMES}\n0,1,2,3,4,5,6\n", 2, "expected 6 fields, found 7"),
        (f"{NAMES}\n0,1,2,3,4,5\n1,1,2,x,4,5\n", 3, "'x' is not a finite number"),
        (f"{NAMES}\n0,1,2,nan,4,5\n", 2, "'nan' is not a finite number"),
        (f"{NAMES}\n0,1,2,1e999,4,5\n", 2, "'1e999' is not a finite number"),
        (f"{NAMES}\n0,1,2,1-2,4,5\n", 2, "'1-2' is not a finite number"),
        (f"{NAMES}\n0,1,2, ,4,5\n", 2, "is not a finite number"),
        (f"{NAMES}\n0,1,2,3,4,5\n\n1,1,2,3,4,5\n", 3, "empty line"),
        (f"{NAMES}\n0,1,2,3,4,5\n,1,2,3,4,5\n", 3, "time_s is missing"),
        (f"{NAMES}\n0,1,2,3,4,5\n2,1,2,3,4,5\n1,1,2,3,4,5\n", 4, "must increase"),
        (f"{NAMES}\n0,1,2,3,4,5\n0,1,2,3,4,5\n", 3, "must increase"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_with_its_line(
    tmp_path: Path, text: str, line: int, words: str
) -> None:
    with pytest.raises(FileError) as caught:
        read_log(file_of(tmp_path, text))
    assert caught.value.line == line
    assert words in str(caught.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no such file"):
        read_log(tmp_path / "none.csv")
    with pytest.raises(FileError, match="is a folder"):
        read_log(tmp_path)


def test_a_log_without_rows(tmp_path: Path) -> None:
    assert len(read_log(file_of(tmp_path, f"{NAMES}\n"))) == 0


def test_a_long_log_is_read_fast(tmp_path: Path) -> None:
    """A fifth of a million rows, in a fifth of the seconds that a million may take."""
    one = "".join(f"{i * 0.001:.3f},100000.0,,0.0123456,-0.0123456,0.09\n" for i in range(200_000))
    path = file_of(tmp_path, f"{NAMES}\n{one}")
    begin = time.process_time()
    log = read_log(path)
    assert time.process_time() - begin < 3.0
    assert len(log) == 200_000
    assert np.isnan(log.commanded[:, 1]).all()


# -- writing --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "layout", [FULL, LogLayout(n=1), LogLayout(n=9, tip_quaternion=True)], ids=["full", "1", "9"]
)
def test_what_is_written_is_read_back(tmp_path: Path, layout: LogLayout) -> None:
    log = random_log(layout=layout)
    write_log(tmp_path / "a.csv", log)
    assert_same(read_log(tmp_path / "a.csv"), log)
    with McapLogWriter(tmp_path / "a.mcap", layout) as writer:
        for row in log.rows():
            writer.append(row)
    assert_same(read_mcap_log(tmp_path / "a.mcap"), log)


def test_a_writer_goes_on_where_a_file_ends(tmp_path: Path) -> None:
    path, log = tmp_path / "a.csv", random_log()
    rows = list(log.rows())
    with LogWriter(path, FULL) as writer:
        for row in rows[:7]:
            writer.append(row)
    with LogWriter(path, FULL) as writer:
        assert not writer.was_torn
        assert writer.last_time == pytest.approx(rows[6].time)
        for row in rows[7:]:
            writer.append(row)
    assert_same(read_log(path), log)


@pytest.mark.parametrize("keep", [1, 30])
def test_a_torn_last_line_is_cut_off_and_said(tmp_path: Path, keep: int) -> None:
    path, log = tmp_path / "a.csv", random_log()
    write_log(path, log)
    whole = path.read_bytes()
    last = whole.rstrip(b"\n").rfind(b"\n") + 1
    path.write_bytes(whole[: last + keep])
    with LogWriter(path, FULL) as writer:
        assert writer.was_torn
        assert writer.last_time == pytest.approx(log.time[-2])
        writer.append(list(log.rows())[-1])
    assert path.read_bytes() == whole


def test_a_header_that_is_torn_is_written_anew(tmp_path: Path) -> None:
    path = file_of(tmp_path, "time_s,p1")
    with LogWriter(path, LogLayout(n=1)) as writer:
        assert writer.was_torn
        writer.append(LogRow(0.0, [1.0], position=[1, 2, 3]))
    assert len(read_log(path)) == 1


def test_a_file_with_other_columns_is_left_alone(tmp_path: Path) -> None:
    path = file_of(tmp_path, f"{NAMES}\n0,1,2,3,4,5\n")
    with pytest.raises(FileError, match="other columns"):
        LogWriter(path, LogLayout(n=3))
    assert path.read_text() == f"{NAMES}\n0,1,2,3,4,5\n"


@pytest.mark.parametrize("kind", [LogWriter, McapLogWriter])
def test_rows_that_do_not_fit_are_refused(
    tmp_path: Path, kind: type[LogWriter] | type[McapLogWriter]
) -> None:
    with kind(tmp_path / "a", LogLayout(n=2)) as writer:
        writer.append(LogRow(1.0, [0, 0], position=[0, 0, 0]))
        for row in (
            LogRow(1.0, [0, 0]),
            LogRow(0.5, [0, 0]),
            LogRow(np.nan, [0, 0]),
            LogRow(2.0, [0, 0, 0]),
            LogRow(2.0, [0, 0], position=[0, 0]),
        ):
            with pytest.raises(InputError):
                writer.append(row)
        writer.append(LogRow(2.0, [0, 0], position=[np.inf, 0, 0]))
    read = read_log if kind is LogWriter else read_mcap_log
    log = read(tmp_path / "a")
    assert log.time.tolist() == [1, 2]
    assert np.isnan(log.tip_position[1, 0])


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    for kind in (LogWriter, McapLogWriter):
        with pytest.raises(FileError, match="cannot be written"):
            kind(tmp_path / "none" / "a", LogLayout(n=1))


WRITER = """
import sys
from stiffopt.logs import LogLayout, LogRow, LogWriter, McapLogWriter
kind = {"csv": LogWriter, "mcap": McapLogWriter}[sys.argv[1]]
writer = kind(sys.argv[2], LogLayout(n=3, measured=True, tip_quaternion=True))
i = 0
while True:
    writer.append(LogRow(i * 0.01, [i, 0, 0], [i, 1, 2], [i * 1e-4, 0, 0], [1, 0, 0, 0]))
    i += 1
    print(i, flush=True)
"""


@pytest.mark.parametrize("kind", ["csv", "mcap"])
def test_a_writer_that_is_killed_loses_no_whole_row(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a.{kind}"
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, kind, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    with process.stdout as told:
        for _ in range(300):
            said = int(told.readline())
        process.send_signal(signal.SIGKILL)
        said = max([said, *(int(line) for line in told if line.endswith("\n"))])
    process.wait(10)
    if kind == "csv":
        LogWriter(path, LogLayout(n=3, measured=True, tip_quaternion=True)).close()
    log = read_log(path) if kind == "csv" else read_mcap_log(path)
    assert said <= len(log) <= said + 1
    np.testing.assert_allclose(log.time, np.arange(len(log)) * 0.01)
    np.testing.assert_allclose(log.commanded[:, 0], np.arange(len(log)))


def test_an_mcap_file_that_ends_anywhere_gives_its_whole_rows(tmp_path: Path) -> None:
    path, log = tmp_path / "a.mcap", random_log(10)
    sizes = []
    with McapLogWriter(path, FULL) as writer:
        for row in log.rows():
            writer.append(row)
            sizes.append(path.stat().st_size)
    whole = path.read_bytes()
    for rows, size in enumerate(sizes[:4], start=1):
        for cut in range(size, sizes[rows], 37):
            path.write_bytes(whole[:cut])
            found = read_mcap_log(path)  # a row is whole before its index is
            assert len(found) in (rows, rows + 1)
            np.testing.assert_array_equal(found.time, log.time[: len(found)])


def test_a_file_without_chunks_as_earlier_versions_wrote_them_is_read(tmp_path: Path) -> None:
    import json

    from mcap.writer import Writer

    layout = LogLayout(n=2, measured=True, tip_quaternion=True, bodies={"mid": False}, force=True)
    rows = [
        {
            "/tip": {"position_m": [0.1 * k, None, 0.2], "quaternion_wxyz": None},
            "/body/mid": {"position_m": None, "quaternion_wxyz": None},
            "/force": {"force_n": 0.5, "stage_m": None},
            "/pressure": {"time_s": 0.1 * k, "commanded_pa": [1e4, 0.0], "measured_pa": [k, None]},
        }
        for k in range(3)
    ]
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start(library="stiffopt")
        columns = ",".join(layout.columns)
        writer.add_metadata("stiffopt-log", {"format": "stiffopt-log/1", "columns": columns})
        schema = writer.register_schema("stiffopt.any", "jsonschema", b"{}")
        channels = {topic: writer.register_channel(topic, "json", schema) for topic in rows[0]}
        for row in rows:
            for topic, message in row.items():
                writer.add_message(channels[topic], 0, json.dumps(message).encode(), 0)
    log = read_mcap_log(tmp_path / "a.mcap")
    assert log.layout == layout
    np.testing.assert_allclose(log.time, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(log.measured, [[0, np.nan], [1, np.nan], [2, np.nan]])
    np.testing.assert_allclose(log.tip_position[2], [0.2, np.nan, 0.2])
    assert log.tip_quaternion is not None
    assert np.isnan(log.tip_quaternion).all()
    assert np.isnan(log.bodies["mid"].position).all()
    np.testing.assert_array_equal(log.force, [0.5] * 3)


def test_a_disk_that_has_failed_takes_no_further_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, rows = tmp_path / "a.mcap", list(random_log(5).rows())
    with McapLogWriter(path, FULL) as writer:
        for row in rows[:2]:
            writer.append(row)
        with monkeypatch.context() as full:
            full.setattr(os, "write", _full)
            with pytest.raises(FileError, match="no space left"):
                writer.append(rows[2])
        with pytest.raises(FileError, match="cannot be written: the file is closed"):
            writer.append(rows[3])  # also where there is room again: a row in between is lost
    assert len(read_mcap_log(path)) == 2


def _full(file: int, data: bytes) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize(
    "message", [{"commanded_pa": [0]}, {"time_s": None, "commanded_pa": [0]}, [1], 3]
)
def test_a_row_of_an_mcap_file_without_a_time_is_refused(message: object) -> None:
    columns = {"columns": "time_s,p1_pa,tip_x_m,tip_y_m,tip_z_m"}
    found = McapContents({"stiffopt-log": columns}, [("/pressure", message)], complete=True)
    with pytest.raises(FileError, match=r"a\.mcap: is damaged"):
        log_of_contents("a.mcap", found)


def test_the_mcap_library_reads_the_messages(tmp_path: Path) -> None:
    import json

    from mcap.reader import make_reader

    path, log = tmp_path / "a.mcap", random_log(5)
    with McapLogWriter(path, FULL, {"rig": "bench"}) as writer:
        for row in log.rows():
            writer.append(row)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        topics = {channel.topic for channel in summary.channels.values()}
        messages = list(reader.iter_messages(topics=["/pressure"]))
    assert topics == {"/pressure", "/tip", "/force", "/body/mid", "/body/base"}
    assert [json.loads(message.data)["time_s"] for _, _, message in messages] == log.time.tolist()
    stamps = [message.log_time for _, _, message in messages]
    np.testing.assert_allclose(np.diff(stamps) * 1e-9, np.diff(log.time), atol=1e-6)


def test_a_log_that_begins_late_on_its_clock_has_the_date_of_today(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    path, (row, *_) = tmp_path / "a.mcap", random_log(5).rows()
    before = time.time_ns()
    with McapLogWriter(path, FULL, now=900.0) as writer:
        writer.append(replace(row, time=900.0))
    with path.open("rb") as stream:
        dates = [message.log_time for _, _, message in make_reader(stream).iter_messages()]
    assert dates
    assert all(before <= date <= time.time_ns() for date in dates)


@pytest.mark.parametrize("content", [b"", b"time_s,p1_pa\n", os.urandom(0) + b"\x89MCAP0\r\n"])
def test_what_is_no_mcap_recording(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(FileError, match="no MCAP recording"):
        read_mcap_log(path)


# -- tables of stiffness --------------------------------------------------------------------------


def table() -> StiffnessTable:
    return StiffnessTable(
        pressures=np.array([[0.0, 0.0, 0.0], [5e4, 0.0, 0.0]]),
        directions=np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]),
        boundaries=("free", "guided"),
        stiffness=np.array([14.25, np.nan]),
        sigma=np.array([0.125, np.nan]),
        others={"points": np.array([30.0, 0.0])},
    )


def test_a_table_of_stiffness_is_read_back(tmp_path: Path) -> None:
    write_stiffness_table(tmp_path / "k.csv", table())
    found = read_stiffness_table(tmp_path / "k.csv")
    for name in ("pressures", "directions", "stiffness", "sigma"):
        np.testing.assert_array_equal(getattr(found, name), getattr(table(), name))
    assert found.boundaries == ("free", "guided")
    assert found.others["points"].tolist() == [30, 0]


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("guided", "fixed", 3, "'fixed' is not one of free, guided, clamped"),
        ("14.25", "much", 2, "stiffness_n_per_m: 'much' is not a finite number"),
        ("14.25", "inf", 2, "'inf' is not a finite number"),
        ("0.125", "-0.125", 2, "negative"),
        ("0.6", "0.7", 3, "length 1.06"),
        ("50000", "", 3, "p1_pa: '' is not a finite number"),
        ("sigma_n_per_m", "sigma", 1, "'sigma_n_per_m' is missing"),
        (",30\n", "\n", 2, "expected 10 fields, found 9"),
    ],
)
def test_a_wrong_table_is_refused(
    tmp_path: Path, old: str, new: str, line: int, words: str
) -> None:
    path = tmp_path / "k.csv"
    write_stiffness_table(path, table())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(FileError) as caught:
        read_stiffness_table(path)
    assert (caught.value.line, words in str(caught.value)) == (line, True), str(caught.value)


def test_a_log_says_what_does_not_fit() -> None:
    with pytest.raises(InputError, match="tip_position must have the shape"):
        Log(np.zeros(2), np.zeros((2, 3)), np.zeros((3, 3)))
