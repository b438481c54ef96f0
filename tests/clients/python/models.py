"""The modules of the client that are written: models, parameters and problems from ``openapi.json``, pixel formats
from the core's.

python -m tests.clients.python.models     # writes them; so does scripts/client
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "clients" / "python" / "placerec_client"
DOCUMENT = json.loads((ROOT / "openapi.json").read_text())
SCHEMAS = DOCUMENT["components"]["schemas"]
METHODS = ("get", "post", "put", "patch", "delete")

SENT = (
    *("NewMap", "MapChanges", "PlaceChanges", "NewSession", "Aligning", "Pruning", "Erasing", "Merging", "Reencoding"),
    *("CalibrationOrder", "CameraDefinition", "NewKey", "KeyChanges", "Deletion", "LabelOrder"),
    *("RecordingOrder", "TraverseToCompare"),
)
"""Schemas of bodies. They lose their required fields, which the calls take by position."""

LISTS = {"sequences": "str", "levels": "str", "kinds": "str", "verdicts": "str", "soft": "str", "maps": "str"}
LISTS |= {"bbox": "float", "odometry_covariance": "float"}
OBJECTS = {"where", "metadata", "cameras"}
"""Parameters of the query string that hold lists and JSON objects; the client takes them as such, too."""

BY_CALL = ("cursor", "wait", "background", "with")
"""Parameters that a call sets itself, or takes otherwise."""

REMARK = """\"\"\"{}

Written from openapi.json by scripts/client.  Do not edit.
\"\"\"

from __future__ import annotations
"""
SCALARS = {"integer": "int", "number": "float", "string": "str", "boolean": "bool", "null": "None"}
FORMATS = {"date-time": "datetime", "date": "date", "binary": "bytes"}
LINE = 120


def annotation(schema: Mapping[str, Any], sent: bool) -> str:
    """The type of a value; what is ``sent`` may be looser than what comes."""
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    for several in ("anyOf", "oneOf"):
        if several in schema:
            return " | ".join(dict.fromkeys(annotation(one, sent) for one in schema[several]))
    if "const" in schema:
        return "str"
    if "enum" in schema:
        values = ", ".join(json.dumps(value) for value in schema["enum"])
        return f"Literal[{values}]" if sent else f"Known[Literal[{values}]]"
    if schema.get("type") == "array":
        return array(schema, sent)
    if schema.get("type") == "object":
        values = schema.get("additionalProperties", True)
        inner = annotation(values, sent) if isinstance(values, dict) else "Any"
        return f"{'Mapping' if sent else 'dict'}[str, {inner}]"
    if "format" in schema and schema["format"] in FORMATS:
        made = FORMATS[schema["format"]]
        if not sent:
            return made
        return f"{made} | float | str" if made == "datetime" else f"{made} | str"
    return SCALARS.get(schema.get("type", ""), "Any")


def array(schema: Mapping[str, Any], sent: bool) -> str:
    if "prefixItems" in schema:
        return f"tuple[{', '.join(annotation(one, sent) for one in schema['prefixItems'])}]"
    return f"{'Sequence' if sent else 'list'}[{annotation(schema.get('items', {}), sent)}]"


def text(described: str, indent: str = "    ") -> str:
    """A docstring, wrapped by hand where it is too long for a line."""
    words, lines, line = described.replace("\\", "\\\\").split(), [], f'{indent}"""'
    for word in words:
        if len(line) + len(word) + 4 > LINE:
            lines.append(line)
            line = indent + word
        else:
            line += word if line.endswith('"""') or not line.strip() else " " + word
    if lines:
        return "\n".join([*lines, line, f'{indent}"""'])
    return line + '"""'


def models() -> str:
    """The module of the models of all answers."""
    lines = [
        REMARK.format(
            "Models of the answers of the service: one for each schema of its interface, under the same name."
        ).replace("from __future__ import annotations\n", ""),  # pydantic would evaluate each, which takes time
        "from datetime import date, datetime",
        "from typing import Any, Literal",
        "",
        "from pydantic import Field",
        "",
        "from placerec_client.model import Known, Model",
        "",
    ]
    for name in ordered(answered()):
        schema = SCHEMAS[name]
        bases = 'Model, extra="allow"' if schema.get("additionalProperties") is True else "Model"
        lines += ["", f"class {name}({bases}):"]
        lines.append(text(schema.get("description") or f"The schema {name} of the interface."))
        required = schema.get("required", ())
        fields = [model_field(field, one, field in required) for field, one in schema["properties"].items()]
        lines += ["", *fields, ""]
    return "\n".join(lines)


def answered() -> set[str]:
    """The schemas that answers consist of."""
    waiting = [answer for _, _, one in operations() for answer in one["responses"].values()]
    found: set[str] = set()
    while waiting:
        for name in set(re.findall(r"#/components/schemas/(\w+)", json.dumps(waiting.pop()))) - found:
            found.add(name)
            waiting.append(SCHEMAS[name])
    return found


def ordered(names: set[str]) -> list[str]:
    """The schemas by their names, but none before those that it consists of."""
    found: list[str] = []

    def add(name: str) -> None:
        for part in sorted(set(re.findall(r"#/components/schemas/(\w+)", json.dumps(SCHEMAS[name])))):
            add(part)
        if name not in found:
            found.append(name)

    for name in sorted(names):
        add(name)
    return found


