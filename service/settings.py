"""The settings of the service, read from the environment (``PLACEREC_…``) and validated at the start."""

from __future__ import annotations

import ipaddress
import os
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, SecretStr, ValidationError, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from core.method import DEFAULT_ENCODER

PREFIX = "PLACEREC_"
MIB = 1024 * 1024

Days = Annotated[float, Field(ge=0, le=36_500, allow_inf_nan=False)]
Seconds = Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)]


class SettingsError(Exception):
    """A setting is not valid; the text names each such setting by its variable, with the reason."""


class Settings(BaseSettings):
    """The settings of the service; the defaults suit one machine with one user."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, frozen=True, extra="forbid")

    host: str = Field(default="127.0.0.1", min_length=1, description="Address to listen on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    allow_anonymous: bool = Field(
        default=False,
        description="Serve other machines although no key was ever created, so that everybody who reaches the port may "
        "do everything. It has no effect once there are keys.",
    )
    allowed_hosts: str = Field(
        default="",
        max_length=4000,
        pattern=r"^([A-Za-z0-9_.-]+(,[A-Za-z0-9_.-]+)*)?$",
        description="Names, separated by commas, under which a service without keys is reached, besides addresses and "
        "names without a dot (on loopback: besides localhost); requests to others are refused.",
    )
    rate_per_key: float = Field(
        default=0.0,
        ge=0,
        le=1_000_000,
        allow_inf_nan=False,
        description="Most requests a second of one key, or of one address without keys; then 429. 0 sets no limit.",
    )
    rate_burst: int = Field(
        default=20, ge=1, le=1_000_000, description="Requests that may come at once before the rate limit applies."
    )
    audit_file: Path | None = Field(
        default=None, description="File to which the audit trail is appended besides the log; none by default."
    )
    root_path: str = Field(
        default="",
        pattern=r"^(/[A-Za-z0-9._~-]+)*$",
        description="Path under which a reverse proxy publishes the service, such as /placerec.",
    )
    data_dir: Path = Field(
        default=Path("data"), description="Directory of the maps; only one process at a time can use it."
    )
    database: SecretStr | None = Field(
        default=None,
        description="Address of the PostgreSQL that keeps maps, sessions, keys, jobs, rates, statistics and events for "
        "any number of services, such as postgresql://placerec:password@db/placerec; default: they are in the data "
        "directory of this one.",
    )
    row_cache_bytes: int = Field(
        default=256 << 20,
        ge=1 << 20,
        description="With a database: most bytes of descriptors, local descriptors and keypoints that were read and "
        "are kept in memory.",
    )
    milvus: str | None = Field(
        default=None,
        pattern=r"^https?://[^\s/@]+/?$",
        description="Address of a Milvus that has an index of maps whose codes outgrow the memory of a service, such "
        "as http://milvus:19530; https for TLS. Default: codes are in memory.",
    )
    milvus_token: SecretStr = Field(
        default=SecretStr(""), description="Token of Milvus, such as user:password; none by default."
    )
    milvus_certificate: Path | None = Field(
        default=None,
        description="File with the certificate of the authority of Milvus's; default: those that gRPC comes with.",
    )
    milvus_database: str = Field(
        default="", max_length=255, description="Database of Milvus in which its collections are; its default if empty."
    )
    backup_dir: Path | None = Field(
        default=None,
        description="Folder in which the service itself saves all maps, at intervals that an operator chooses; on "
        "another disk than the maps. None by default, and no backups.",
    )
    models_dir: Path | None = Field(
        default=None,
        description="Directory of encoders besides the packaged ones; default: 'models' beside the data directory.",
    )
    encoder: str = Field(
        default=DEFAULT_ENCODER,
        min_length=1,
        description="Encoder that is loaded at the start and used where no other is named.",
    )
    threads: int = Field(
        default=0,
        ge=0,
        le=1024,
        description="How many frames are encoded at a time, each in a thread; 0 is one for each core.",
    )
    device: Literal["cpu", "cuda"] = Field(
        default="cpu",
        description="Device of the forward passes; those of frames that wait together share batches on cuda.",
    )
    rehearsal: bool = Field(
        default=True,
        description="Before the service is ready, do once what requests do, so that no robot waits at its first frame. "
        "Without it a start is a second shorter.",
    )
    storage_threads: int = Field(
        default=8, ge=1, le=256, description="Searches, reads and writes of maps that run at the same time."
    )
    queue_length: int = Field(
        default=32,
        ge=1,
        le=100_000,
        description="Requests that may wait for the encoder; then 503.",
    )
    request_timeout: Seconds = Field(
        default=30.0,
        description="Seconds after which a request that still waits is dropped; a client may ask for less.",
    )
    shutdown_timeout: Seconds = Field(
        default=10.0, description="Seconds that requests under way have to finish when the service stops."
    )
    drain_seconds: float = Field(
        default=0.0,
        ge=0,
        le=600,
        allow_inf_nan=False,
        description="Seconds after SIGTERM during which the service is not ready but still answers requests, so that a "
        "load balancer stops sending them.",
    )
    head_timeout: Seconds = Field(
        default=10.0, description="Seconds within which the whole head of a request has to arrive; then 408."
    )
    read_timeout: Seconds = Field(
        default=10.0, description="Seconds without a byte of a body after which the request is dropped."
    )
    write_timeout: Seconds = Field(
        default=30.0,
        description="Seconds within which a client has to read 64 KiB of its answer, or the rest of it; then the "
        "connection is closed.",
    )
    keep_alive_timeout: Seconds = Field(
        default=75.0, description="Seconds without a request after which a connection is closed."
    )
    max_connections: int = Field(
        default=1000,
        ge=1,
        le=1_000_000,
        description="Open connections; one more closes the one that has waited longest for a request, or gets 503.",
    )
    max_connections_per_address: int = Field(
        default=500,
        ge=0,
        le=1_000_000,
        description="Open connections of one address (behind a proxy, the proxy's); 0 sets no such limit.",
    )
    max_pipelined: int = Field(
        default=16,
        ge=1,
        le=1000,
        description="Requests that a client may send ahead on one connection; later ones are not read.",
    )
    max_url_bytes: int = Field(
        default=64 * 1024, ge=256, le=MIB, description="Most bytes of the path and the query string together; then 414."
    )
    max_header_bytes: int = Field(
        default=16 * 1024, ge=256, le=MIB, description="Most bytes of all headers together; then 431."
    )
    max_headers: int = Field(default=100, ge=8, le=10_000, description="Most headers of one request; then 431.")
    max_stream_messages: int = Field(
        default=256, ge=2, le=10_000, description="Messages that a robot may send ahead over a WebSocket."
    )
    max_stream_fragments: int = Field(
        default=1024, ge=1, le=1_000_000, description="Most fragments of one WebSocket message."
    )
    open_maps: int | None = Field(
        default=None,
        ge=1,
        le=100_000,
        description="Maps that are open at the same time; the one used least makes room, and is opened again when it "
        "is used. Each takes 5 file descriptors and 0.7 MB besides what it holds for searching. Default: at most 256, "
        "as many as the descriptors of the process and a 64th of the memory suffice for.",
    )
    max_maps: int = Field(default=1000, ge=1, le=100_000, description="Most maps of the data directory; then 409.")
    max_places: int = Field(default=10_000_000, ge=1, description="Most places of one map; then 409.")
    max_image_bytes: int = Field(default=16 * MIB, ge=1024, le=1024 * MIB, description="Largest frame, in bytes.")
    max_image_pixels: int = Field(
        default=40_000_000, ge=256, le=1_000_000_000, description="Largest frame, in pixels, by its header."
    )
    max_batch_items: int = Field(default=256, ge=1, le=10_000, description="Most frames in one multipart request.")
    max_batch_bytes: int = Field(
        default=128 * MIB, ge=1024, le=4096 * MIB, description="Largest multipart request, in bytes."
    )
    max_bulk_items: int = Field(
        default=10_000, ge=1, le=200_000, description="Most frames in one multipart request that a job enrols."
    )
    max_bulk_bytes: int = Field(
        default=4096 * MIB, ge=1024, description="Largest multipart request that a job enrols, in bytes, on disk."
    )
    max_staged_bytes: int = Field(
        default=16384 * MIB, ge=1024, description="Most bytes on disk that wait for such jobs; then 503."
    )
    max_recording_bytes: int = Field(
        default=65536 * MIB,
        ge=1024,
        description="Most bytes on disk of bags that are uploaded or wait to be enrolled, of all together; then 503.",
    )
    bulk_timeout: Seconds = Field(
        default=3600.0, description="Seconds within which a whole request that a job enrols has to arrive."
    )
    max_upload_memory: int = Field(
        default=512 * MIB, ge=1024, description="Most bytes of request bodies in memory at the same time; then 503."
    )
    max_json_bytes: int = Field(default=1 * MIB, ge=1024, le=64 * MIB, description="Largest JSON body, in bytes.")
    max_metadata_bytes: int = Field(
        default=16 * 1024, ge=2, le=MIB, description="Largest metadata of one place, in bytes of JSON."
    )
    max_import_bytes: int = Field(
        default=64 * 1024 * MIB, ge=1024, description="Largest file of a map that is imported, in bytes, on disk."
    )
    max_imports: int = Field(
        default=2, ge=1, le=1000, description="Most maps that are being imported or wait for it; then 503."
    )
    import_timeout: float = Field(
        default=6 * 3600.0,
        gt=0,
        le=7 * 24 * 3600,
        allow_inf_nan=False,
        description="Seconds within which the whole file of a map has to arrive.",
    )
    max_exports: int = Field(
        default=4, ge=1, le=1000, description="Most exports of maps that wait for their downloads; then 503."
    )
    export_seconds: float = Field(
        default=3600.0,
        gt=0,
        le=7 * 24 * 3600,
        allow_inf_nan=False,
        description="Seconds after its last use for which an export stays, so that its download can continue.",
    )
    review_days: Days = Field(
        default=90, description="Days after which a frame stored for review is discarded, with its label; 0: never."
    )
    picture_days: Days = Field(
        default=0, description="Days after which the picture of a place is deleted, and the place stays; 0: never."
    )
    answer_days: Days = Field(
        default=7, description="Days after which an answer is not among the latest ones any more; 0: never."
    )
    event_days: Days = Field(
        default=1, description="Days after which an event is not sent any more to listeners that resume; 0: never."
    )
    audit_days: Days = Field(
        default=365, description="Days after which a line of the audit trail is deleted where it is; 0: never."
    )
    disk_reserve_bytes: int = Field(
        default=16 * MIB,
        ge=0,
        le=1 << 40,
        description="Bytes of the disk that are held back, so that something can be deleted when it is full.",
    )
    thumbnail_side: int = Field(default=320, ge=16, le=2048, description="Longer side of a thumbnail, in pixels.")
    job_workers: int = Field(
        default=1, ge=1, le=16, description="Jobs that run at the same time, at most one of each map."
    )
    job_queue: int = Field(default=32, ge=1, le=10_000, description="Most jobs that wait; then 503.")
    job_history: int = Field(default=200, ge=1, le=100_000, description="Jobs that have ended and are still listed.")
    job_watchers: int = Field(
        default=64, ge=1, le=10_000, description="Most clients that follow jobs at the same time."
    )
    max_similarity_pairs: int = Field(
        default=4_000_000,
        ge=100,
        le=100_000_000,
        description="Most pairs of frames of two traverses that are compared; then 422.",
    )
    event_listeners: int = Field(
        default=64, ge=1, le=10_000, description="Most clients that listen to the events of maps at the same time."
    )
    statistics_seconds: Seconds = Field(
        default=30.0,
        description="Seconds between two writes of the statistics of queries; a crash loses the last ones.",
    )
    max_sessions: int = Field(default=256, ge=1, le=100_000, description="Most sessions of all maps together.")
    max_session_memory: int = Field(
        default=256 * MIB,
        ge=MIB,
        description="Most bytes that the beliefs of all sessions hold; then new ones are refused.",
    )
    session_expiry: float = Field(
        default=900.0,
        gt=0,
        le=7 * 24 * 3600,
        allow_inf_nan=False,
        description="Seconds without a frame after which a session ends; a client may ask for less.",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Lowest level that is logged."
    )

    @model_validator(mode="after")
    def _limits_fit_each_other(self) -> Settings:
        if self.max_batch_bytes < self.max_image_bytes:
            raise ValueError(f"{PREFIX}MAX_BATCH_BYTES is less than {PREFIX}MAX_IMAGE_BYTES")
        if self.max_upload_memory < self.max_batch_bytes:
            raise ValueError(f"{PREFIX}MAX_UPLOAD_MEMORY is less than {PREFIX}MAX_BATCH_BYTES")
        return self

    @model_validator(mode="after")
    def _backups_have_a_folder(self) -> Settings:
        if self.backup_dir is not None and self.backup_dir.exists() and not self.backup_dir.is_dir():
            raise ValueError(f"{PREFIX}BACKUP_DIR is no folder: {self.backup_dir}")
        return self

    @model_validator(mode="after")
    def _database_is_an_address(self) -> Settings:
        if self.database is not None and not re.match(r"postgres(ql)?://|\w+ *=", self.database.get_secret_value()):
            raise ValueError(f"{PREFIX}DATABASE is not an address such as postgresql://placerec:password@db/placerec")
        return self

    @property
    def models_directory(self) -> Path:
        """The directory of encoders besides the packaged ones; it need not exist."""
        return self.models_dir if self.models_dir is not None else self.data_dir.absolute().parent / "models"

    def host_names(self) -> frozenset[str]:
        """The names of ``allowed_hosts``, in lower case."""
        return frozenset(name for name in self.allowed_hosts.lower().split(",") if name)

    def is_loopback(self) -> bool:
        """Whether only this machine can reach the address that the service listens on."""
        try:
            return ipaddress.ip_address(self.host.strip("[]")).is_loopback
        except ValueError:
            return self.host == "localhost"

    def check_exposure(self, has_keys: bool = False) -> None:
        """Refuse to serve other machines without keys.

        Args:
            has_keys: whether a key was ever created, so that every request needs one.

        Raises:
            SettingsError: the host is not a loopback address, and anonymous use is not allowed.
        """
        if not has_keys and not self.is_loopback() and not self.allow_anonymous:
            raise SettingsError(
                f"{PREFIX}HOST is {self.host}, so other machines could use the service, and there are no keys. "
                "Create a key with 'placerec keys create', listen on 127.0.0.1, or set "
                f"{PREFIX}ALLOW_ANONYMOUS=true if the network is trusted."
            )


def read_settings() -> Settings:
    """Read the settings from the environment of this process.

    Raises:
        SettingsError: at least one value is not valid; the text has one line for each.
    """
    try:
        return Settings()
    except ValidationError as error:
        lines = []
        for fault in error.errors(include_url=False):
            name = PREFIX + "_".join(map(str, fault["loc"])).upper() if fault["loc"] else "settings"
            lines.append(f"{name}: {fault['msg'].removeprefix('Value error, ')}")
        raise SettingsError("\n".join(lines)) from error


def unknown_variables() -> list[str]:
    """Environment variables that look like settings but are none, most likely because of a typing error."""
    known = {PREFIX + name.upper() for name in Settings.model_fields} | {f"{PREFIX}URL", f"{PREFIX}KEY"}
    return sorted(name for name in os.environ if name.startswith(PREFIX) and name.upper() not in known)
