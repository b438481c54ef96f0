"""The manifests of Kubernetes, docker/kubernetes, as Helm renders them from the chart, docker/chart.

scripts/chart writes them; a test fails while they are stale.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from helm_python import Chart

ROOT = Path(__file__).parents[1]
CHART = ROOT / "docker/chart"
MANIFESTS = ROOT / "docker/kubernetes"
NAME = "placerec"
"""Of the release and of its name space."""


def rendered(values: Mapping[str, Any]) -> dict[str, str]:
    """The files that the chart becomes with these values in place of its own, by their path among the templates.

    Raises:
        helm_python.HelmError: a value is not one of the chart's, or of another kind.
    """
    with Chart.load(CHART) as chart:
        chart.validate_schema(dict(values))
        found = chart.render(dict(values), name=NAME, namespace=NAME)
    return {path.removeprefix(f"{NAME}/templates/"): text for path, text in found.items()}


def manifests() -> dict[Path, str]:
    """The files of docker/kubernetes and their content."""
    values = yaml.safe_load((CHART / "manifests.yaml").read_text())
    return {MANIFESTS / path: text for path, text in rendered(values).items() if path.endswith(".yaml")}


if __name__ == "__main__":
    for path, text in manifests().items():
        path.write_text(text)
