"""The console's pages in a browser with a large map: first paint, the plan, panning, the comparison of two traverses.

    python -m benchmarks.console.pages [--places 100000] [--frames 2000]

A server of its own holds a map of made-up descriptors for the plan, and one with the default encoder whose two
traverses of ``--frames`` places are compared.  The browser is the system's Chromium, without a window and without a
graphics processor: ``first paint`` is its own figure of the page of maps, with nothing in its cache; ``plan`` and
``matrix`` last from the address typed until the canvas is drawn; ``path`` is the way through the matrix, which is drawn
later; ``plan`` is the median of five, each beside the same page of the small map, ``plain``: how many times as long it
takes says the same on a fast and on a slow machine.
``frames a second`` are those of 120 steps of panning, each of which draws the whole plan.  ``requests`` are
those of the plan's page.  Beside the seconds is the processor time that the service and the browser had meanwhile,
which says more on a machine that others use.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from playwright.sync_api import Browser, Page, sync_playwright

from benchmarks.console.endpoints import fill
from benchmarks.process import Process, descendants, processor_time, service
from benchmarks.report import report, verdict
from core.maps import Enrolment, MapSettings
from core.method.catalogue import EncoderCatalogue
from core.places import PlaceFields, Pose
from core.store import Directory

STEPS, ROUNDS = 120, 5
DRAWN = """selector => {
  const canvas = document.querySelector(selector);
  if (!canvas || !canvas.width) return false;
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0);
  return new Uint32Array(copy.getImageData(0, 0, canvas.width, canvas.height).data.buffer).some(Boolean);
}"""
PAN = """steps => new Promise((done) => {
  const canvas = document.querySelector(".plan-canvas canvas[tabindex]");
  const began = performance.now();
  let step = 0;
  const next = () => {
    if (step === steps) return done(1000 * steps / (performance.now() - began));
    const key = Math.floor(step / 10) % 2 ? "ArrowLeft" : "ArrowRight";
    canvas.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
    step += 1;
    requestAnimationFrame(next);
  };
  requestAnimationFrame(next);
})"""


def fill_traverses(folder: Path, frames: int) -> None:
    """A map of the default encoder with two traverses, the second along the first; descriptors are made up."""
    random = np.random.default_rng(1)
    encoder = next(one for one in EncoderCatalogue(folder / "models").describe() if one.default)
    atlas = Directory(folder)
    two = atlas.create("two", encoder.identity, encoder.dimension, MapSettings(verification=False))
    first = random.standard_normal((frames, encoder.dimension), dtype=np.float32)
    for name in ("monday", "tuesday"):
        noise = random.standard_normal(first.shape, dtype=np.float32) if name == "tuesday" else 0.0
        rows = first + 0.7 * noise
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        items = [
            Enrolment(
                f"{name}-{number}",
                PlaceFields(pose=Pose(x=float(number), y=0.0), sequence=name),
                row,
                600,
                random.bytes(32),
            )
            for number, row in enumerate(rows)
        ]
        for start in range(0, frames, 500):
            two.enrol(items[start : start + 500])
    atlas.close()


class Clock:
    """Seconds, and the processor time of the service and of the browser, since it was made."""

    def __init__(self, server: Process) -> None:
        self._server = server
        self._began = time.perf_counter(), server.processor_time(), self._browser()

    def _browser(self) -> float:
        return sum(processor_time(pid) for pid in descendants(os.getpid()) - {self._server.pid})

    def read(self) -> Taken:
        now = time.perf_counter(), self._server.processor_time(), self._browser()
        return Taken(*(end - start for end, start in zip(now, self._began, strict=True)))


class Taken(NamedTuple):
    """The cost of an action: seconds, and the processor time of the service and of the browser."""

    seconds: float
    server: float
    browser: float


def open_page(browser: Browser, url: str, selector: str) -> tuple[Page, list[str]]:
    """A page on which a canvas is drawn, and its requests until then."""
    page = browser.new_context(viewport={"width": 1600, "height": 1000}, bypass_csp=True).new_page()
    requests: list[str] = []
    page.on("request", lambda request: requests.append(request.url))
    page.goto(url)
    page.wait_for_function(DRAWN, arg=selector, polling=50)
    return page, list(requests)


def first_paint(browser: Browser, url: str) -> float:
    """Seconds until something of the page of maps is painted."""
    page = browser.new_context().new_page()
    page.goto(url)
    page.locator("main h1").wait_for()
    entry = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
    return float(entry) / 1000


def main(
    places: Annotated[int, typer.Option(help="Places of the map whose plan is drawn.")] = 100_000,
    frames: Annotated[int, typer.Option(help="Places of each of the traverses that are compared.")] = 2000,
) -> None:
    """Measure, print a table and write JSON."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise typer.BadParameter("no Chromium is installed")
    with tempfile.TemporaryDirectory() as text, sync_playwright() as playwright:
        folder = Path(text)
        fill(folder / "data", places)
        fill_traverses(folder / "data", frames)
        with service(folder / "data") as server:
            for name in ("lab", "two"):
                server.client.get(f"/v1/maps/{name}/places?limit=1").raise_for_status()  # opens the map
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            console = f"{server.client.base_url}/console"
            paint = first_paint(browser, f"{console}#/maps")
            plans: list[Taken] = []
            plains: list[Taken] = []
            for _ in range(ROUNDS):
                for map_id, taken in (("two", plains), ("lab", plans)):
                    clock = Clock(server)
                    page, requests = open_page(browser, f"{console}#/maps/{map_id}/plan", ".plan-canvas canvas.places")
                    taken.append(clock.read())
                    if len(plans) < ROUNDS:
                        page.context.close()
                        time.sleep(1)  # until its process has ended, whose time would be missing later
            plan, plain = (Taken(*np.median(taken, axis=0).tolist()) for taken in (plans, plains))
            rate = float(page.evaluate(PAN, STEPS))
            page.context.close()
            time.sleep(1)  # until its process has ended, whose time would be missing at the end
            clock = Clock(server)
            page, _ = open_page(browser, f"{console}#/maps/two/traverses", ".matrix canvas")
            matrix = clock.read()
            page.get_by_text("path found").wait_for()
            path = clock.read()
            browser.close()
    found = {"first paint": paint, "plain": plain._asdict(), "plan": plan._asdict(), "requests": len(requests)}
    found |= {"frames a second": rate, "matrix": matrix._asdict(), "path": path._asdict()}
    rows = [
        ("first paint (s)", paint, "", "", verdict(paint, 1.0)),
        (f"plan of {places} places (s)", *plan, verdict(plan.seconds, 2.0)),
        (f"of {2 * frames} places (s)", *plain, f"the one above: {plan.seconds / plain.seconds:.1f} times"),
        ("requests of that page", len(requests), "", "", ""),
        ("panning (frames a second)", rate, "", "", verdict(rate, 30.0, at_least=True)),
        (f"matrix of {frames} × {frames} (s)", *matrix, verdict(matrix.seconds, 3.0)),
        ("the same with its path (s)", *path, ""),
    ]
    columns = ["", "", "processor: service", "browser", ""]
    report("console_pages", "The console in a browser", columns, rows, {"found": found})


if __name__ == "__main__":
    typer.run(main)
