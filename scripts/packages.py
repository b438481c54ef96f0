"""Install the packages of a lock file into the environment of the Python that runs this.

    .venv/bin/python scripts/packages.py service|bags|lab|replica|development
    .venv-ros/bin/python scripts/packages.py ros        # without torch
    .venv-cluster/bin/python scripts/packages.py cluster
    .venv/bin/python scripts/packages.py --settings     # prints uv's variables for pip's configuration

uv does it in seconds; requirements/installer.lock pins it.  Where uv cannot be had, or fails, pip does it.  Both look
where pip is configured to look.  All profiles but ``ros`` and ``cluster`` have torch.  TORCH_BACKEND names the build of
torch: ``cpu`` (the default), ``auto`` (CUDA if this machine has a driver for it), any other that ``uv pip install
--torch-backend`` knows, or ``none``: the service does without torch.  uv looks for it in PyTorch's own indexes; where
these cannot be reached, torch is the build that pip's indexes have.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tempfile
from pathlib import Path

REQUIREMENTS = Path(__file__).parents[1] / "requirements"
PIP = (sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
SECTIONS = ("global", "install", ":env:")
"""The sections of pip's configuration that matter here; the last one that has a value counts."""

SETTINGS = {
    "index-url": ("UV_DEFAULT_INDEX", " "),
    "extra-index-url": ("UV_INDEX", " "),
    "find-links": ("UV_FIND_LINKS", ","),
    "trusted-host": ("UV_INSECURE_HOST", " "),
    "cert": ("SSL_CERT_FILE", " "),
    "proxy": ("ALL_PROXY", " "),
    "timeout": ("UV_HTTP_TIMEOUT", " "),
}
"""uv's variable for each of pip's settings, and what separates several values in it."""


def pip_settings() -> str:
    """The output of ``pip config list``."""
    return subprocess.run([*PIP[:3], "config", "list"], check=True, capture_output=True, text=True).stdout


def configured(listing: str) -> dict[str, list[str]]:
    """The values of pip's settings by what ``pip config list`` has printed; empty ones count as not set, as for pip."""
    found: dict[str, tuple[int, list[str]]] = {}
    for line in listing.splitlines():
        name, _, value = line.partition("=")
        section, _, key = name.partition(".")
        if section in SECTIONS and (values := str(ast.literal_eval(value)).split()):
            key, rank = key.removeprefix("default-"), SECTIONS.index(section)  # pip's timeout has two names
            if rank >= found.get(key, (0, []))[0]:
                found[key] = rank, values
    return {key: values for key, (_, values) in found.items()}


def uv_settings(listing: str) -> dict[str, str]:
    """uv's environment variables for what ``pip config list`` has printed."""
    stated = configured(listing)
    # Of all indexes the best version, as pip does, not that of the first index; hashes say which files are right.
    return {"UV_INDEX_STRATEGY": "unsafe-best-match"} | {
        variable: separator.join(stated[key]) for key, (variable, separator) in SETTINGS.items() if key in stated
    }


def without_index(listing: str) -> bool:
    """Whether pip is set to query no index, by the output of ``pip config list``; uv has no variable for it."""
    return " ".join(configured(listing).get("no-index", [])).lower() in ("1", "true", "yes", "on", "y", "t")


class UnknownBackend(Exception):
    """TORCH_BACKEND names no build of torch."""


def install_by_uv(lock: Path, folder: Path, torch: bool) -> None:
    """Install the lock's packages, and torch, by a uv that is put into ``folder``.

    Raises:
        UnknownBackend: uv knows no such build of torch.
        subprocess.CalledProcessError, OSError: uv cannot be had, or fails.
    """
    tool = ("--requirement", REQUIREMENTS / "installer.lock")
    subprocess.run([*PIP, "--target", folder, "--no-deps", "--require-hashes", *tool], check=True)
    listing = pip_settings()
    environment = {**uv_settings(listing), **os.environ}
    indexes = ("--no-index",) if without_index(listing) else ()
    of_torch = ("--requirement", REQUIREMENTS / "torch.lock")
    backend: tuple[str, ...] = ("--torch-backend", os.environ.get("TORCH_BACKEND", "cpu"))

    def uv(*arguments: str | Path, quiet: bool = False) -> subprocess.CompletedProcess[bytes]:
        command = [folder / "bin" / "uv", "pip", "install", "--quiet", *indexes, "--python", sys.executable, *arguments]
        return subprocess.run(command, env=environment, check=not quiet, capture_output=quiet)

    if not torch:
        uv("--require-hashes", "--requirement", lock)
        return
    first = uv("--no-deps", *backend, *of_torch, quiet=True)
    if first.returncode:
        why = first.stderr.decode(errors="replace").strip()
        if "invalid value" in why:
            raise UnknownBackend(why)
        print(
            f"The {backend[1]} build of torch cannot be had from PyTorch's own index. torch is the build that pip's"
            f" indexes have; if that is the CUDA build, it takes several GB. uv says: {' '.join(why.split())[:500]}",
            file=sys.stderr,
        )
        backend = ()
        uv("--no-deps", *of_torch)
    uv("--require-hashes", "--requirement", lock)
    uv(*backend, *of_torch)  # the libraries that a CUDA build asks for; the CPU build's are in the lock


def install_by_pip(lock: Path, torch: bool) -> None:
    """Install the lock's packages, and torch, by pip, torch from wherever it finds it.

    Raises:
        subprocess.CalledProcessError: it fails.
    """
    packages, of_torch = ("--require-hashes", "--requirement", lock), ("--requirement", REQUIREMENTS / "torch.lock")
    # torch first and by its exact pin, so that nothing else can bring in another build.
    steps = (("--no-deps", *of_torch), packages, of_torch) if torch else (packages,)
    for arguments in steps:
        subprocess.run([*PIP, *arguments], check=True)


def main(profile: str) -> int:
    """Install a profile, or print uv's settings; the exit status."""
    if profile == "--settings":
        print("\n".join(f"{name}={value}" for name, value in uv_settings(pip_settings()).items()))
        return 0
    lock = REQUIREMENTS / f"{profile}.lock"
    torch = profile not in ("ros", "cluster") and os.environ.get("TORCH_BACKEND") != "none"
    try:
        try:
            with tempfile.TemporaryDirectory() as folder:
                install_by_uv(lock, Path(folder), torch)
        except (subprocess.CalledProcessError, OSError):
            print("uv could not install the packages; pip does it, which takes minutes.", file=sys.stderr)
            install_by_pip(lock, torch)
    except UnknownBackend as error:
        print(f"TORCH_BACKEND names no build of torch. {error}", file=sys.stderr)
        return 1
    except subprocess.CalledProcessError as error:
        print(f"The packages could not be installed: pip ended with status {error.returncode}.", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
