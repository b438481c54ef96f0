"""Maps as files, over connections that are lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from placerec_client import Client, ConnectionFailed, JobCancelled, Map, NewPlace, Retry, TransferFailed, problems
from placerec_client._sync import transfers
from placerec_client.archives import check_archive
from tests.clients.python.fault_proxy import Fault, FaultProxy
from tests.service.scenes import jpeg
from tests.service.server import Server


@pytest.fixture
def full(lab: Map) -> Map:
    """A map whose file has several pieces."""
    lab.enrol(NewPlace(f"p{number}", jpeg(number, 64, 48)) for number in range(12))
    return lab


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces that are so small that a small file has many."""
    monkeypatch.setattr(transfers, "PIECE_BYTES", 100_000)
    monkeypatch.setattr(transfers, "CHUNK_BYTES", 50_000)


class After:
    """Nothing happens to so many pieces, and then this fault to all."""

    def __init__(self, pieces: int, fault: Fault) -> None:
        self.left, self._fault = pieces, fault

    def __call__(self, head: bytes) -> Fault:
        if b"/export" not in head:
            return "none"
        self.left -= 1
        return "none" if self.left >= 0 else self._fault


@pytest.mark.thorough
@pytest.mark.parametrize("fault", ["cut-before", "cut-answer"])
def test_a_download_goes_on_where_it_was(server: Server, full: Map, tmp_path: Path, fault: Fault) -> None:
    with (
        FaultProxy(server.port, choose=After(2, fault)) as way,
        Client(way.url, retry=Retry(0)) as client,
        pytest.raises(ConnectionFailed),
    ):
        client.maps[full.id].export(tmp_path / "lab.tar")
    assert (tmp_path / "lab.tar.part").stat().st_size == 200_000 and not (tmp_path / "lab.tar").exists()
    steps: list[int] = []
    tag = full.export(tmp_path / "lab.tar", progress=lambda done, size: steps.append(done))
    assert tag == check_archive(tmp_path / "lab.tar") and steps[0] == 300_000
    assert full.export(tmp_path / "again.tar") == tag
    assert (tmp_path / "again.tar").read_bytes() == (tmp_path / "lab.tar").read_bytes()


@pytest.mark.thorough
def test_a_download_and_an_upload_over_a_bad_network(server: Server, full: Map, tmp_path: Path) -> None:
    with FaultProxy(server.port, share=0.4, seed=5) as way, Client(way.url, retry=Retry(60, 0.02, 0.2)) as client:
        client.maps[full.id].export(tmp_path / "lab.tar")
        job = client.maps.import_(tmp_path / "lab.tar", id=f"{full.id}-again")
        assert job.wait().state == "succeeded"
    assert server.places(f"{full.id}-again").keys() == server.places(full.id).keys()


def test_a_part_that_belongs_to_another_state_of_the_map(full: Map, tmp_path: Path) -> None:
    (tmp_path / "lab.tar.part").write_bytes(b"what is no part of an export")
    assert full.export(tmp_path / "lab.tar")
    with pytest.raises(TransferFailed, match="already exists"):
        full.export(tmp_path / "lab.tar")
    content = bytearray((tmp_path / "lab.tar").read_bytes())
    content[-20_000] ^= 1
    (tmp_path / "lab.tar.part").write_bytes(content[:-9_000])
    with pytest.raises(TransferFailed, match="does not match its SHA-256"):
        full.export(tmp_path / "lab.tar", overwrite=True)
    assert not (tmp_path / "lab.tar.part").exists()
    check_archive(tmp_path / "lab.tar")


def test_nothing_is_sent_where_the_id_is_taken(full: Map, client: Client, tmp_path: Path) -> None:
    full.export(tmp_path / "lab.tar")
    sent: list[int] = []
    for map_id in (None, full.id):
        with pytest.raises(problems.MapExists, match="already"):
            client.maps.import_(tmp_path / "lab.tar", id=map_id, progress=lambda done, _size: sent.append(done))
    assert sent == []

    name = f"{full.id}-meanwhile"

    def overtake(done: int, _size: int) -> None:
        if not sent:
            client.maps.create(name)
        sent.append(done)

    with pytest.raises(problems.MapExists):
        client.maps.import_(tmp_path / "lab.tar", id=name, progress=overtake).wait()
    assert sent and client.maps[name].read().places == 0


def test_a_file_that_is_no_map(client: Client, tmp_path: Path) -> None:
    with pytest.raises(TransferFailed, match="cannot be read"):
        client.maps.import_(tmp_path / "nothing.tar")
    (tmp_path / "text.tar").write_bytes(b"text" * 1000)
    with pytest.raises(problems.InvalidArchive):
        client.maps.import_(tmp_path / "text.tar").wait()


@pytest.mark.thorough
def test_a_job_that_fails_or_is_cancelled(full: Map, client: Client) -> None:
    with pytest.raises(problems.ImagesMissing):
        full.reencode(f"{full.id}-new").wait()
    long = full.enrol_by_job([NewPlace(f"new-{number}", jpeg(number, 640, 480)) for number in range(60)])
    long.cancel()
    with pytest.raises(JobCancelled) as cancelled:
        long.wait()
    assert cancelled.value.job.id == long.id
    with pytest.raises(problems.UnknownJob):
        client.jobs["no-such-job"].wait()
