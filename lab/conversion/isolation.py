"""Other people's files are read in a process of their own, which may crash but takes neither much memory nor long.

The libraries that read checkpoints, MATLAB files and Caffe's messages were not made for hostile files: some end the
process, some take all memory.  The child process reads the file and writes what it found as safetensors, with a
description in JSON; neither can hold code, and the parent believes nothing else.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, cast

from safetensors import SafetensorError, safe_open

from core.errors import InvalidModel

MAX_FILE = 4 * 2**30
"""Bytes of a file; the largest published networks have 0.6 GB."""

SPARE_MEMORY = 2**30
"""Bytes that reading may take beside four times the size of the file."""

SECONDS = 300
"""Of computing, and twice that of waiting."""

_REFUSED = 3
"""Exit status of a child whose last line on standard error says what is wrong with the file."""

Tree = Any
"""Dictionaries, lists, texts, numbers."""


class Contents(Mapping[str, Any]):
    """The arrays of a safetensors file by name, each read when it is looked up.

    Args:
        framework: "pt" for torch's tensors, "numpy" for arrays.

    Raises:
        SafetensorError: the file is damaged.
    """

    def __init__(self, path: Path, framework: Literal["pt", "numpy"]) -> None:
        self._file = cast(Any, safe_open(path, framework))
        self._names = tuple(self._file.keys())

    @property
    def tree(self) -> Tree:
        """The output of a child process beside the arrays."""
        return json.loads(self._file.metadata()["tree"])

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, name: str) -> Any:
        if name not in self._names:
            raise KeyError(name)
        return self._file.get_tensor(name)


def read_in_child(
    module: str, path: Path, *arguments: str, framework: Literal["pt", "numpy"], room: int = 0
) -> Contents:
    """The result of a module of this room for a file, run in a child process.

    Args:
        module: calls :func:`serve` when it is run.
        arguments: of the module's reader, besides the path.
        room: bytes that it may take beside those of any reader.

    Raises:
        InvalidModel: the file cannot be read or is not what the module reads.
    """
    size = len(first_bytes(path, 1)) and path.stat().st_size
    if not 0 < size <= MAX_FILE:
        raise InvalidModel(f"{path.name} has {size} bytes; from 1 to {MAX_FILE} are read.")
    with _temporary_folder() as folder:
        target = folder / "contents.safetensors"
        memory = str(SPARE_MEMORY + 4 * size + room)
        command = [sys.executable, "-P", "-m", module, str(path.absolute()), str(target), memory, *arguments]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1"}
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                timeout=2 * SECONDS, env=environment, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise InvalidModel(f"{path.name} cannot be used: reading it takes too long.") from None
        if not done.returncode:
            with suppress(OSError, SafetensorError):
                return Contents(target, framework)
        said = "it is damaged, or reading it takes too much memory or too long."
        if done.returncode == _REFUSED:
            said = done.stderr.decode(errors="replace").splitlines()[-1]
        raise InvalidModel(f"{path.name} cannot be used: {said}")


@contextmanager
def _temporary_folder() -> Iterator[Path]:
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="placerec-import-"))
        except OSError as error:
            raise InvalidModel(
                f"There is no room for temporary files ({error}); TMPDIR names another folder."
            ) from error
        yield Path(folder)


def first_bytes(path: Path, count: int) -> bytes:
    """The beginning of a file.

    Raises:
        InvalidModel: there is no such file, or it cannot be read.
    """
    try:
        if not path.is_file():
            raise FileNotFoundError("there is no such file")
        with path.open("rb") as file:
            return file.read(count)
    except OSError as error:
        raise InvalidModel(f"{path.name} cannot be read: {error}") from error


def serve(read: Callable[..., tuple[Tree, Mapping[str, Any]]], save: Callable[..., None]) -> None:
    """Be the child process: read the file that the command line names, write what was found, and end.

    Args:
        read: gives the description and the arrays of a file, or raises any error.
        save: safetensors' ``save_file`` for the arrays.
    """
    source, target, memory, *arguments = sys.argv[1:]
    limit(resource.RLIMIT_AS, address_space() + int(memory))
    limit(resource.RLIMIT_CPU, SECONDS)
    limit(resource.RLIMIT_CORE, 0)
    try:
        convert(read, save, Path(source), Path(target), *arguments)
    except InvalidModel as error:
        sys.stderr.write(f"\n{error}\n")
        sys.exit(_REFUSED)


def convert(
    read: Callable[..., tuple[Tree, Mapping[str, Any]]],
    save: Callable[..., None],
    source: Path,
    target: Path,
    *arguments: str,
) -> None:
    """Read a file and write what was found.

    Raises:
        InvalidModel: with one line, whatever the reader raised.
        MemoryError: there is not enough memory.
    """
    try:
        tree, arrays = read(source, *arguments)
        described = json.dumps(tree)
    except MemoryError:
        raise
    except Exception as error:  # of damaged files the libraries raise whatever their parsers do
        text = str(error) if isinstance(error, InvalidModel) else f"it is damaged: {type(error).__name__}: {error}"
        raise InvalidModel(" ".join(text.split())[:500]) from error
    try:
        save(dict(arrays), target, {"tree": described})
    except (OSError, SafetensorError) as error:
        text = f"what it holds cannot be written to a temporary folder ({error}); TMPDIR names another one."
        raise InvalidModel(" ".join(text.split())[:500]) from error


def limit(kind: int, most: int) -> None:
    """Set a limit of this process for good, unless a lower one holds already."""
    _, hard = resource.getrlimit(kind)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(kind, (most, most))


def address_space() -> int:
    """Bytes of memory that this process has mapped; 1 TiB, which limits nothing, where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 2**40
