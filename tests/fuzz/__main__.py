"""``scripts/fuzz``: hostile input against a server of its own, or against one that runs already."""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from service.access.keys import Keys
from tests.fuzz import api, http, images, streams
from tests.fuzz.encoder import SMALL, install_small_encoder
from tests.fuzz.pictures.originals import originals
from tests.fuzz.sending import MAP
from tests.service.server import ROOT, Server

DATASETS = ROOT.parent / "shared" / "datasets"
WARM = 5000


@contextmanager
def service(url: str | None, key: bool = False, **settings: object) -> Iterator[tuple[str, Server | None]]:
    """The URL of a service: the given one, or a new server with a small encoder, which is stopped afterwards.

    Args:
        key: let a new server have a key, which its client sends.
    """
    if url is not None:
        yield url, None
        return
    with tempfile.TemporaryDirectory(prefix="placerec-fuzz-") as folder:
        install_small_encoder(Path(folder) / "models")
        token = Keys.of(Path(folder) / "data").create("fuzzer", "admin")[1] if key else None
        server = Server(Path(folder), {"encoder": SMALL, "log_level": "warning", **settings}, key=token).wait()
        try:
            yield str(server.client.base_url), server
        finally:
            server.check_running()
            status = server.stop()
            unexpected = [line for line in server.log_file.read_text().splitlines() if "Traceback" in line]
            print(f"the server ended with status {status}; {len(unexpected)} tracebacks in its log")


def fuzz_images(options: argparse.Namespace) -> int:
    """Damaged pictures; 1 if one was answered as it should not be, or memory grew by more than a tenth."""
    known = originals(None if options.drawn_only or not DATASETS.is_dir() else DATASETS)
    with service(options.url) as (url, server):
        process = server.process.pid if server is not None else options.process
        report = images.run(
            url,
            process,
            known,
            options.seed,
            options.count,
            options.first,
            options.threads,
            options.out / "wrong",
            60 * options.minutes,
        )
    warm = min(WARM, len(report.sent) // 4)
    summary = report.summary(warm)
    images.written(report, warm, options.out / f"images-{options.seed}.json")
    print(report.table())
    print({name: summary[name] for name in ("pictures", "seconds", "seconds_p99", "seconds_longest", "growth")})
    for one in report.wrong[:20]:
        print(f"WRONG: picture {one.index} ({one.kind}) by {one.operation}: {one.wrong}")
    for complaint in report.complaints:
        print(f"WRONG: {complaint}")
    grown = summary["growth"] is not None and summary["growth"] > 1.1
    print(f"seed {options.seed}, {len(known)} originals: {len(report.wrong)} wrong answers")
    return int(bool(report.wrong or report.complaints or grown))


def fuzz_api(options: argparse.Namespace) -> int:
    """schemathesis; 1 if a check failed."""
    with service(options.url, key=True, **api.TIGHT) as (url, server):
        seconds = str(round(60 * options.minutes))
        key = os.environ.get("PLACEREC_KEY") if server is None else server.key
        done = api.run(url, options.seed, options.phases, ["--max-time", seconds], key)
    print(done.stdout, done.stderr, sep="")
    return done.returncode


def fuzz_http(options: argparse.Namespace) -> int:
    """Bytes that are no HTTP; 1 if some were answered by a 5xx, or the connection stayed open."""
    with service(options.url) as (url, _):
        port = int(url.rpartition(":")[2].strip("/"))
        sent = [*http.MALFORMED.values(), *http.mangled(options.seed, options.count)]
        wrong = [complaint for one in sent if (complaint := http.complaint(port, one))]
    print(*wrong, f"seed {options.seed}: {len(sent)} connections, {len(wrong)} wrong", sep="\n")
    return int(bool(wrong))


def fuzz_streams(options: argparse.Namespace) -> int:
    """Nonsense over WebSockets; 1 if a message was not answered."""
    with service(options.url) as (url, _):
        with httpx.Client(base_url=url, timeout=60) as client:
            images.prepare(client)
        wrong = streams.run(url.rstrip("/"), MAP, originals(), options.seed, options.count)
    print(*wrong, f"seed {options.seed}: {options.count} messages, {len(wrong)} wrong", sep="\n")
    return int(bool(wrong))


def fuzz_files(options: argparse.Namespace) -> int:
    """Damaged files of some kinds; 1 if one was not read or refused as it should be."""
    from tests.fuzz import files  # with it come the readers of all kinds

    status = 0
    for kind in options.kinds or files.KINDS:
        last = sys.maxsize if options.count is None else options.first + options.count
        numbers = iter(range(options.first, last))
        found = files.run(kind, options.seed, numbers, 60 * options.minutes, options.out / "wrong")
        print(f"{kind}: {sum(found.ends.values())} files, seed {options.seed}: {dict(found.ends)}")
        for complaint in found.wrong[:20]:
            print(f"WRONG: {complaint}")
        status |= bool(found.wrong)
    return status


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/fuzz", description=__doc__)
    commands = parser.add_subparsers(required=True)
    pictures = commands.add_parser("images", help="damaged JPEG, PNG and WebP files")
    pictures.add_argument("--count", type=int, default=2000)
    pictures.add_argument("--seed", type=int, default=0)
    pictures.add_argument("--first", type=int, default=0, help="number of the first picture: to replay one")
    pictures.add_argument("--minutes", type=float, default=math.inf, help="end after so many")
    pictures.add_argument("--threads", type=int, default=4)
    pictures.add_argument("--url", help="of a service that runs; default: one of our own")
    pictures.add_argument("--process", type=int, help="its process, to see its memory")
    pictures.add_argument("--drawn-only", action="store_true", help="leave out the frames of ../shared/datasets")
    pictures.add_argument("--out", type=Path, default=Path("runs/fuzz"))
    pictures.set_defaults(do=fuzz_images)
    whole = commands.add_parser("api", help="schemathesis over the whole OpenAPI document")
    whole.add_argument("--minutes", type=float, default=5)
    whole.add_argument("--phases", default=api.ALL)
    whole.set_defaults(do=fuzz_api)
    raw = commands.add_parser("http", help="bytes that are no proper HTTP")
    raw.add_argument("--count", type=int, default=2000, help="mangled requests, besides those that are written down")
    raw.set_defaults(do=fuzz_http)
    sockets = commands.add_parser("streams", help="nonsense over the WebSocket of a session")
    sockets.add_argument("--count", type=int, default=2000)
    sockets.set_defaults(do=fuzz_streams)
    read = commands.add_parser("files", help="damaged files of every other kind that is read")
    read.add_argument("kinds", nargs="*", metavar="KIND", help="such as archives, bags, onnx; default: all")
    read.add_argument("--minutes", type=float, default=1, help="for each kind")
    read.add_argument("--count", type=int, help="end after so many of each kind")
    read.add_argument("--first", type=int, default=0, help="number of the first file: to replay one")
    read.add_argument("--seed", type=int, default=0)
    read.add_argument("--out", type=Path, default=Path("runs/fuzz"))
    read.set_defaults(do=fuzz_files)
    for one in (whole, raw, sockets):
        one.add_argument("--seed", type=int, default=0)
        one.add_argument("--url", help="of a service that runs; default: one of our own")
    options = parser.parse_args()
    return int(options.do(options))


if __name__ == "__main__":
    sys.exit(main())
