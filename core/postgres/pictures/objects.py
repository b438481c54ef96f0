"""Pictures in an object store that speaks S3.

An object is written once, under a name that was never used before, and is never changed.  It is written before the
COMMIT of the row that names it, and deleted after the row, so that each object without a row is litter, and no row is
without its object.
"""

from __future__ import annotations

import hashlib
import logging
import re
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import obstore
from obstore.exceptions import BaseError
from obstore.store import S3Store

from core.errors import StorageFailure, StorageFull, StoreUnavailable
from core.ledger.maps.frames import StoredObject
from core.ledger.outage import Outage, Unreachable
from core.postgres.pictures.bucket import Bucket

if TYPE_CHECKING:
    from obstore.store import ClientConfig, S3Config

SERVER = "The object store"

AT_ONCE = 8
"""Requests of one service that are under way together."""

LISTED_AT_ONCE = 1000
"""Objects of one page of a listing, and of one deletion, which is what S3 allows."""

CONNECT_SECONDS, ANSWER_SECONDS = 2, 10
"""A request that takes longer has failed; a write to a map does not wait much longer for others either."""

PROBE_SECONDS = 1.5
"""A store that was gone, and does not answer within this time, is still gone."""

PROBE = "probe"
"""The name of the object that is written to see whether objects can be written."""

_OF_A_FULL_STORE = re.compile(
    r"507 Insufficient|<Code>(XMinioStorageFull|XMinioAdminBucketQuotaExceeded|QuotaExceeded|StorageFull|"
    r"InsufficientStorage|EntityTooLarge\w+|NotEnoughSpace)</Code>"
)
_FAILED = re.compile(r"non-2xx status code: 5\d\d")
_NOT_ALLOWED = re.compile(r"\b(AccessDenied|MethodNotAllowed|AllAccessDisabled)\b")
_CODE = re.compile(r"<Code>(\w+)</Code>(?:<Message>([^<]*)</Message>)?")
_CAUSE = re.compile(r'(?:message|error): "([^"]{1,200})"')
_CERTIFICATE = re.compile(r"InvalidCertificate\(\s*(\w+)")

log = logging.getLogger(__name__)


