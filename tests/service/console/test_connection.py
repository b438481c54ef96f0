"""The console while the service is away, slow to be asked, or has another version."""

from __future__ import annotations

import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
from playwright.sync_api import expect

from service.access.keys import Keys
from tests.service.console.conftest import Visit, given_key
from tests.service.console.world import frame
from tests.service.server import Server

JPEG = {"Content-Type": "image/jpeg"}


class Cable:
    """The way to a service, which can be cut: what is open breaks off, and nothing can be opened."""

    def __init__(self, port: int) -> None:
        self._service, self._whole = port, True
        self._open: list[socket.socket] = []
        self._cutting = threading.Lock()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listening.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listening.accept()
                with self._cutting:  # so that none is opened while it is cut
                    if not self._whole:
                        near.close()
                        continue
                    far = socket.create_connection(("127.0.0.1", self._service))
                    self._open += [near, far]
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=self._pass, args=ends, daemon=True).start()

    @staticmethod
    def _pass(source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                target.sendall(data)
            target.shutdown(socket.SHUT_WR)

    def cut(self) -> None:
        """Break off what is open."""
        with self._cutting:
            self._whole = False
            while self._open:
                with suppress(OSError):
                    self._open.pop().shutdown(socket.SHUT_RDWR)

    def mend(self) -> None:
        """Let connections be opened again."""
        self._whole = True

    def close(self) -> None:
        """End it."""
        self.cut()
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, str]]:
    """A service that lets a key send five requests a second, and its key."""
    folder = tmp_path_factory.mktemp("slow")
    _, key = Keys.of(folder / "data").create("ann", "admin")
    server = Server(folder, {"rate_per_key": 10, "rate_burst": 10}, key=key).wait()
    server.create_map("lab")
    for number in range(15):
        while server.enrol("lab", f"p{number}", frame(number % 2), sequence="walk").status_code == 429:
            time.sleep(0.1)
    yield server, key
    assert server.stop() == 0


@pytest.mark.thorough
def test_the_console_stays_within_the_rate(visit: Visit, slow: tuple[Server, str]) -> None:
    server, key = slow
    operator = visit(None, server=server)
    operator.page.add_init_script(given_key(key))
    operator.foresee("429")
    page = operator.go("maps/lab/places")
    pictures = page.locator(".thumbs img")
    pictures.nth(14).wait_for(timeout=19_000)
    expect(page.locator(".trouble")).to_have_count(0)


@pytest.mark.thorough
def test_a_lost_connection_is_said_and_mended_without_reloading(visit: Visit, slow: tuple[Server, str]) -> None:
    server, key = slow
    operator = visit(None, server=server)
    operator.page.add_init_script(given_key(key))
    operator.foresee("ERR_", "429", "Failed to fetch dynamically imported module")
    page = operator.go("jobs")
    page.evaluate("window.notReloaded = true")
    # As a cable that is pulled: the browser gets no answer at all.
    page.context.set_offline(True)
    page.get_by_text("The connection to the service is lost.").wait_for()
    page.context.set_offline(False)
    page.get_by_text("The connection to the service is lost.").wait_for(state="detached")
    page.get_by_text("No jobs").wait_for()
    assert page.evaluate("window.notReloaded")


@pytest.fixture
def cable(slow: tuple[Server, str]) -> Iterator[Cable]:
    """The way to the service."""
    made = Cable(slow[0].port)
    yield made
    made.close()


@pytest.mark.thorough
def test_live_answers_go_on_after_the_last_one_that_was_heard(
    visit: Visit, slow: tuple[Server, str], cable: Cable
) -> None:
    server, key = slow
    operator = visit(None, server=server)
    operator.root = f"http://127.0.0.1:{cable.port}"
    operator.page.add_init_script(given_key(key))
    operator.foresee("ERR_", "429", "404")
    server.create_map("live")
    page = operator.go("maps/live/live")
    lines = page.get_by_role("list", name="Answers").get_by_role("listitem")
    missing, lost = page.get_by_text("missing here"), page.get_by_text("The connection to the service is lost.")

    def ask(number: int) -> None:
        while server.client.post("/v1/maps/live/query", content=frame(number), headers=JPEG).status_code == 429:
            time.sleep(0.1)

    page.get_by_text("listening").wait_for()
    ask(0)
    expect(lines).to_have_count(1)
    cable.cut()
    lost.wait_for()
    ask(1)
    cable.mend()
    expect(lines).to_have_count(2)  # what was answered in between
    page.get_by_text("listening").wait_for()
    ask(2)
    expect(lines).to_have_count(3)  # and nothing twice
    expect(missing).to_have_count(0)

    cable.cut()
    lost.wait_for()
    server.client.delete("/v1/maps/live").raise_for_status()  # what was told is forgotten, as after a restart
    server.create_map("live")
    cable.mend()
    expect(lines.first).to_contain_text("Answers may be missing here")
    expect(lines).to_have_count(4)


@pytest.mark.thorough
def test_a_service_that_hangs_is_noticed_within_ten_seconds(visit: Visit, slow: tuple[Server, str]) -> None:
    server, key = slow
    operator = visit(None, server=server, alone=True)
    operator.page.add_init_script(given_key(key))
    operator.foresee("429")
    page = operator.page
    page.clock.install()
    operator.go("maps/lab/live")
    page.get_by_text("listening").wait_for()
    lost = page.get_by_text("The connection to the service is lost.")
    server.process.send_signal(signal.SIGSTOP)  # its connections stay open, and nothing comes
    try:
        page.clock.fast_forward(10_000)
        lost.wait_for()
        page.get_by_text("connecting").wait_for()
    finally:
        server.process.send_signal(signal.SIGCONT)
    lost.wait_for(state="detached")
    page.get_by_text("listening").wait_for()


@pytest.mark.thorough
def test_a_view_that_was_not_visited_waits_for_the_service(
    visit: Visit, slow: tuple[Server, str], cable: Cable
) -> None:
    _, key = slow
    operator = visit(None)
    operator.root = f"http://127.0.0.1:{cable.port}"
    operator.page.add_init_script(given_key(key))
    operator.foresee("ERR_", "429", "Failed to fetch dynamically imported module")
    page = operator.go("maps")
    page.evaluate("window.notReloaded = true")
    cable.cut()
    page.get_by_role("link", name="Service", exact=True).click()
    page.get_by_text("The connection to the service is lost.").wait_for()
    page.get_by_text("It is shown as soon as the service can be reached.").wait_for()
    expect(page.get_by_role("button", name="Reload the page")).to_have_count(0)
    cable.mend()
    page.get_by_text("Encoder's queue").wait_for()
    assert page.evaluate("window.notReloaded")


def test_a_page_of_another_version_asks_to_be_reloaded(visit: Visit) -> None:
    operator = visit("admin")
    page = operator.go("maps")
    operator.foresee("404", "Failed to fetch dynamically imported module")
    page.route("**/views/audit.js*", lambda route: route.fulfill(status=404, body=""))
    page.get_by_role("link", name="Audit", exact=True).click()
    page.get_by_text("The view cannot be loaded").wait_for()
    page.unroute("**/views/audit.js*")
    page.get_by_role("button", name="Reload the page").click()
    page.get_by_role("heading", name="Audit").wait_for()
