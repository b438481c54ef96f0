"""Everything an operator can set, from the environment (``PLACEREC_…``), validated at start."""

from __future__ import annotations

import ipaddress
import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from core.method.catalogue import DEFAULT_ENCODER

PREFIX = "PLACEREC_"
MIB = 1024 * 1024

Seconds = Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)]


class SettingsError(Exception):
    """A setting is wrong; the text names each by its variable and says why."""


class Settings(BaseSettings):
    """The service's settings; the defaults suit one machine with one user."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, frozen=True, extra="forbid")

    host: str = Field(default="127.0.0.1", min_length=1, description="Address to listen on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    allow_anonymous: bool = Field(
        default=False,
        description="Serve other machines although no key was ever created: whoever reaches the port may do "
        "everything. Once there are keys it opens nothing.",
    )
    rate_per_key: float = Field(
        default=0.0,
        ge=0,
        le=1_000_000,
        allow_inf_nan=False,
        description="Requests a second of one key (without keys: of one address); then 429. 0 sets no limit.",
    )
    rate_burst: int = Field(
        default=20, ge=1, le=1_000_000, description="Requests that may come at once before that rate holds."
    )
    audit_file: Path | None = Field(
        default=None, description="File to which the audit trail is appended, besides the log; none by default."
    )
    root_path: str = Field(
        default="",
        pattern=r"^(/[A-Za-z0-9._~-]+)*$",
        description="Path under which a proxy in front publishes the service, such as /placerec.",
    )
    data_dir: Path = Field(default=Path("data"), description="Directory of the maps; one process at a time holds it.")
    models_dir: Path | None = Field(
        default=None,
        description="Directory of encoders besides the packaged ones; default: 'models' beside the data directory.",
    )
    encoder: str = Field(
        default=DEFAULT_ENCODER,
        min_length=1,
        description="Encoder that is loaded at start and used where none is named.",
    )
    threads: int = Field(default=0, ge=0, le=1024, description="Threads of one forward pass; 0 uses every core.")
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        default="auto",
        description="Of the forward pass. auto: a lower one only where descriptors stay what they are, measured at "
        "start; bfloat16: that or no start.",
    )
    device: Literal["cpu", "cuda"] = Field(default="cpu", description="Where forward passes are computed.")
    storage_threads: int = Field(
        default=8, ge=1, le=256, description="Searches, reads and writes of maps that run at once."
    )
    queue_length: int = Field(
        default=32,
        ge=1,
        le=100_000,
        description="Requests that may wait for the encoder; one more is answered with 503.",
    )
    request_timeout: Seconds = Field(
        default=30.0,
        description="Seconds after which a request that still waits is dropped; a client may ask for less.",
    )
    shutdown_timeout: Seconds = Field(
        default=10.0, description="Seconds that requests under way get to finish when the service stops."
    )
    drain_seconds: float = Field(
        default=0.0,
        ge=0,
        le=600,
        allow_inf_nan=False,
        description="Seconds after SIGTERM in which readiness is denied but requests are still taken, so that a "
        "balancer sends no more.",
    )
    head_timeout: Seconds = Field(
        default=10.0, description="Seconds within which the head of a request has to come whole; then 408."
    )
    read_timeout: Seconds = Field(
        default=10.0, description="Seconds without a byte of a body after which its request is dropped."
    )
    write_timeout: Seconds = Field(
        default=30.0,
        description="Seconds within which a caller has to take 64 KiB of its answer, or all of it; then the connection "
        "is cut.",
    )
    keep_alive_timeout: Seconds = Field(
        default=75.0, description="Seconds without a request after which a connection is closed."
    )
    max_connections: int = Field(
        default=1000,
        ge=1,
        le=1_000_000,
        description="Open connections; one more closes that which has waited longest for a request, or else gets 503.",
    )
    max_connections_per_address: int = Field(
        default=500,
        ge=0,
        le=1_000_000,
        description="The same of one address, which behind a proxy is the proxy's; 0 sets no such limit.",
    )
    max_pipelined: int = Field(
        default=16, ge=1, le=1000, description="Requests sent ahead on one connection; those behind are not read."
    )
    max_url_bytes: int = Field(
        default=64 * 1024, ge=256, le=MIB, description="Longest path and query string together; then 414."
    )
    max_header_bytes: int = Field(default=16 * 1024, ge=256, le=MIB, description="All headers together; then 431.")
    max_headers: int = Field(default=100, ge=8, le=10_000, description="Headers of one request; then 431.")
    max_stream_messages: int = Field(
        default=256, ge=2, le=10_000, description="Messages that a robot may send ahead over a WebSocket."
    )
    max_stream_fragments: int = Field(
        default=1024, ge=1, le=1_000_000, description="Fragments of one message over a WebSocket."
    )
    max_maps: int = Field(default=1000, ge=1, le=100_000, description="Maps of the data directory; then 409.")
    max_places: int = Field(default=10_000_000, ge=1, description="Places of one map; then 409.")
    max_image_bytes: int = Field(default=16 * MIB, ge=1024, le=1024 * MIB, description="Largest frame, in bytes.")
    max_image_pixels: int = Field(
        default=40_000_000, ge=256, le=1_000_000_000, description="Largest frame, in pixels; read from its header."
    )
    max_batch_items: int = Field(default=256, ge=1, le=10_000, description="Most frames in one multipart request.")
    max_batch_bytes: int = Field(
        default=128 * MIB, ge=1024, le=4096 * MIB, description="Largest multipart request, in bytes."
    )
    max_bulk_items: int = Field(
        default=10_000, ge=1, le=200_000, description="Most frames in one multipart request that a job enrols."
    )
    max_bulk_bytes: int = Field(
        default=4096 * MIB, ge=1024, description="Largest multipart request that a job enrols, in bytes; on disk."
    )
    max_staged_bytes: int = Field(
        default=16384 * MIB, ge=1024, description="Bytes on disk that wait for such jobs; more are answered with 503."
    )
    bulk_timeout: Seconds = Field(
        default=3600.0, description="Seconds within which a request that a job enrols has to come whole."
    )
    max_upload_memory: int = Field(
        default=512 * MIB, ge=1024, description="Bytes of request bodies held at one time; more are answered with 503."
    )
    max_json_bytes: int = Field(default=1 * MIB, ge=1024, le=64 * MIB, description="Largest JSON body, in bytes.")
    max_metadata_bytes: int = Field(
        default=16 * 1024, ge=2, le=MIB, description="Largest metadata of one place, as JSON bytes."
    )
    max_import_bytes: int = Field(
        default=64 * 1024 * MIB, ge=1024, description="Largest file of a map that is imported, in bytes; on disk."
    )
    max_imports: int = Field(
        default=2, ge=1, le=1000, description="Maps that are being imported, or wait for it; one more gets 503."
    )
    import_timeout: float = Field(
        default=6 * 3600.0,
        gt=0,
        le=7 * 24 * 3600,
        allow_inf_nan=False,
        description="Seconds within which the file of a map has to arrive.",
    )
    max_exports: int = Field(
        default=4, ge=1, le=1000, description="Moments of maps that are kept for their downloads; one more gets 503."
    )
    export_seconds: float = Field(
        default=3600.0,
        gt=0,
        le=7 * 24 * 3600,
        allow_inf_nan=False,
        description="Seconds after its last use for which the moment of a download is kept, so that it can go on.",
    )
    thumbnail_side: int = Field(default=320, ge=16, le=2048, description="Longer side of a kept thumbnail, in pixels.")
    job_workers: int = Field(default=1, ge=1, le=16, description="Jobs that run at one time; at most one of each map.")
    job_queue: int = Field(
        default=32, ge=1, le=10_000, description="Jobs that may wait; one more is answered with 503."
    )
    job_history: int = Field(default=200, ge=1, le=100_000, description="Jobs that have ended and can still be read.")
    job_watchers: int = Field(default=64, ge=1, le=10_000, description="Clients that may follow jobs at one time.")
    statistics_seconds: Seconds = Field(
        default=30.0, description="Seconds between two writings of what queries were answered; a crash loses the last."
    )
    max_sessions: int = Field(default=256, ge=1, le=100_000, description="Sessions of all maps together.")
    max_session_memory: int = Field(
        default=256 * MIB, ge=MIB, description="Bytes that the beliefs of all sessions may hold; more are refused."
    )
    session_expiry: float = Field(
        default=900.0,
        gt=0,
        le=7 * 24 * 3600,
        allow_inf_nan=False,
        description="Seconds without a frame after which a session ends; one may ask for less.",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Least level that is logged."
    )

    @model_validator(mode="after")
    def _limits_fit_each_other(self) -> Settings:
        if self.max_batch_bytes < self.max_image_bytes:
            raise ValueError(f"{PREFIX}MAX_BATCH_BYTES is less than {PREFIX}MAX_IMAGE_BYTES")
        if self.max_upload_memory < self.max_batch_bytes:
            raise ValueError(f"{PREFIX}MAX_UPLOAD_MEMORY is less than {PREFIX}MAX_BATCH_BYTES")
        return self

    @property
    def models_directory(self) -> Path:
        """Where encoders besides the packaged ones lie; it need not exist."""
        return self.models_dir if self.models_dir is not None else self.data_dir.absolute().parent / "models"

    def is_loopback(self) -> bool:
        """Whether only this machine can reach the address to listen on."""
        try:
            return ipaddress.ip_address(self.host.strip("[]")).is_loopback
        except ValueError:
            return self.host == "localhost"

    def check_exposure(self, has_keys: bool = False) -> None:
        """Refuse to serve other machines without keys.

        Args:
            has_keys: a key was created at some time, so that every request needs one.

        Raises:
            SettingsError: the host is no loopback address and anonymous use is not allowed.
        """
        if not has_keys and not self.is_loopback() and not self.allow_anonymous:
            raise SettingsError(
                f"{PREFIX}HOST is {self.host}: other machines could use the service, and there are no keys. "
                "Create one with 'placerec keys create', listen on 127.0.0.1, or set "
                f"{PREFIX}ALLOW_ANONYMOUS=true if the network is trusted."
            )


def read_settings() -> Settings:
    """The settings of this process's environment.

    Raises:
        SettingsError: at least one value is not usable; the text has one line for each.
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
    """Variables of the environment that look like settings and are none (a typing error, most likely)."""
    known = {PREFIX + name.upper() for name in Settings.model_fields} | {f"{PREFIX}URL", f"{PREFIX}KEY"}
    return sorted(name for name in os.environ if name.startswith(PREFIX) and name.upper() not in known)
