"""Take the pictures of the console that the documents show: ``python -m tests.service.console.figures [FOLDER]``.

A service of its own holds a drawn building that two traverses saw.  The pictures are written to docs/figures with at
most 256 colours each.
"""

from __future__ import annotations

import math
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Page, expect, sync_playwright

from core.frames.preprocessing import Pixels
from tests.service.scenes import encoded, seen_again
from tests.service.server import ROOT, Server

PLACES = 48
WIDTH, HEIGHT = 480, 360
WORDS = ("ROOM", "LAB", "STORE", "LIFT", "EXIT", "WARD", "HALL", "CAFE")
MAP = "clinic"


def corridor(seed: int) -> Pixels:
    """A corridor with doors, signs, lamps and things on the floor; each seed is another spot of the building."""
    random = np.random.default_rng(seed)
    centre = (WIDTH // 2 + int(random.integers(-50, 50)), HEIGHT // 2 - int(random.integers(0, 40)))
    far = (int(random.integers(36, 70)), int(random.integers(28, 50)))
    left, right, top, bottom = centre[0] - far[0], centre[0] + far[0], centre[1] - far[1], centre[1] + far[1]
    tone = random.integers(150, 215, 3)
    picture = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    sides = {
        "ceiling": ([(0, 0), (WIDTH, 0), (right, top), (left, top)], tone + 35),
        "floor": (
            [(0, HEIGHT), (WIDTH, HEIGHT), (right, bottom), (left, bottom)],
            tone // 2 + random.integers(0, 40, 3),
        ),
        "west": ([(0, 0), (left, top), (left, bottom), (0, HEIGHT)], tone),
        "east": ([(WIDTH, 0), (right, top), (right, bottom), (WIDTH, HEIGHT)], tone - 14),
        "end": ([(left, top), (right, top), (right, bottom), (left, bottom)], random.integers(90, 240, 3)),
    }
    for points, colour in sides.values():
        cv2.fillPoly(picture, [np.array(points, np.int32)], tuple(int(c) for c in np.clip(colour, 0, 255)))
    for depth in np.linspace(0.05, 0.95, 9) ** 2:  # the floor's tiles
        y = int(HEIGHT + (bottom - HEIGHT) * (1 - depth))
        cv2.line(picture, (0, y), (WIDTH, y), tuple(int(c) for c in tone // 3), 1)
    for side in (0, 1):
        _furnish(picture, random, side, (left, right, top, bottom))
    for depth in (0.25, 0.6):
        x, y = int(WIDTH / 2 + (centre[0] - WIDTH / 2) * depth), int(depth * top * 0.8)
        half = int(60 * (1 - depth))
        cv2.ellipse(picture, (x, y + 8), (half, half // 4), 0, 0, 360, (250, 250, 244), -1)
    word = f"{WORDS[int(random.integers(len(WORDS)))]} {int(random.integers(10, 99))}"
    cv2.putText(picture, word, (left - 6, top - 6), cv2.FONT_HERSHEY_DUPLEX, 0.6, (40, 40, 40), 1, cv2.LINE_AA)
    noise = random.normal(0, 3, picture.shape)
    return np.asarray(np.clip(picture + noise, 0, 255), np.uint8)


def _furnish(picture: Pixels, random: np.random.Generator, side: int, end: tuple[int, int, int, int]) -> None:
    """Doors and pictures on one wall, and a thing that stands before it."""
    left, right, top, bottom = end
    wall = (0, left) if side == 0 else (WIDTH, right)

    def at(depth: float, height: float) -> tuple[int, int]:
        """A point of the wall: 0 is near and 1 far, 0 is the floor and 1 the ceiling."""
        x = wall[0] + (wall[1] - wall[0]) * depth
        low, high = HEIGHT + (bottom - HEIGHT) * depth, top * depth
        return int(x), int(low + (high - low) * height)

    for start in np.arange(0.05, 0.85, 0.3) + random.uniform(0, 0.08):
        wide, high = random.uniform(0.1, 0.2), random.choice([0.72, 0.78])
        low = 0.0 if random.random() < 0.6 else random.uniform(0.35, 0.5)
        points = [at(start, low), at(start + wide, low), at(start + wide, high), at(start, high)]
        colour = tuple(int(c) for c in random.integers(30, 230, 3))
        cv2.fillPoly(picture, [np.array(points, np.int32)], colour, cv2.LINE_AA)
        cv2.polylines(picture, [np.array(points, np.int32)], True, (50, 50, 50), 1, cv2.LINE_AA)
        cv2.circle(picture, at(start + wide * 0.8, (low + high) / 2), 3, (30, 30, 30), -1, cv2.LINE_AA)
    x, y = at(random.uniform(0.1, 0.5), 0.02)
    size = int(random.integers(24, 60))
    colour = tuple(int(c) for c in random.integers(20, 200, 3))
    cv2.rectangle(picture, (x - size // 2, y - size), (x + size // 2, y), colour, -1)
    cv2.circle(picture, (x, y - size - 10), size // 2, (40, int(random.integers(90, 170)), 50), -1, cv2.LINE_AA)


def through_glass(pixels: Pixels, reflected: Pixels) -> Pixels:
    """A frame in which one sees two places, as through a glass door."""
    return np.asarray(pixels * 0.5 + reflected * 0.5, np.uint8)


def spot(number: int, aside: float = 0.0) -> dict[str, float]:
    """Where a frame was taken: a walk through the building, in metres, with its heading in degrees."""
    turn = 2 * math.pi * number / PLACES

    def along(angle: float) -> tuple[float, float]:
        return 34 * math.sin(angle), 13 * math.sin(2 * angle) + 5 * math.cos(angle)

    (x, y), (then_x, then_y) = along(turn), along(turn + 0.01)
    heading = math.atan2(then_y - y, then_x - x)
    x, y = x - aside * math.sin(heading), y + aside * math.cos(heading)
    return {"x": round(x, 2), "y": round(y, 2), "heading": round(math.degrees(heading) % 360, 1)}


def fill(server: Server) -> None:
    """Two traverses of the building, the second shorter; robots that asked; a second, small map."""
    server.create_map(MAP, description="Ground floor, day and evening")
    for name, day, aside, numbers in (("monday", 16, 0.0, range(PLACES)), ("tuesday", 17, 0.8, range(4, PLACES - 6))):
        for number in numbers:
            pixels = corridor(number)
            if name == "tuesday":
                pixels = seen_again(pixels, seed=number)
            server.enrol(
                MAP,
                f"{name}-{number:03d}",
                encoded(pixels),
                **spot(number, aside),
                sequence=name,
                timestamp=f"2026-11-{day}T09:{number // 6:02d}:{number % 6 * 10:02d}Z",
                metadata={"floor": 0, "light": "day" if name == "monday" else "evening"},
            )
    server.create_map("yard", description="Behind the loading bay")
    for number in range(3):
        server.enrol("yard", f"yard-{number}", encoded(corridor(900 + number)), sequence="first")
    review = {"verdicts": ["ambiguous", "unknown"], "most_frames": 200}
    server.client.patch(f"/v1/maps/{MAP}", json={"review": review}).raise_for_status()
    for number in range(0, PLACES, 2):
        server.query(MAP, encoded(seen_again(corridor(number), seed=300 + number)))
    for number in range(1, PLACES - 5, 6):
        server.query(MAP, encoded(through_glass(corridor(number), corridor(number + 5))))
    order = {"method": "sequence", "sequence": "tuesday", "target": {"rule": "precision", "value": 0.9}}
    server.client.post(f"/v1/maps/{MAP}/calibrate", json=order).raise_for_status()


def ask_live(server: Server) -> Callable[[Page], None]:
    """Frames that come while a page listens: a robot's run, and some strangers."""

    def act(_: Page) -> None:
        session = server.client.post(f"/v1/maps/{MAP}/sessions", json={}).json()["id"]
        for number in range(10, 20):
            frame = encoded(seen_again(corridor(number), seed=600 + number))
            path = f"/v1/maps/{MAP}/sessions/{session}/frames"
            server.client.post(path, content=frame, headers={"Content-Type": "image/jpeg"}).raise_for_status()
        server.query(MAP, encoded(corridor(700)))

    return act


def show_live(server: Server) -> Callable[[Page], None]:
    """The same, with the frames as thumbnails."""

    def act(page: Page) -> None:
        page.get_by_label("frames as thumbnails").check()
        page.get_by_text("listening").wait_for()
        page.wait_for_timeout(500)
        ask_live(server)(page)

    return act


def try_one(folder: Path) -> Callable[[Page], None]:
    """A frame that is asked."""
    file = folder / "frame.jpg"
    file.write_bytes(encoded(seen_again(corridor(21), seed=77)))

    def act(page: Page) -> None:
        page.get_by_label("Pictures").set_input_files(file)
        page.get_by_role("region", name="Answer").get_by_role("button", name="Cells").click()
        page.get_by_role("region", name="Answer").scroll_into_view_if_needed()
        page.mouse.wheel(0, 240)

    return act


def replay(page: Page) -> None:
    """A robot's run on the plan, near its end."""
    page.get_by_role("link", name=re.compile("^Replay the run")).first.click()
    slider = page.get_by_role("slider", name="Answer of the run")
    slider.focus()
    for _ in range(7):
        page.keyboard.press("ArrowRight")


def take(browser: Browser, url: str, theme: str, size: tuple[int, int], act: Callable[[Page], None] | None) -> bytes:
    """One picture, as PNG with a palette."""
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]},
        color_scheme="dark" if theme == "dark" else "light",
    )
    page = context.new_page()
    page.goto(url)
    page.locator("main .view h1").wait_for()
    expect(page.locator("main .loading")).to_have_count(0, timeout=30_000)
    page.wait_for_timeout(1500)
    if act is not None:
        act(page)
        page.wait_for_timeout(2500)
    shot = Image.open(BytesIO(page.screenshot())).convert("RGB")
    context.close()
    written = BytesIO()
    shot.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(written, "PNG", optimize=True)
    return written.getvalue()


def main(target: Path) -> None:
    """Write all pictures."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    wide, phone = (1280, 800), (390, 844)
    with tempfile.TemporaryDirectory() as text, sync_playwright() as playwright:
        folder = Path(text)
        server = Server(folder / "service").wait()
        fill(server)
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        figures: list[tuple[str, str, str, tuple[int, int], Callable[[Page], None] | None]] = [
            ("home", "home", "light", wide, ask_live(server)),
            ("maps", "maps", "light", wide, None),
            ("plan", f"maps/{MAP}/plan?place=monday-012", "light", wide, ask_live(server)),
            ("places", f"maps/{MAP}/places", "dark", wide, None),
            ("try", f"maps/{MAP}/try", "light", wide, try_one(folder)),
            ("live", f"maps/{MAP}/live", "dark", wide, show_live(server)),
            ("answers", f"maps/{MAP}/answers", "light", wide, replay),
            ("traverses", f"maps/{MAP}/traverses", "light", wide, None),
            ("calibration", f"maps/{MAP}/calibration", "light", wide, None),
            ("review", f"maps/{MAP}/review", "dark", wide, None),
            ("phone", f"maps/{MAP}/plan?place=monday-012", "dark", phone, None),
        ]
        for name, view, theme, size, act in figures:
            data = take(browser, f"http://127.0.0.1:{server.port}/console#/{view}", theme, size, act)
            (target / f"console-{name}.png").write_bytes(data)
            print(f"console-{name}.png {len(data) // 1024} KiB")
        browser.close()
        server.stop()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "figures")
