"""The chart, rendered by Helm: the manifests are it, and what its values leave out is named nowhere."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from service.settings import Settings
from tests.project.test_cluster_files import VERSION as KUBERNETES
from tests.project.test_cluster_files import settings_in

helm = pytest.importorskip("helm_python", reason="Helm's library has a wheel for Linux on x86-64 alone")
from scripts.manifests import CHART, rendered  # noqa: E402

NO = {"enabled": False}
VARIANTS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "without Milvus": {"milvus": NO},
    "stores elsewhere": {"stores": NO, "network": {"to": [{"cidr": "192.0.2.7/32", "port": 5432}]}},
    "PostgreSQL alone": {"milvus": NO},
    "no ingress, rules or backup": {"ingress": NO, "network": NO, "backup": NO},
    "all given": {
        "image": "registry.example.org/placerec:1",
        "service": {"replicas": 3, "cpu": "500m"},
        "settings": {"PLACEREC_LOG_LEVEL": "debug", "PLACEREC_THREADS": 2},
        "stores": {"storageClass": "fast"},
        "backup": {"storageClass": "slow"},
        "ingress": {"class": "nginx"},
        "once": {"firstKey": True, "restore": True},
    },
}


@cache
def files_of(variant: str) -> dict[str, str]:
    return rendered(VARIANTS[variant])


@cache
def objects_of(variant: str) -> list[dict[str, Any]]:
    texts = [text for path, text in files_of(variant).items() if path.endswith(".yaml")]
    return [one for text in texts for one in yaml.safe_load_all(text) if one is not None]


def containers_of(objects: list[dict[str, Any]]) -> list[dict[str, Any]]:
    templates = [one["spec"]["template"] for one in objects if one["kind"] in ("Deployment", "StatefulSet", "Job")]
    templates += [one["spec"]["jobTemplate"]["spec"]["template"] for one in objects if one["kind"] == "CronJob"]
    return [container for template in templates for container in template["spec"]["containers"]]


def secrets_of(objects: list[dict[str, Any]]) -> set[tuple[str, str]]:
    """The secrets that containers wait for, and their keys."""
    return {
        (key["name"], key["key"])
        for container in containers_of(objects)
        for variable in container.get("env", ())
        if (key := variable.get("valueFrom", {}).get("secretKeyRef"))
    }


def test_helm_finds_nothing_wrong() -> None:
    found = helm.lint(CHART, strict=True)
    assert found["errors"] == [] and [one for one in found["messages"] if one["severity"] > 1] == []


@pytest.mark.thorough
@pytest.mark.parametrize("variant", VARIANTS)
def test_what_is_rendered_is_valid(variant: str) -> None:
    found = objects_of(variant)
    for one in found:
        kubernetes_validate.validate(one, KUBERNETES, strict=True)
        assert one["metadata"]["namespace"] == "placerec"
    names = [(one["kind"], one["metadata"]["name"]) for one in found]
    assert len(names) == len(set(names)) and ("Deployment", "placerec") in names
    assert not {"Namespace", "Secret"} & {kind for kind, _ in names}, "passwords would stand in the release"


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_service_knows_its_variables(variant: str) -> None:
    found = objects_of(variant)
    (told,) = (one["data"] for one in found if one["kind"] == "ConfigMap" and one["metadata"]["name"] == "placerec")
    (service,) = (one for one in containers_of(found) if one["name"] == "placerec")
    assert settings_in({**told, **{one["name"]: one for one in service["env"]}}) <= set(Settings.model_fields)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_notes_make_the_secrets_that_pods_wait_for(variant: str) -> None:
    notes = files_of(variant)["NOTES.txt"].replace("\\\n", " ")
    made = {
        (name, key)
        for name, keys in re.findall(r"create secret generic (\S+) (.*)", notes)
        for key in re.findall(r"--from-literal=(\w+)=", keys)
    }
    assert secrets_of(objects_of(variant)) <= made
    assert {name for name, _ in made} == {name for name, _ in secrets_of(objects_of(variant))}


@pytest.mark.parametrize(
    ("variant", "word"),
    [
        ("without Milvus", "etcd:2379"),
        ("without Milvus", "PLACEREC_MILVUS"),
        ("PostgreSQL alone", "serviceName: etcd"),
        ("stores elsewhere", "kind: StatefulSet"),
        ("no ingress, rules or backup", "kind: Ingress "),
        ("no ingress, rules or backup", "kind: NetworkPolicy"),
        ("no ingress, rules or backup", "kind: CronJob"),
    ],
)
def test_what_is_left_out_is_nowhere(variant: str, word: str) -> None:
    def words(variant: str) -> str:
        texts = (yaml.safe_dump(one) for one in objects_of(variant) if one["kind"] != "NetworkPolicy" or "kind" in word)
        return " ".join(" ".join(texts).split()) + " "

    assert word in words("defaults") and word not in words(variant)


def test_values_reach_what_they_name() -> None:
    found = objects_of("all given")
    images = {container["image"] for container in containers_of(found)}
    assert "registry.example.org/placerec:1" in images and "placerec:cluster" not in images
    by_name = {(one["kind"], one["metadata"]["name"]): one for one in found}
    assert by_name["ConfigMap", "placerec"]["data"].items() >= {
        ("PLACEREC_LOG_LEVEL", "debug"),
        ("PLACEREC_THREADS", "2"),
    }
    claims = [
        one["spec"]["volumeClaimTemplates"][0]["spec"] for (kind, _), one in by_name.items() if kind == "StatefulSet"
    ]
    assert len(claims) == 3 and {claim["storageClassName"] for claim in claims} == {"fast"}
    assert by_name["PersistentVolumeClaim", "backups"]["spec"]["storageClassName"] == "slow"
    assert by_name["HorizontalPodAutoscaler", "placerec"]["spec"]["minReplicas"] == 3
    assert by_name["Ingress", "placerec"]["spec"]["ingressClassName"] == "nginx"
    assert {("Job", "first-key"), ("Job", "restore")} <= set(by_name)


@pytest.mark.parametrize(
    "values",
    [
        {"replicas": 3},
        {"service": {"replicas": "three"}},
        {"settings": {"LOG_LEVEL": "debug"}},
        {"settings": {"PLACEREC_MILVUS": "http://other"}},  # it has a value of its own
        {"stores": {"postgres": {"storage": "much"}}},
    ],
)
def test_a_value_that_the_chart_does_not_have_is_refused(values: dict[str, Any]) -> None:
    with pytest.raises(helm.HelmValuesError):
        rendered(values)


def test_it_becomes_one_file(tmp_path: Path) -> None:
    made = Path(helm.package(CHART, destination=tmp_path))
    about = yaml.safe_load((CHART / "Chart.yaml").read_text())
    assert made.name == f"placerec-{about['version']}.tgz"
    with helm.Chart.load(made) as chart:
        assert chart.version == about["appVersion"] and "manifests.yaml" not in {one["name"] for one in chart.files}