def model_field(name: str, schema: Mapping[str, Any], required: bool) -> str:
    kind = annotation(schema, sent=False)
    nullable = "None" in kind.split(" | ")
    default = schema.get("default")
    if isinstance(default, list) and default:
        return f"    {name}: {kind} = Field(default={default!r})"
    if default not in (None, []) and not isinstance(default, dict):
        return f"    {name}: {kind} = {default!r}"
    if nullable or (not required and not kind.startswith("list")):
        return f"    {name}: {kind if nullable else kind + ' | None'} = None"
    return f"    {name}: {kind}" + ("" if required else " = Field(default_factory=list)")


def operations() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Every operation with its method and path."""
    for path, item in DOCUMENT["paths"].items():
        for method in METHODS:
            if method in item:
                yield method.upper(), path, item[method]


def camel(name: str) -> str:
    return "".join(part.capitalize() for part in name.replace("-", "_").split("_"))


def parameters() -> str:
    """The module of the keyword arguments of all calls."""
    lines = [
        REMARK.format("The keyword arguments of the calls, as types: what each operation takes besides its frames."),
        "from collections.abc import Mapping, Sequence",
        "from datetime import datetime",
        "from typing import Any, Literal, NotRequired, Required, TypedDict",
        "",
    ]
    for _, path, operation in operations():
        found = [one for one in operation.get("parameters", ()) if one["in"] == "query"]
        if found:
            lines += ["", f"class {camel(operation['operationId'])}(TypedDict, total=False):"]
            lines += [text(f"Parameters of ``{path}``."), ""]
            for one in found:
                if one["name"] not in BY_CALL and not one.get("required"):
                    lines += [f"    {one['name']}: {parameter_type(one)}", text(one.get("description", "")), ""]
    for name in [*SENT, *nested()]:
        lines += body(name, SCHEMAS[name], name not in SENT)
    return "\n".join(lines)


def parameter_type(parameter: Mapping[str, Any]) -> str:
    name = parameter["name"]
    if name in LISTS:
        return f"str | Sequence[{LISTS[name]}] | None"
    if name in OBJECTS:
        return "str | Mapping[str, Any] | None"
    return annotation(parameter["schema"], sent=True)


def nested() -> list[str]:
    """The schemas that stand within bodies; a caller writes them as dictionaries."""
    return [name for name in ordered(set(SENT)) if name not in SENT]


def body(name: str, schema: Mapping[str, Any], nested: bool) -> list[str]:
    required = schema.get("required", ())
    lines = ["", f"class {name}(TypedDict{'' if nested else ', total=False'}):"]
    lines += [text(schema.get("description") or f"Fields of {name}."), ""]
    for field, one in schema["properties"].items():
        if (field in required or field in BY_CALL) and not nested:
            continue
        kind = annotation(one, sent=True)
        shown = f"{field}_" if field in ("from", "with") else field
        lines.append(f"    {shown}: {kind if not nested or field in required else f'NotRequired[{kind}]'}")
        if one.get("description"):
            lines.append(text(one["description"]))
        lines.append("")
    return lines


def problems() -> str:
    """The module of the exceptions, one for each kind of problem."""
    lines = [
        REMARK.format("One exception for each kind of problem that the service answers with."),
        "from placerec_client import errors",
        "from placerec_client.errors import Problem",
        "",
    ]
    page = (ROOT / "docs" / "reference" / "http-operations.md").read_text()  # it has those of the framework, too
    table = []
    for slug, status, title in re.findall(r"^\| `([a-z-]+)` \| ([0-9]{3}) \| (.*) \|$", page, re.MULTILINE):
        name, base = camel(slug), "Problem"
        if slug == "deadline-exceeded":
            name, base = "DeadlineExceededByService", "Problem, errors.DeadlineExceeded"
        lines += ["", f"class {name}({base}):", text(f"{status} ``{slug}``: {title}."), ""]
        table.append(f'    "{slug}": {name},')
    lines += ["", "BY_SLUG: dict[str, type[Problem]] = {", *table, "}", '"""The exception of each kind."""', ""]
    return "\n".join(lines)


def pixel_formats() -> str:
    """The module of the pixel formats: the core's own, which the client may not import."""
    source = (ROOT / "core" / "frames" / "pixel_formats.py").read_text()
    return "# Written from core/frames/pixel_formats.py by scripts/client.  Do not edit.\n" + source


MODULES = {
    "models.py": models,
    "parameters.py": parameters,
    "problems.py": problems,
    "pixel_formats.py": pixel_formats,
}


def formatted(source: str, name: str) -> str:
    """The source as the project's formatter writes it, without imports that it does not need."""
    ruff = [sys.executable, "-m", "ruff"]
    check = [*ruff, "check", "--quiet", "--fix-only", "--select", "F401,I", "--stdin-filename", name, "-"]
    format_ = [*ruff, "format", "--quiet", "--stdin-filename", name, "-"]
    for command in (check, format_):
        source = subprocess.run(command, input=source, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    return source


def files() -> dict[Path, str]:
    """The modules and their text."""
    paths = {PACKAGE / name: render for name, render in MODULES.items()}
    return {path: formatted(render(), str(path.relative_to(ROOT))) for path, render in paths.items()}


def main() -> None:
    """Write the modules."""
    for path, text in files().items():
        path.write_text(text)


if __name__ == "__main__":
    main()
