"""The files of a cluster: compose and Kubernetes by their schemas, and nginx's configuration in a real nginx."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import kubernetes_validate
import psycopg
import pytest
import yaml
from compose_spec import PyCompose

from service.settings import Settings
from tests.project.test_container import seconds, service
from tests.servers.postgres import Postgres
from tests.service.balancer import balanced, nginx_with
from tests.service.server import free_port

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
COMPOSE = DOCKER / "compose.cluster.yaml"
GUIDE = ROOT / "docs/how-to/run-a-cluster.md"
MANIFESTS = sorted((DOCKER / "kubernetes").rglob("*.yaml"))
VERSION = "1.31"
"""Of Kubernetes, the oldest that the manifests are meant for."""


@cache
def compose() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(COMPOSE.read_text())
    return found


@cache
def objects(kind: str) -> dict[str, dict[str, Any]]:
    """All objects of a kind by name."""
    found = [one for path in MANIFESTS for one in yaml.safe_load_all(path.read_text())]
    return {one["metadata"]["name"]: one for one in found if one["kind"] == kind}


@cache
def pods() -> dict[str, dict[str, Any]]:
    """The templates of all pods by the name of what makes them."""
    found = {
        name: one["spec"]["template"]
        for kind in ("Deployment", "StatefulSet", "Job")
        for name, one in objects(kind).items()
    }
    return found | {name: one["spec"]["jobTemplate"]["spec"]["template"] for name, one in objects("CronJob").items()}


def settings_in(variables: dict[str, Any]) -> set[str]:
    return {name.removeprefix("PLACEREC_").lower() for name in variables if name.startswith("PLACEREC_")}


def test_compose_files_are_valid() -> None:
    for path in (COMPOSE, DOCKER / "compose.yaml", DOCKER / "compose.tls.yaml"):
        found = PyCompose.from_yaml(yaml.safe_dump(yaml.safe_load(path.read_text())))
        found.validate_networks()
        found.validate_volumes()


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.stem)
def test_manifests_are_valid(path: Path) -> None:
    for one in yaml.safe_load_all(path.read_text()):
        kubernetes_validate.validate(one, VERSION, strict=True)
        assert one["kind"] == "Namespace" or one["metadata"]["namespace"] == "placerec"


def test_only_nginx_is_published_and_on_this_machine_alone() -> None:
    published = {name: found["ports"] for name, found in compose()["services"].items() if "ports" in found}
    assert list(published) == ["nginx"]
    assert all(port.startswith("127.0.0.1:") for port in published["nginx"])


@pytest.mark.thorough
def test_every_container_is_confined_and_returns() -> None:
    for name, found in compose()["services"].items():
        assert found["restart"] == "unless-stopped" and found["cap_drop"] == ["ALL"], name
        assert found["security_opt"] == ["no-new-privileges:true"] and "mem_limit" in found, name
    for name, template in pods().items():
        pod = template["spec"]
        assert pod["securityContext"]["runAsNonRoot"] and not pod["automountServiceAccountToken"], name
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}, name
        for container in pod["containers"]:
            may = container["securityContext"]
            assert may["capabilities"] == {"drop": ["ALL"]} and not may["allowPrivilegeEscalation"], name
            assert may["readOnlyRootFilesystem"] and "memory" in container["resources"]["limits"], name
            if container["image"] == "placerec:cluster":
                assert pod["securityContext"]["runAsUser"] == 10001, name
                assert "/tmp" in [mount["mountPath"] for mount in container["volumeMounts"]], name
    labels = objects("Namespace")["placerec"]["metadata"]["labels"]
    assert labels["pod-security.kubernetes.io/enforce"] == "restricted"


def test_variables_are_settings_of_the_service() -> None:
    replica = compose()["services"]["placerec-1"]["environment"]
    given = settings_in(replica) | settings_in(objects("ConfigMap")["placerec"]["data"])
    given |= settings_in({one["name"]: one for one in container_of("Deployment", "placerec")["env"]})
    assert given <= set(Settings.model_fields)


def test_no_password_stands_in_a_file() -> None:
    for name, found in compose()["services"].items():
        for variable, value in found.get("environment", {}).items():
            if "PASSWORD" in variable or "SECRET" in variable:
                assert re.search(r"\$\{\w+:\?", value), (name, variable)
    for name, found in objects("Secret").items():
        assert {value for value in found["stringData"].values() if "change-me" not in value} <= {""}, name


def test_both_say_the_same_of_the_service_and_of_milvus() -> None:
    replica, told = compose()["services"]["placerec-1"], objects("ConfigMap")["placerec"]["data"]
    given = replica["environment"]
    assert given["PLACEREC_MILVUS"] == told["PLACEREC_MILVUS"]
    own = yaml.safe_load((DOCKER / "milvus.yaml").read_text())
    assert own == yaml.safe_load(objects("ConfigMap")["milvus"]["data"]["user.yaml"])
    assert compose()["services"]["milvus"]["image"] == container_of("StatefulSet", "milvus")["image"]


def test_stores_are_of_versions_that_are_mended() -> None:
    for image in (compose()["services"]["milvus"]["image"], container_of("StatefulSet", "milvus")["image"]):
        name, _, version = image.partition(":v")
        assert name == "milvusdb/milvus" and tuple(map(int, version.split("."))) >= (2, 6, 14)


def test_milvus_keeps_its_segments_on_its_own_volume() -> None:
    given, container = compose()["services"]["milvus"], container_of("StatefulSet", "milvus")
    assert given["environment"] == {one["name"]: one["value"] for one in container["env"]}
    assert given["environment"]["COMMON_STORAGETYPE"] == "local"
    assert "milvus:/var/lib/milvus" in given["volumes"]
    assert "/var/lib/milvus" in [mount["mountPath"] for mount in container["volumeMounts"]]


def container_of(kind: str, name: str) -> dict[str, Any]:
    assert name in objects(kind)
    (found,) = pods()[name]["spec"]["containers"]
    container: dict[str, Any] = found
    return container


def test_a_replica_has_time_to_stop() -> None:
    default = {name: field.default for name, field in Settings.model_fields.items()}
    told = objects("ConfigMap")["placerec"]["data"]
    needed = float(told["PLACEREC_DRAIN_SECONDS"]) + 2 * default["shutdown_timeout"] + 5
    assert objects("Deployment")["placerec"]["spec"]["template"]["spec"]["terminationGracePeriodSeconds"] >= needed
    replica = compose()["services"]["placerec-1"]
    needed = float(replica["environment"]["PLACEREC_DRAIN_SECONDS"]) + 2 * default["shutdown_timeout"]
    assert seconds(replica["stop_grace_period"]) >= needed


def test_probes_ask_what_the_service_answers() -> None:
    paths = json.loads((ROOT / "openapi.json").read_text())["paths"]
    container = container_of("Deployment", "placerec")
    asked = {name: container[f"{name}Probe"]["httpGet"]["path"] for name in ("startup", "liveness", "readiness")}
    assert asked == {"startup": "/livez", "liveness": "/livez", "readiness": "/readyz"} and set(asked.values()) <= {
        *paths
    }


def test_what_names_a_deployment_finds_it() -> None:
    deployments = objects("Deployment")
    for found in objects("HorizontalPodAutoscaler").values():
        assert found["spec"]["scaleTargetRef"]["name"] in deployments
    for found in objects("PodDisruptionBudget").values():
        labels = found["spec"]["selector"]["matchLabels"]
        assert labels in [one["spec"]["template"]["metadata"]["labels"] for one in deployments.values()]
    for name, found in objects("Service").items():
        assert found["spec"]["selector"] == {"app": name} and name in pods()
    named = {
        (key["name"], key["key"])
        for template in pods().values()
        for variable in template["spec"]["containers"][0].get("env", [])
        if (key := variable.get("valueFrom", {}).get("secretKeyRef"))
    }
    in_files = {(name, key) for name, found in objects("Secret").items() for key in found["stringData"]}
    assert named == in_files


def test_what_is_not_allowed_in_the_network_is_refused() -> None:
    policies = {name: found["spec"] for name, found in objects("NetworkPolicy").items()}
    everyone = policies["all"]
    assert everyone["podSelector"] == {} and set(everyone["policyTypes"]) == {"Ingress", "Egress"}
    assert "ingress" not in everyone and all(rule["to"] for rule in everyone["egress"])
    apps = {template["metadata"]["labels"]["app"] for template in pods().values()}
    ((sender,),) = (rule["from"] for rule in policies["stores"]["ingress"])
    assert apps_of(policies["stores"]["podSelector"]) | apps_of(sender["podSelector"]) <= apps
    assert apps_of(policies["stores"]["podSelector"]) == set(objects("StatefulSet"))
    (robots,) = policies["placerec"]["ingress"]
    assert [port["port"] for port in robots["ports"]] == ["http"] and "podSelector" not in robots["from"][0]


def apps_of(selector: dict[str, Any]) -> set[str]:
    (expression,) = selector["matchExpressions"]
    assert (expression["key"], expression["operator"]) == ("app", "In")
    return set(expression["values"])


def test_alerts_count_by_series_of_the_service() -> None:
    """The reference has every series, which a test of its own compares with /metrics."""
    described = set(re.findall(r"`(placerec_\w+)`", (ROOT / "docs/reference/metrics-and-logs.md").read_text()))
    paths = set(json.loads((ROOT / "openapi.json").read_text())["paths"])
    (group,) = yaml.safe_load((DOCKER / "alerts.yaml").read_text())["groups"]
    assert len(group["rules"]) == 5
    for rule in group["rules"]:
        assert set(rule) == {"alert", "expr", "for", "labels", "annotations"}
        expression = rule["expr"]
        assert expression.count("(") == expression.count(")")
        bare = re.sub(r"\{[^}]*\}", "", expression)
        series = {name.removesuffix("_count") for name in re.findall(r"\bplacerec_\w+", bare)}
        assert series and series <= described
        assert set(re.findall(r'route!?="([^"]*)"', expression)) <= paths
        chosen = {label for inside in re.findall(r"placerec\w+\{([^}]*)\}", expression) for label in labels_in(inside)}
        assert chosen <= {"route", "method", "status"}


def labels_in(selector: str) -> list[str]:
    return re.findall(r"(\w+)(?:=~|!=|=)", selector)


def script_of(name: str) -> list[str]:
    """The command of a pod as a plain process, whose programs are those of this machine."""
    (container,) = pods()[name]["spec"]["containers"]
    words = [*container["command"], *container.get("args", [])]
    return [str(Path(sys.executable).parent / "placerec"), *words[1:]] if words[0] == "placerec" else words


def run_as(name: str, **variables: str) -> str:
    return subprocess.run(
        script_of(name), env={**os.environ, **variables}, check=True, stdout=subprocess.PIPE, text=True, timeout=300
    ).stdout


@pytest.mark.thorough
@pytest.mark.postgres
@pytest.mark.skipif(shutil.which("pg_dump") is None, reason="PostgreSQL's programs are not installed")
def test_jobs_make_a_key_back_it_up_and_restore_it(postgres: Postgres, tmp_path: Path) -> None:
    postgres.empty()
    given = {"PLACEREC_DATABASE": postgres.address, "FOLDER": str(tmp_path), "DUMP": ""}
    key = run_as("first-key", PLACEREC_DATA_DIR=str(tmp_path / "own"), **given).strip()
    assert re.fullmatch(r"\S{30,}", key), "it prints more than a key"

    (tmp_path / "placerec-20200101T000000Z.dump").touch()
    (tmp_path / "placerec-20200101T000000Z.dump.part").touch()
    os.utime(tmp_path / "placerec-20200101T000000Z.dump", (0, 0))
    run_as("backup", **given)
    (dump,) = tmp_path.glob("placerec-*")
    assert re.fullmatch(r"placerec-\d{8}T\d{6}Z\.dump", dump.name)

    tables = "SELECT table_name FROM information_schema.tables WHERE table_schema = 'public'"
    with psycopg.connect(postgres.address) as connection:
        before = set(connection.execute(tables))
    postgres.empty()
    assert dump.name in run_as("restore", **given)
    with psycopg.connect(postgres.address) as connection:
        assert set(connection.execute(tables)) == before and before


def test_limits_of_nginx_are_those_of_the_tls_proxy() -> None:
    ours, theirs = (
        dict(re.findall(r"^\s*(\w+) ([^;{]+);", re.sub(r"#.*", "", (DOCKER / name).read_text()), re.MULTILINE))
        for name in ("cluster.conf", "tls.conf")
    )
    for name in ("large_client_header_buffers", "client_header_timeout", "client_body_timeout", "send_timeout"):
        assert ours[name] == theirs[name]
    address = compose()["services"]["nginx"]["networks"]["inside"]["ipv4_address"]
    assert compose()["services"]["placerec-1"]["environment"]["FORWARDED_ALLOW_IPS"] == address


def test_the_image_of_a_cluster_has_its_packages() -> None:
    arguments = compose()["services"]["placerec-1"]["build"]["args"]
    locked = (ROOT / f"requirements/{arguments['PROFILE']}.lock").read_text()
    assert {"psycopg-binary", "pymilvus"} <= set(re.findall(r"^([\w-]+)==", locked, re.MULTILINE))
    assert set(service()["build"]["args"]) < set(arguments)


class Replica(BaseHTTPRequestHandler):
    """Answers; or, if it is told to, goes away when it has read a request."""

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.asked.append(self.path)  # type: ignore[attr-defined]
        if self.server.dies:  # type: ignore[attr-defined]
            self.connection.close()
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        """Say nothing."""


@pytest.fixture
def replicas() -> Iterator[list[ThreadingHTTPServer]]:
    servers = [ThreadingHTTPServer(("127.0.0.1", 0), Replica) for _ in range(2)]
    for server in servers:
        server.asked, server.dies = [], False  # type: ignore[attr-defined]
        threading.Thread(target=server.serve_forever, daemon=True).start()
    yield servers
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.fixture
def robot(replicas: list[ThreadingHTTPServer], tmp_path: Path) -> Iterator[httpx.Client]:
    """Asks an nginx in front of both."""
    ports = [replica.server_port for replica in replicas]
    with balanced(ports, tmp_path) as url, httpx.Client(base_url=url, timeout=60) as client:
        yield client


@pytest.mark.skipif(shutil.which("nginx") is None, reason="nginx is not installed")
def test_a_query_outlives_a_replica_and_a_write_is_not_sent_twice(
    robot: httpx.Client, replicas: list[ThreadingHTTPServer]
) -> None:
    frame = bytes(range(256)) * 4000
    for _ in range(4):
        assert robot.post("/v1/maps/lab/query", content=frame).content == frame
    assert all(server.asked for server in replicas), "one of two replicas is never asked"  # type: ignore[attr-defined]

    one, other = replicas
    for server in replicas:
        server.asked.clear()  # type: ignore[attr-defined]
    one.dies = True  # type: ignore[attr-defined]
    answers = [robot.post("/v1/maps/lab/query?k=3", content=frame) for _ in range(4)]
    assert [answer.content for answer in answers] == [frame] * 4
    assert one.asked and len(other.asked) == 4  # type: ignore[attr-defined]

    other.dies = True  # type: ignore[attr-defined]
    for server in replicas:
        server.asked.clear()  # type: ignore[attr-defined]
    time.sleep(5.1)  # until nginx tries again the one that failed
    refused = robot.post("/v1/maps/lab/merge", content=frame)
    assert refused.status_code == 502
    assert len(one.asked + other.asked) == 1  # type: ignore[attr-defined]


@pytest.mark.skipif(shutil.which("nginx") is None, reason="nginx is not installed")
def test_robots_of_a_map_come_to_the_same_replica(replicas: list[ThreadingHTTPServer], tmp_path: Path) -> None:
    """By the lines that the guide puts into the configuration."""
    chosen, of_map = re.findall(r"^```nginx\n(.*?)^```$", GUIDE.read_text(), re.DOTALL | re.MULTILINE)
    one, other = (f"127.0.0.1:{replica.server_port}" for replica in replicas)
    port = free_port()
    changes = {
        "upstream placerec {": f"{of_map}upstream placerec {{",
        "least_conn; # queries differ in what they cost": chosen,
        "placerec-1:8000": one,
        "placerec-2:8000": other,
        "listen 8000": f"listen 127.0.0.1:{port}",
    }
    names = [f"hall-{number}" for number in range(20)]
    with (
        nginx_with("cluster.conf", changes, tmp_path, port),
        httpx.Client(base_url=f"http://127.0.0.1:{port}") as robot,
    ):
        for name in names:
            for path in ("query?k=3", "query:batch", "sessions", "places"):
                assert robot.post(f"/v1/maps/{name}/{path}", content=b"frame").status_code == 200
        asked = [{path.split("/")[3] for path in replica.asked} for replica in replicas]  # type: ignore[attr-defined]
        assert all(asked) and asked[0].isdisjoint(asked[1]) and asked[0] | asked[1] == set(names)
        for replica in replicas:
            replica.asked.clear()  # type: ignore[attr-defined]
        for _ in range(20):
            robot.post("/v1/query", content=b"frames")
        assert all(replica.asked for replica in replicas)  # type: ignore[attr-defined]
