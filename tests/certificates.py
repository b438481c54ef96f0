"""Certificates for servers of tests."""

from __future__ import annotations

import subprocess
from pathlib import Path


def certify(folder: Path) -> None:
    """Make a certificate authority, and a certificate of it for localhost."""
    curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2"]
    own = ["-subj", "/CN=authority", "-keyout", f"{folder}/authority.key", "-out", f"{folder}/authority.pem"]
    host = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost", "-addext", "basicConstraints=CA:FALSE"]
    signed = ["-CA", f"{folder}/authority.pem", "-CAkey", f"{folder}/authority.key"]
    files = ["-keyout", f"{folder}/server.key", "-out", f"{folder}/server.pem"]
    for words in (own, [*host, *signed, *files]):
        subprocess.run(["openssl", "req", "-x509", *curve, *words], check=True, capture_output=True)
