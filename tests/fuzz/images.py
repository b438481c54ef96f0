"""Sends thousands of damaged pictures to a running service; each must be answered, and the service unharmed."""

from __future__ import annotations

import json
import math
import statistics
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import httpx

from tests.fuzz.pictures.mutations import mutant
from tests.fuzz.pictures.originals import Original
from tests.fuzz.sending import MAP, OVERLOADED, Sender, Sent
from tests.service.scenes import encoded, jpeg, scene, seen_again

PLACES = 8
GROUP = 500
"""Pictures between two measurements of the process's memory."""

TIMES = ("milliseconds", "request_id", "revision", "created_at", "updated_at")
"""Fields of an answer that differ from one time to the next."""


@dataclass
class Report:
    """The answers of a run."""

    seed: int
    count: int
    sent: list[Sent] = field(default_factory=list)
    resident: list[tuple[int, int]] = field(default_factory=list)
    seconds: float = 0.0
    complaints: list[str] = field(default_factory=list)

    def add(self, batch: Sequence[Sent], resident: int | None) -> None:
        """Add answers, and the memory in bytes that the process had after them."""
        self.sent += batch
        if resident is not None:
            self.resident.append((len(self.sent), resident))

    @property
    def wrong(self) -> list[Sent]:
        """Answers that should not have been given; being overloaded is allowed."""
        return [one for one in self.sent if one.wrong]

    def growth(self, warm: int) -> float | None:
        """Memory at the end over memory when ``warm`` pictures had been sent (medians of three measurements each)."""
        early = [held for sent, held in self.resident if sent >= warm][:3]
        late = [held for _, held in self.resident[-3:]]
        return statistics.median(late) / statistics.median(early) if early and len(self.resident) > 3 else None

    def table(self) -> str:
        """How many answers of each status there were, by kind of damage."""
        statuses = sorted({one.status for one in self.sent})
        counts = Counter((one.kind, one.status) for one in self.sent)
        kinds = sorted({one.kind for one in self.sent})
        lines = [f"{'damage':32}" + "".join(f"{status:>8}" for status in statuses)]
        lines += [f"{kind:32}" + "".join(f"{counts[kind, status]:8}" for status in statuses) for kind in kinds]
        total = Counter(one.status for one in self.sent)
        return "\n".join([*lines, f"{'all':32}" + "".join(f"{total[status]:8}" for status in statuses)])

    def summary(self, warm: int) -> dict[str, Any]:
        """The run in figures."""
        durations = sorted(one.seconds for one in self.sent)
        return {
            "seed": self.seed,
            "pictures": len(self.sent),
            "seconds": round(self.seconds, 1),
            "statuses": dict(sorted(Counter(one.status for one in self.sent).items())),
            "problems": dict(Counter(one.problem for one in self.sent if one.problem).most_common()),
            "operations": dict(Counter(one.operation for one in self.sent).most_common()),
            "kinds": {kind: dict(Counter(one.status for one in self.sent if one.kind == kind))
                      for kind in sorted({one.kind for one in self.sent})},
            "overloaded": sum(one.status in OVERLOADED for one in self.sent),
            "wrong": [asdict(one) for one in self.wrong],
            "complaints": self.complaints,
            "seconds_median": round(durations[len(durations) // 2], 4),
            "seconds_p99": round(durations[int(0.99 * (len(durations) - 1))], 4),
            "seconds_longest": round(durations[-1], 3),
            "resident_bytes": self.resident,
            "warm": warm,
            "growth": self.growth(warm),
        }  # fmt: skip


def prepare(client: httpx.Client) -> None:
    """Create a map with a few sound places."""
    client.delete(f"/v1/maps/{MAP}")
    client.post("/v1/maps", json={"id": MAP}).raise_for_status()
    for number in range(PLACES):
        path = f"/v1/maps/{MAP}/places/p{number}"
        params: dict[str, str | int] = {"x": 2 * number, "y": 0, "sequence": "s"}
        client.put(path, params=params, content=jpeg(number), headers={"Content-Type": "image/jpeg"}).raise_for_status()


def sound_picture() -> bytes:
    """A picture that is recognized."""
    return encoded(seen_again(scene(3)))


def sound_answers(client: httpx.Client) -> dict[str, Any]:
    """The answers to a sound picture, without the fields in TIMES."""
    data, kind = sound_picture(), {"Content-Type": "image/jpeg"}
    found: dict[str, Any] = {}
    for path in (f"/v1/maps/{MAP}/query", "/v1/encode"):
        answer = client.post(path, content=data, headers=kind).raise_for_status().json()
        found[path] = _timeless(answer)
    return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _timeless(one) for name, one in value.items() if name not in TIMES}
    return [_timeless(one) for one in value] if isinstance(value, list) else value


def alike(one: Any, other: Any) -> bool:
    """Whether two answers are the same up to rounding."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(alike(value, other[name]) for name, value in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-4, abs_tol=1e-6)
    return bool(one == other)


def resident_bytes(process: int) -> int:
    """Resident memory of a process in bytes.

    Raises:
        OSError: the process has ended.
    """
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return 1024 * int(line.split()[1])
    raise ProcessLookupError(process)


def groups(first: int, count: int) -> Iterator[range]:
    """Numbers of pictures, GROUP at a time."""
    for start in range(first, first + count, GROUP):
        yield range(start, min(start + GROUP, first + count))


def run(
    url: str,
    process: int | None,
    originals: Sequence[Original],
    seed: int,
    count: int,
    first: int = 0,
    threads: int = 4,
    wrong_into: Path | None = None,
    seconds: float = math.inf,
) -> Report:
    """Send ``count`` pictures of a seed from number ``first`` on, or as many as can be sent in ``seconds``.

    Args:
        url: of the service.
        process: its process id, to measure its memory; None if it runs on another machine.
        wrong_into: directory for the pictures whose answers were wrong.
    """
    report = Report(seed, count)
    client = httpx.Client(base_url=url, timeout=60)
    prepare(client)
    before = sound_answers(client)
    free: SimpleQueue[Sender] = SimpleQueue()
    senders = [Sender(url, sound_picture()) for _ in range(threads)]
    for sender in senders:
        free.put(sender)

    def one(index: int) -> Sent:
        made = mutant(seed, index, originals)
        sender = free.get()
        try:
            sent = sender.send(made, seed)
        finally:
            free.put(sender)
        if sent.wrong and wrong_into is not None:
            wrong_into.mkdir(parents=True, exist_ok=True)
            (wrong_into / f"{seed}-{index}.{made.format}").write_bytes(made.data)
        return sent

    began = time.monotonic()
    with ThreadPoolExecutor(threads) as pool:
        for group in groups(first, count):
            report.add([*pool.map(one, group)], resident_bytes(process) if process is not None else None)
            if time.monotonic() - began > seconds:
                break
            print(f"{len(report.sent)} of {count}, {len(report.wrong)} wrong", end="\r", file=sys.stderr, flush=True)
    report.seconds = time.monotonic() - began
    for sender in senders:
        sender.close()
    if client.get("/readyz").status_code != 200:
        report.complaints.append("the service is not ready afterwards")
    if not alike(sound_answers(client), before):
        report.complaints.append("a sound picture gets another answer than before")
    if not client.post(f"/v1/maps/{MAP}/verify").json().get("ok", True):
        report.complaints.append("the map is damaged afterwards")
    left = client.get(f"/v1/maps/{MAP}").json().get("places")
    if left != PLACES:
        report.complaints.append(f"the map has {left} places afterwards and not {PLACES}")
    client.close()
    return report


def written(report: Report, warm: int, file: Path) -> None:
    """Write the summary as JSON."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(report.summary(warm), indent=1) + "\n")
