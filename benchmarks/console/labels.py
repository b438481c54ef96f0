"""The gain of labels made in the console: the Brier score of held-out frames before and after they calibrate a map.

    python -m benchmarks.console.labels ../shared/datasets/eval [--most 130] [--only corridor]

As :mod:`benchmarks.maps.labels`, but what a person does is done in a browser: in the view Review each frame that was
answered ambiguous or unknown is labelled by clicks, by the truth of the data set, and in the view Calibration the map
is calibrated with them.  Only the default way is measured, by which the encoder's calibration is adjusted.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import httpx
import typer
from playwright.sync_api import Page, expect, sync_playwright

from benchmarks.maps.labels import (
    FOLDERS,
    STORED_VERDICTS,
    LabelledFrame,
    LabelledWalk,
    ask,
    halves,
    make_map,
    query,
    walk,
)
from benchmarks.process import service
from benchmarks.report import report


def review_frames(client: httpx.Client, map_id: str) -> dict[int, str]:
    """The frames that are to be labelled: of each its SHA-256, the newest first."""
    found: dict[int, str] = {}
    cursor: str | None = ""
    while cursor is not None:
        given = {"limit": "1000", "labelled": "false"} | ({"cursor": cursor} if cursor else {})
        page = client.get(f"/v1/maps/{map_id}/review", params=given).raise_for_status().json()
        found |= {int(item["id"]): item["sha256"] for item in page["items"]}
        cursor = page["next_cursor"]
    return found


def label_by_clicks(
    page: Page, console: str, map_id: str, frames: dict[int, str], queried: Sequence[LabelledFrame]
) -> None:
    """Label frames in the view Review, as a person would who knows the way."""
    shown = {hashlib.sha256(frame.data).hexdigest(): frame.places for frame in queried}
    page.goto(f"{console}#/maps/{map_id}/review")
    panel = page.get_by_role("region", name="Frame to be labelled")
    for number, sha256 in frames.items():
        tile = page.get_by_role("button", name=f"Frame {number}", exact=True)
        tile.click()
        expect(tile).to_have_attribute("aria-pressed", "true")
        places = shown[sha256]
        offered = [panel.get_by_role("button", name=f"It is {place}", exact=True) for place in places]
        if not places:
            panel.get_by_role("button", name="No place of this map").click()
        elif there := [button for button in offered if button.count()]:
            there[0].click()
        else:
            panel.get_by_role("button", name="Another place").click()
            page.get_by_role("dialog").get_by_label("Id of the place").fill(places[len(places) // 2])
            page.get_by_role("dialog").get_by_role("button", name="Label", exact=True).click()
        expect(tile).to_have_count(0)


def calibrate_by_clicks(page: Page, console: str, map_id: str) -> None:
    """Calibrate a map with its labels in the view Calibration."""
    page.goto(f"{console}#/maps/{map_id}/calibration")
    page.get_by_role("button", name="Calibrate", exact=True).click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Ask").select_option("labels")
    dialog.get_by_label("Dry run").uncheck()
    dialog.get_by_role("button", name="Calibrate", exact=True).click()
    dialog.wait_for(state="detached")
    page.get_by_text("labels: ", exact=False).wait_for()


def measure(client: httpx.Client, page: Page, of: LabelledWalk, other: LabelledWalk) -> list[dict[str, Any]]:
    """The figures of a data set by the half that was held out."""
    console, found = f"{client.base_url}/console", []
    parts = halves(of, other)
    for turn, (queried, held_out) in enumerate((parts, parts[::-1])):
        map_id = f"{of.name}-{turn}"
        make_map(client, map_id, of, STORED_VERDICTS["doubtful"])
        for frame in queried:
            query(client, map_id, frame.data)
        time.sleep(2)  # the last frames are written a moment after their answers
        client.patch(f"/v1/maps/{map_id}", json={"review": None}).raise_for_status()
        before = ask(client, map_id, held_out)
        frames = review_frames(client, map_id)
        began = time.perf_counter()
        label_by_clicks(page, console, map_id, frames, queried)
        took = time.perf_counter() - began
        labels = client.get(f"/v1/maps/{map_id}/review/labels").raise_for_status().json()["items"]
        assert len(labels) == len(frames), (len(labels), len(frames))
        calibrate_by_clicks(page, console, map_id)
        after = ask(client, map_id, held_out)
        done = {"map": of.name, "half": turn, "frames": len(held_out), "labels": len(frames), "seconds": took}
        found.append({**done, "before": before, "after": after})
    return found


def main(
    folder: Annotated[Path, typer.Argument(help="The folder of the data sets.")],
    only: Annotated[str | None, typer.Option(help="Only this data set.")] = None,
    most: Annotated[int, typer.Option(help="Most frames of each second walk, evenly taken.")] = 130,
) -> None:
    """Measure, print a table and write JSON."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise typer.BadParameter("no Chromium is installed")
    walks = {name: walk(name, folder, most) for name in FOLDERS}
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1600, "height": 1000})
        settings = {"REQUEST_TIMEOUT": 600}
        with service(Path(temporary) / "data", settings=settings, log=Path(temporary) / "log") as process:
            for name, other in (("corridor", "lip6"), ("lip6", "corridor")):
                if only in (None, name):
                    found += measure(process.client, page, walks[name], walks[other])
        browser.close()
    rows: list[list[object]] = [
        [
            f"{one['map']}, half {one['half'] + 1} labelled",
            one["labels"],
            f"{one['before']['brier']:.4f}",
            f"{one['after']['brier']:.4f}",
            one["before"]["recall"],
            one["after"]["recall"],
            one["seconds"] / max(1, one["labels"]),
        ]
        for one in found
    ]
    columns = ["", "labels", "Brier before", "after", "recall before", "after", "s a label"]
    report("console_labels", "Labels made by clicks, and the other half", columns, rows, {"found": found})


if __name__ == "__main__":
    typer.run(main)
