"""The console while the service is away, slow to be asked, or has another version."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from playwright.sync_api import expect

from service.access.keys import KeyStore
from tests.service.console.conftest import Visit, given_key
from tests.service.console.world import frame
from tests.service.server import Server


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, str]]:
    """A service that lets a key send five requests a second, and its key."""
    folder = tmp_path_factory.mktemp("slow")
    _, key = KeyStore(folder / "data").create("ann", "admin")
    server = Server(folder, {"rate_per_key": 10, "rate_burst": 10}, key=key).wait()
    server.create_map("lab")
    for number in range(15):
        while server.enrol("lab", f"p{number}", frame(number % 2), sequence="walk").status_code == 429:
            time.sleep(0.1)
    yield server, key
    assert server.stop() == 0


def test_the_console_stays_within_the_rate(visit: Visit, slow: tuple[Server, str]) -> None:
    server, key = slow
    operator = visit(None, server=server)
    operator.page.add_init_script(given_key(key))
    operator.foresee("429")
    page = operator.go("maps/lab/places")
    pictures = page.locator(".thumbs img")
    pictures.nth(14).wait_for(timeout=19_000)
    expect(page.locator(".trouble")).to_have_count(0)


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


def test_live_answers_go_on_after_the_connection_was_lost(visit: Visit, slow: tuple[Server, str]) -> None:
    server, key = slow
    operator = visit(None, server=server)
    operator.page.add_init_script(given_key(key))
    operator.foresee("ERR_", "429", "Failed to fetch dynamically imported module")
    page = operator.go("maps/lab/live")
    page.get_by_text("listening").wait_for()
    page.context.set_offline(True)
    page.get_by_role("link", name="Places").click()
    page.get_by_text("The connection to the service is lost.").wait_for()
    page.get_by_role("link", name="Live").click()
    page.context.set_offline(False)
    page.get_by_text("listening").wait_for()
    answers = page.get_by_role("list", name="Answers").get_by_role("listitem")
    for _ in range(
        30
    ):  # the stream is opened anew once the connection is back; what is answered in between is not heard
        server.client.post("/v1/maps/lab/query", content=frame(0), headers={"Content-Type": "image/jpeg"})
        page.wait_for_timeout(300)
        if answers.count():
            break
    expect(answers.first).to_be_visible()


def test_a_page_of_another_version_asks_to_be_reloaded(visit: Visit) -> None:
    operator = visit("admin")
    page = operator.go("maps")
    operator.foresee("404", "Failed to fetch dynamically imported module")
    page.route("**/views/audit.js", lambda route: route.fulfill(status=404, body=""))
    page.get_by_role("link", name="Audit", exact=True).click()
    page.get_by_text("The view cannot be loaded").wait_for()
    page.unroute("**/views/audit.js")
    page.get_by_role("button", name="Reload the page").click()
    page.get_by_role("heading", name="Audit").wait_for()