class Objects:
    """The objects of one bucket.  Any thread may use it; it is connected to when it is first used."""

    def __init__(self, bucket: Bucket) -> None:
        self._outage = Outage(SERVER, probe=self._ask)
        self._bucket = bucket
        self._changing = threading.Lock()
        self._refusal: str | None = None
        self._workers = ThreadPoolExecutor(AT_ONCE, "objects")
        self._store: S3Store | None = None
        self._impatient: S3Store | None = None

    def put(self, pictures: Mapping[str, bytes]) -> None:
        """Store pictures by the names of their objects; they are durable when this returns.

        If it raises, some may be there.

        Raises:
            StorageFull: there is no room for them.
            StoreUnavailable: the store cannot be reached, or refuses.
        """
        with self._outage.noticed():
            refusal = self._refusal_of(pictures)
        self._note(refusal)
        if refusal is not None:
            text = f"{SERVER} takes no pictures: {_reason(refusal)}."
            raise StorageFull(text) if _OF_A_FULL_STORE.search(refusal) else StoreUnavailable(text)

    def _refusal_of(self, pictures: Mapping[str, bytes]) -> str | None:
        """Store pictures; returns why the store, which can be reached, takes no more of them."""

        def put(name: str, picture: bytes) -> str | None:
            try:
                with self._answers() as store:
                    obstore.put(store, name, picture)
            except StoreUnavailable as error:
                why = str(error.__cause__)
                if any(kind.search(why) for kind in (_OF_A_FULL_STORE, _NOT_ALLOWED, _FAILED)):
                    return why
                raise
            return None

        return next((why for why in self._all(put, pictures.items()) if why is not None), None)

    def _all(self, do: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> list[Any]:
        """Do something several times at once; raises the first one's error when all have ended."""
        every = list(arguments)
        if len(every) == 1:
            return [do(*every[0])]
        under_way = [self._workers.submit(do, *one) for one in every]
        wait(under_way)
        return [one.result() for one in under_way]

    def _note(self, refusal: str | None) -> None:
        """Log that the store takes no pictures any more, or that it takes them again."""
        if refusal is None and self._refusal is None:
            return
        with self._changing:
            before, self._refusal = self._refusal, refusal
        if refusal is not None and before is None:
            log.error("%s takes no pictures: %s", SERVER, _reason(refusal))
        elif refusal is None and before is not None:
            log.info("%s takes pictures again", SERVER)

    def discard(self, names: Sequence[str]) -> None:
        """Delete objects that no row is going to name, if that is possible now; else a sweep does it."""
        with suppress(StorageFailure):
            self.delete(names)

    def delete(self, names: Sequence[str]) -> None:
        """Delete objects; those that are not there are left out.

        Raises:
            StoreUnavailable.
        """
        if names:
            with self._outage.noticed(), self._answers() as store:
                obstore.delete(store, list(names))

    def read(self, stored: Sequence[StoredObject]) -> list[bytes | None]:
        """Pictures; None for one that is missing, or whose bytes are not those that were stored.

        Raises:
            StoreUnavailable: the store cannot be reached, or refuses.
        """

        def get(one: StoredObject) -> bytes | None:
            try:
                with self._answers() as store:
                    found = bytes(obstore.get(store, one.name).bytes())
            except FileNotFoundError:
                return None
            return found if hashlib.sha256(found).digest() == one.digest else None

        if not stored:
            return []
        with self._outage.noticed():
            return self._all(get, ((one,) for one in stored))

    def names_after(self, folder: str, name: str) -> Iterator[list[str]]:
        """The names of a folder's objects behind a name, in their order, some at a time.

        Raises:
            StoreUnavailable.
        """
        with self._answers() as store:
            pages = obstore.list(store, f"{folder}/", offset=name, chunk_size=LISTED_AT_ONCE)
        while True:
            with self._outage.noticed(), self._answers():
                page = next(pages, None)
            if page is None:
                return
            yield [one["path"] for one in page]

    def check(self) -> None:
        """Write an object, to see whether objects can be written.

        Raises:
            StorageFull, StoreUnavailable.
        """
        self.put({PROBE: b"placerec"})

    def close(self) -> None:
        """Wait for the calls under way."""
        self._workers.shutdown()

    def _ask(self) -> None:
        """See in little time whether the store, which was gone, answers again: it may take requests and not answer."""
        with suppress(FileNotFoundError), self._answers():
            if self._impatient is None:
                self._impatient = _opened(self._bucket, PROBE_SECONDS)
            obstore.get(self._impatient, PROBE)

    def _connected(self) -> S3Store:
        if self._store is None:
            self._store = _opened(self._bucket, ANSWER_SECONDS)
        return self._store

    @contextmanager
    def _answers(self) -> Iterator[S3Store]:
        """Ask the store something in the block; FileNotFoundError: it has no such object.

        Raises:
            Unreachable: it gives no answer, or refuses everything.
            StoreUnavailable: it does not allow this.
        """
        try:
            yield self._connected()
        except (BaseError, OSError) as error:
            if isinstance(error, FileNotFoundError) and "<Code>NoSuchKey</Code>" in str(error):
                raise
            raise self._refused(error) from error

    def _refused(self, error: Exception) -> StoreUnavailable:
        text = str(error)
        if _NOT_ALLOWED.search(text):
            return StoreUnavailable(f"{SERVER} does not allow it: {_reason(text)}.")
        if "<Code>NoSuchBucket</Code>" in text:
            return Unreachable(SERVER, f"has no bucket {self._bucket.name!r}.")
        if isinstance(error, PermissionError) or re.search(r"status code: 40[13]", text):
            return Unreachable(SERVER, f"refuses the credentials: {_reason(text)}.")
        if (wrong := _CERTIFICATE.search(text)) is not None:
            return Unreachable(SERVER, f"cannot be trusted: its certificate is refused ({wrong[1]}).")
        return Unreachable(SERVER, f"cannot be reached, or fails: {_reason(text)}.")


def _opened(bucket: Bucket, seconds: float) -> S3Store:
    options: ClientConfig = {
        "allow_http": True,
        "connect_timeout": timedelta(seconds=CONNECT_SECONDS),
        "timeout": timedelta(seconds=seconds),
    }
    if bucket.certificate is not None:
        options["root_certificate"] = Path(bucket.certificate).read_bytes()
    config: S3Config = {"region": bucket.region}
    if bucket.endpoint is not None:
        config["endpoint"] = bucket.endpoint.rstrip("/")
    if bucket.access_key:
        config |= {"access_key_id": bucket.access_key, "secret_access_key": bucket.secret_key}
    prefix = bucket.prefix or None
    # The caller decides whether to try again.
    return S3Store(bucket.name, prefix=prefix, config=config, client_options=options, retry_config={"max_retries": 0})


def _reason(text: str) -> str:
    """The reason that an error gives, without addresses and identifiers of the request."""
    status = re.search(r"non-2xx status code: ([^:]+)", text)
    if status is None:
        first = " ".join(text.partition("\n")[0].rpartition(" - ")[2].split())[:200]
        late = "no answer in time" if "kind: Timeout" in text else None
        cause = _CAUSE.search(text)  # in the words of the library below
        return late or (first if cause is None else cause[1])
    code = _CODE.search(text)
    said = "" if code is None else f" ({': '.join(part for part in code.groups() if part)})"
    return f"{status[1]}{said}".removesuffix(".)").strip() + (")" if said.endswith(".)") else "")
