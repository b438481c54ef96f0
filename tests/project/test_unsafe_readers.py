"""No module runs what it reads: no evaluated text, no archives unpacked as they come, no pickles.

Modules that read pickles cannot be imported: ruff's ``banned-api`` in ``pyproject.toml`` lists them.
"""

from __future__ import annotations

import ast
import re

import pytest

from tests.project.sources import FILES, ROOT, syntax_of


def test_nothing_reads_a_pickle() -> None:
    calls = []
    for path in FILES:
        if not re.search("allow_pickle|read_array", path.read_text()):
            continue
        for node in ast.walk(syntax_of(path)):
            if isinstance(node, ast.Attribute) and ast.unparse(node) == "np.lib.format.read_array":
                calls.append(f"{path.relative_to(ROOT)}:{node.lineno} {ast.unparse(node)}")
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle" and ast.unparse(node.value) != "False":
                calls.append(f"{path.relative_to(ROOT)}:{node.lineno} allow_pickle")
    assert calls == []


RUNNING = {
    "eval", "exec", "compile", "os.system", "os.popen", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "torch.load",
    "torch.jit.load", "torch.hub.load", "torch.package.PackageImporter", "cv2.FileStorage", "tarfile.open",
    "shutil.unpack_archive", "np.lib.format.read_array", "numpy.lib.format.read_array", "pandas.read_pickle",
    "scipy.io.loadmat", "loadmat", "importlib.import_module", "__import__",
}  # fmt: skip
"""Calls by which bytes that were read could run, end the process, or be laid out as files."""

MENTIONED = re.compile("|".join([*(re.escape(name) for name in RUNNING), "shell", r"\.extract"]))

ISOLATED = {
    ("lab/conversion/checkpoints.py", "torch.load(path, map_location='cpu', weights_only=True)"),
    ("lab/conversion/matfiles.py", "loadmat(path, struct_as_record=False)"),
}
"""Calls in readers that run in a child process with limits."""


@pytest.mark.thorough
@pytest.mark.parametrize("folder", ["core", "service", "lab"])
def test_nothing_runs_what_it_reads(folder: str) -> None:
    """What is parsed is parsed by readers that make values and nothing else; weights come from safetensors."""
    calls, isolated = [], set()
    for path in FILES:
        if not path.is_relative_to(ROOT / folder) or not MENTIONED.search(path.read_text()):
            continue
        for node in ast.walk(syntax_of(path)):
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                shell = any(word.arg == "shell" for word in node.keywords)
                allowed = (path.relative_to(ROOT).as_posix(), ast.unparse(node))
                if allowed in ISOLATED:
                    isolated.add(allowed)
                elif name in RUNNING or shell or name.endswith((".extractall", ".extract")):
                    calls.append(f"{path.relative_to(ROOT)}:{node.lineno} {name}")
    assert calls == []
    assert folder != "lab" or isolated == ISOLATED
