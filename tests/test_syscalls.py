"""The audit of traces: it must see what is missing, not only pass what is right."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.syscalls import Report, audit, is_marker, is_success_response

ROOT = Path("/data")

OPEN = '7 openat(AT_FDCWD</>, "/data/a", O_WRONLY|O_CREAT|O_CLOEXEC, 0644) = 3</data/a>\n'
WRITE = '7 pwrite64(3</data/a>, "x) = 1"..., 1, 0) = 1\n'
SYNC = "7 fsync(3</data/a>) = 0\n"
SYNC_FOLDER = "7 fsync(4</data>) = 0\n"
FAILED_SYNC = "7 fsync(3</data/a>) = -1 EIO (Input/output error)\n"
BEGUN = "8 fsync(3</data/a> <unfinished ...>\n"
ENDED = "8 <... fsync resumed>) = 0\n"
RENAME = '7 rename("/data/a", "/data/b") = 0\n'
TRUNCATE = "7 ftruncate(3</data/a>, 10) = 0\n"
ACK = '7 write(1<pipe:[99]>, "ack done\\n", 9) = 9\n'


def read(trace: str, **options: object) -> Report:
    return audit(trace, ROOT, is_marker, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("trace", "unsynced"),
    [
        pytest.param(OPEN + WRITE + SYNC_FOLDER + ACK, ["/data/a (line 2)"], id="a file"),
        pytest.param(OPEN + WRITE + SYNC + ACK, ["/data (line 1)"], id="a folder"),
        pytest.param(OPEN + WRITE + SYNC_FOLDER + ACK + SYNC, ["/data/a (line 2)"], id="synced after it"),
        pytest.param(OPEN + SYNC + WRITE + SYNC_FOLDER + ACK, ["/data/a (line 3)"], id="synced before the write"),
        pytest.param(OPEN + WRITE + FAILED_SYNC + SYNC_FOLDER + ACK, ["/data/a (line 2)"], id="a sync that failed"),
        pytest.param(OPEN + SYNC_FOLDER + WRITE + BEGUN + ENDED + ACK, [], id="a sync in two parts"),
        pytest.param(OPEN + SYNC_FOLDER + BEGUN + WRITE + ENDED + ACK, ["/data/a (line 4)"], id="a write during it"),
        pytest.param(OPEN + SYNC_FOLDER + WRITE + BEGUN + ACK + ENDED, ["/data/a (line 3)"], id="not ended in time"),
        pytest.param(OPEN + SYNC_FOLDER + OPEN + WRITE + SYNC + ACK, [], id="opening it again makes no name"),
        pytest.param(OPEN + WRITE + SYNC_FOLDER + '7 unlink("/data/a") = 0\n' + ACK, [], id="removed"),
        pytest.param(
            OPEN + WRITE + SYNC_FOLDER + '7 unlinkat(4</data>, "a", 0) = 0\n' + ACK, [], id="removed by folder"
        ),
        pytest.param(OPEN + WRITE + SYNC + RENAME + SYNC_FOLDER + ACK, [], id="synced, then renamed"),
        pytest.param(OPEN + WRITE + SYNC + SYNC_FOLDER + RENAME + ACK, ["/data (line 5)"], id="the folder, renamed"),
        pytest.param(OPEN + WRITE + RENAME + SYNC_FOLDER + ACK, ["/data/b (line 2)"], id="the contents, renamed"),
        pytest.param(TRUNCATE + ACK, ["/data/a (line 1)"], id="truncation is a write"),
        pytest.param(TRUNCATE + "7 sync() = 0\n" + ACK, [], id="a sync of everything"),
    ],
)
def test_what_is_not_synced_before_an_acknowledgement(trace: str, unsynced: list[str]) -> None:
    found = [violation.split(": ")[2].removesuffix(" is not synced") for violation in read(trace).violations]
    assert found == unsynced


def test_a_report_counts() -> None:
    report = read(OPEN + WRITE + SYNC + SYNC_FOLDER + ACK)
    assert report == Report(acknowledgements=1, writes=1, syncs=2, violations=[])


def test_opening_a_file_that_existed_before_makes_no_name() -> None:
    assert read(OPEN + WRITE + SYNC + ACK, existing=[Path("/data/a")]).violations == []


def test_renaming_a_folder_takes_along_what_was_not_synced_in_it() -> None:
    made = (
        '7 mkdir("/data/new", 0777) = 0\n'
        '7 openat(5</data/new>, "f", O_RDWR|O_CREAT, 0644) = 6</data/new/f>\n'
        '7 write(6</data/new/f>, "x", 1) = 1\n'
        '7 renameat2(AT_FDCWD</>, "/data/new", AT_FDCWD</>, "/data/lab", RENAME_NOREPLACE) = 0\n'
    )
    report = read(made + SYNC_FOLDER + ACK)
    assert [violation.split(": ")[2].split(" ")[0] for violation in report.violations] == ["/data/lab", "/data/lab/f"]
    assert (
        read(made + SYNC_FOLDER + "7 fsync(5</data/lab>) = 0\n7 fdatasync(6</data/lab/f>) = 0\n" + ACK).violations == []
    )


def test_only_what_lies_in_the_root_counts_and_what_sqlite_rebuilds_does_not() -> None:
    elsewhere = OPEN.replace("/data", "/elsewhere") + WRITE.replace("/data", "/database")
    index = OPEN.replace("/a", "/m-shm") + WRITE.replace("/a", "/m-shm")
    report = read(elsewhere + index + ACK)
    assert (report.acknowledgements, report.writes, report.violations) == (1, 0, [])


def test_a_shared_mapping_for_writing_is_reported() -> None:
    mapping = "7 mmap(NULL, 4096, PROT_READ|PROT_WRITE, MAP_SHARED, 3</data/a>, 0) = 0x7f0000000000\n"
    assert len(read(mapping).violations) == 1
    assert read(mapping.replace("MAP_SHARED", "MAP_PRIVATE")).violations == []


def test_acknowledgements_are_recognized() -> None:
    assert is_marker(ACK.removeprefix("7 "))
    assert not is_marker('write(2<pipe:[99]>, "ack", 3) = 3')
    assert is_success_response('sendto(12<TCP:[1->2]>, "HTTP/1.1 201 Created\\r\\ndate"..., 200, 0, NULL, 0) = 200')
    assert is_success_response('writev(12<socket:[9]>, [{iov_base="HTTP/1.1 200 OK\\r\\n"..., iov_len=17}], 1) = 17')
    assert not is_success_response('sendto(12<socket:[9]>, "HTTP/1.1 404 Not Found\\r\\n"..., 200, 0, NULL, 0) = 200')
    assert not is_success_response('recvfrom(12<socket:[9]>, "HTTP/1.1 200 OK\\r\\n"..., 200, 0, NULL, 0) = 200')
