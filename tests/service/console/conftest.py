"""A browser, a service with keys and a drawn map, and pages that fail where a browser complains."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Response, expect, sync_playwright

from service.access.keys import Keys
from tests.service.console import world
from tests.service.server import Server

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

PATIENCE = 15_000
"""Milliseconds for which a test waits for what it expects of a page."""

OUT_OF_PANEL = """[...document.querySelectorAll("main .panel")].flatMap((panel) => {
  const { right } = panel.getBoundingClientRect();
  return [...panel.querySelectorAll("*")]
    .filter((one) => one.getBoundingClientRect().right > right && !one.closest(".table, pre"))
    .map((one) => `${one.tagName}.${one.className} ${one.textContent.slice(0, 40)}`);
})"""
"""What a panel does not hold: parts that are wider than it, and not scrolled."""

EFFECTS = "() => new Promise((done) => requestAnimationFrame(() => setTimeout(done)))"
"""Lets the effects of what is drawn take place, by which a view listens, draws its canvases and reads more."""

SIZES = {"phone": (390, 844), "laptop": (1280, 800), "wall": (3840, 2160)}


@dataclass
class Operator:
    """Somebody in front of the console.

    Args:
        page: their browser's page.
        root: the address of the service.
        complaints: what the browser said on its console, what it refused, and answers of 5xx.
    """

    page: Page
    root: str
    complaints: list[str] = field(default_factory=list)
    foreseen: tuple[str, ...] = ()

    def go(self, view: str) -> Page:
        """Open a view, such as ``maps/lab/places``, and wait until it has read what it shows."""
        self.page.goto(f"{self.root}/console#/{view}")
        self.settle(view)
        return self.page

    def leave(self) -> None:
        """Go to an empty page, so that nothing of the service is read any more; a map may then be deleted."""
        self.page.goto("about:blank")

    def settle(self, view: str | None = None) -> None:
        """Wait until the view is there, nothing is being read, and it hears the mouse and the keyboard."""
        path = "" if view is None else f"[data-view='{view.partition('?')[0]}']"
        self.page.locator(f"main .view{path} h1").wait_for()
        loading = self.page.locator("main .loading")
        while True:
            expect(loading).to_have_count(0)
            self.page.evaluate(EFFECTS)
            if loading.count() == 0:  # what has come may have led to something else being read
                return

    def manage(self, map_id: str, action: str) -> None:
        """Choose an action, such as ``Edit``, from the menu of a map in the list."""
        self.page.get_by_role("button", name=f"Actions for {map_id}", exact=True).click()
        self.page.get_by_role("button", name=f"{action} {map_id}", exact=True).click()

    def foresee(self, *texts: str) -> None:
        """Complaints that contain one of these are part of the test."""
        self.foreseen += texts

    def unforeseen(self) -> list[str]:
        return [one for one in self.complaints if not any(text in one for text in self.foreseen)]

    def watch(self) -> None:
        def said(message: ConsoleMessage) -> None:
            if message.type in ("error", "warning"):
                self.complaints.append(f"{message.type}: {message.text} {message.location}")

        def answered(response: Response) -> None:
            if response.status >= 500:
                self.complaints.append(f"{response.status} {response.request.method} {response.url}")
            if not response.url.startswith((self.root, "blob:", "data:")):
                self.complaints.append(f"a request to elsewhere: {response.url}")

        self.page.on("console", said)
        self.page.on("pageerror", lambda error: self.complaints.append(f"exception: {error}"))
        self.page.on("response", answered)


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Chromium without a window; the tests are skipped where there is none."""
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    expect.set_options(timeout=PATIENCE)
    with sync_playwright() as playwright:
        options = ["--host-resolver-rules=MAP console.test 127.0.0.1"]
        options += ["--no-sandbox", "--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream"]
        running = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        yield running
        running.close()


@pytest.fixture(scope="package")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the service with keys."""
    return tmp_path_factory.mktemp("console")


@pytest.fixture(scope="package")
def keys(folder: Path) -> dict[str, str]:
    """A key of each role for all maps, and one of the role query for a map that is not there."""
    store = Keys.of(folder / "data")
    made = {role: store.create(f"{role}-key", role)[1] for role in ("admin", "enrol", "query")}
    return made | {"stranger": store.create("stranger-key", "query", ["elsewhere"])[1]}


@pytest.fixture(scope="package")
def keyed(folder: Path, keys: dict[str, str]) -> Iterator[Server]:
    """A service with keys, an audit trail in a file, and the drawn map; its client has an admin key."""
    settings = {"audit_file": folder / "audit.jsonl", "backup_dir": folder / "backups"}
    server = Server(folder, settings, key=keys["admin"]).wait()
    world.fill(server)
    world.ask(server)
    yield server
    assert server.stop() == 0


def given_key(key: str) -> str:
    """A script by which a new tab has a key, as if it had been typed; one that is forgotten stays so."""
    keep = f"sessionStorage.getItem('placerec.key') ?? sessionStorage.setItem('placerec.key', '{key}')"
    return f"if (location.protocol !== 'about:') {keep}"  # an empty page has no storage


Visit = Callable[..., Operator]
Theme = Literal["light", "dark"]


@pytest.fixture(scope="package")
def desk(browser: Browser) -> Iterator[BrowserContext]:
    """Where one page a test is opened: in a context of its own it would load and compile the whole console again."""
    made = new_context(browser)
    made.new_page()  # as long as there is one, what others have compiled is kept
    yield made
    made.close()


def new_context(browser: Browser) -> BrowserContext:
    context = browser.new_context(permissions=["clipboard-write", "camera"])
    context.set_default_timeout(PATIENCE)
    return context


@pytest.fixture
def visit(browser: Browser, desk: BrowserContext, keyed: Server, keys: dict[str, str]) -> Iterator[Visit]:
    """Makes operators, who know nothing of each other: ``visit("admin")``; at the end no page may have complained."""
    contexts: list[BrowserContext] = []
    made: list[Operator] = []

    def open_page(
        role: str | None = "admin",
        *,
        server: Server = keyed,
        size: str = "laptop",
        theme: Theme = "light",
        alone: bool = False,
    ) -> Operator:
        context = desk
        if made or alone:  # somebody else, at another machine, or one whose clock is set: it is that of a context
            context = new_context(browser)
            contexts.append(context)
        page = context.new_page()
        width, height = SIZES[size]
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(color_scheme=theme)
        if role is not None:
            page.add_init_script(given_key(keys[role]))
        operator = Operator(page, f"http://127.0.0.1:{server.port}")
        operator.watch()
        made.append(operator)
        return operator

    yield open_page
    for operator in (one for one in made if one.page.context == desk):
        desk.set_offline(False)
        forget = {"origin": operator.root, "storageTypes": "local_storage"}
        desk.new_cdp_session(operator.page).send("Storage.clearDataForOrigin", forget)
        operator.page.close()
    for context in contexts:
        context.close()
    assert [one for operator in made for one in operator.unforeseen()] == []


@pytest.fixture
def admin(visit: Visit) -> Operator:
    """Somebody with an admin key."""
    return visit("admin")
