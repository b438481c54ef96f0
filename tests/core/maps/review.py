"""What every store keeps to of frames for review while others write."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

from core.ledger.maps.review import Review
from core.maps import ReviewSetting

WRITES = 60


def check_pages_are_of_one_moment(reader: Review, writer: Review) -> None:
    """While frames come and go, each page has as many frames, and as many bytes, as it says that there are in all."""
    ended = threading.Event()

    def write() -> None:
        try:
            for number in range(WRITES):
                writer.keep(bytes(number + 1), {"verdict": "unknown"}, ReviewSetting(most_frames=1 + number % 3))
        finally:
            ended.set()

    with ThreadPoolExecutor(1) as thread:
        writing = thread.submit(write)
        while not ended.is_set():
            page = reader.page(None, 10)
            assert (len(page.frames), sum(frame.size for frame in page.frames)) == (page.count, page.size)
        writing.result()
