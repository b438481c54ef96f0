"""The image and its compose files, checked without a container engine."""

from __future__ import annotations

import ipaddress
import json
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
import yaml

from core.silence import SWITCHES
from service.settings import Settings, SettingsError

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"


def instructions() -> list[tuple[str, str]]:
    """The Dockerfile's instructions and their arguments, continued lines joined."""
    text = re.sub(r"^#.*\n", "", (DOCKER / "Dockerfile").read_text(), flags=re.MULTILINE)
    lines = re.sub(r"\\\n\s*", "", text).splitlines()
    return [(name, argument) for name, _, argument in (line.partition(" ") for line in lines if line)]


def stage(name: str) -> list[tuple[str, str]]:
    """The instructions of a stage and of those that it is made from; "" is the last one, which is built by default."""
    starts = [index for index, (instruction, _) in enumerate(instructions()) if instruction == "FROM"]
    stages: dict[str, list[tuple[str, str]]] = {}
    for start, end in zip(starts, [*starts[1:], None], strict=True):
        base, _, called = instructions()[start][1].partition(" AS ")
        stages[called] = [*stages.get(base, []), *instructions()[start:end]]
    return stages[name]


def final_stage() -> dict[str, str]:
    """The default image's instructions; the last of each name counts."""
    return dict(stage(""))


def service() -> dict[str, Any]:
    compose: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yaml").read_text())
    placerec: dict[str, Any] = compose["services"]["placerec"]
    return placerec


def environment() -> dict[str, str]:
    return dict(pair.split("=", 1) for pair in final_stage()["ENV"].split())


def test_image_runs_as_a_user_of_its_own() -> None:
    stage = final_stage()
    assert stage["USER"] == "10001:10001", "a name does not say that it is not root"
    assert re.search(r"useradd --uid 10001 --user-group .*placerec", stage["RUN"])
    assert stage["VOLUME"] == "/data"
    assert re.search(r"install .*--owner placerec .*/data", stage["RUN"])


def test_what_would_report_is_switched_off() -> None:
    assert environment().items() >= SWITCHES.items()


def test_nothing_but_the_cpu_build_of_torch_is_chosen_unless_given() -> None:
    arguments = [argument for name, argument in instructions() if name == "ARG"]
    assert {"PIP_INDEX_URL=", "PIP_EXTRA_INDEX_URL=", "TORCH_BACKEND=cpu"} <= set(arguments)
    passed = {name: f"${{{name}:-{'cpu' if name == 'TORCH_BACKEND' else ''}}}" for name in service()["build"]["args"]}
    assert service()["build"]["args"] == passed


def test_variables_are_settings_of_the_service() -> None:
    given = {**environment(), **service()["environment"]}
    settings = {name.removeprefix("PLACEREC_").lower() for name in given if name.startswith("PLACEREC_")}
    assert settings and settings <= set(Settings.model_fields)
    assert all(given[name].startswith("/data/") for name in ("PLACEREC_DATA_DIR", "PLACEREC_MODELS_DIR"))


def test_what_is_copied_is_there_and_not_left_out() -> None:
    left_out, *let_in = [
        line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and not line.startswith("#")
    ]
    assert left_out == "*"
    for name, argument in instructions():
        if name == "COPY" and not argument.startswith("--from"):
            for source in argument.split()[:-1]:
                let = any(f"{source}/".startswith(f"{line.removeprefix('!')}/") for line in let_in)
                assert (ROOT / source).exists() and let, source


def test_what_earlier_builds_left_is_left_out() -> None:
    """The last line that fits a path decides, so that these come after what is let in."""
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    let_in = max(index for index, line in enumerate(lines) if line.startswith("!"))
    assert {"**/build", "**/dist", "**/*.egg-info", "**/__pycache__"} <= set(lines[let_in:])
    wanted = {path.name for source in ("core", "service") for path in (ROOT / source).rglob("*") if path.is_dir()}
    assert not wanted & {"build", "dist"}, "the image lacks it"


def test_every_container_has_an_init_process_and_ours_their_user() -> None:
    for path in DOCKER.glob("compose*.yaml"):
        for name, found in yaml.safe_load(path.read_text())["services"].items():
            if "image" in found:
                assert found["init"] is True, (path.name, name)
                assert found.get("user") == (final_stage()["USER"] if "build" in found else None), (path.name, name)


def test_service_is_published_on_this_machine_only() -> None:
    placerec = service()
    assert placerec["ports"] and all(port.startswith("127.0.0.1:") for port in placerec["ports"])
    assert placerec["ports"][0].endswith(":" + environment()["PLACEREC_PORT"])


def test_service_is_confined() -> None:
    placerec = service()
    assert placerec["read_only"] is True
    assert placerec["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in placerec["security_opt"]
    assert "mem_limit" in placerec and "restart" in placerec
    written = [volume.split(":")[1] for volume in placerec["volumes"]]
    assert written == [final_stage()["VOLUME"]]
    assert any(place.startswith("/tmp:") for place in placerec["tmpfs"]), "compiled loops are copied there"


def compose_tls() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((DOCKER / "compose.tls.yaml").read_text())
    return found


def seconds(text: str) -> float:
    return float(text.removesuffix("s"))


def test_other_machines_need_a_key() -> None:
    assert service()["environment"]["PLACEREC_ALLOW_ANONYMOUS"] == "true"
    open_to_others = compose_tls()["services"]["placerec"]["environment"]
    assert open_to_others["PLACEREC_ALLOW_ANONYMOUS"] == "false"
    with pytest.raises(SettingsError, match="no keys"):
        Settings(host="0.0.0.0", allow_anonymous=False).check_exposure(has_keys=False)


def test_only_the_proxy_may_say_where_a_request_comes_from() -> None:
    services = compose_tls()["services"]
    address = services["tls"]["networks"]["front"]["ipv4_address"]
    (network,) = compose_tls()["networks"]["front"]["ipam"]["config"]
    assert ipaddress.ip_address(address) in ipaddress.ip_network(network["subnet"])
    assert ipaddress.ip_address(address) not in ipaddress.ip_network(network["ip_range"]), "it may be given to another"
    assert services["placerec"]["environment"]["FORWARDED_ALLOW_IPS"] == address
    assert "proxy_set_header X-Forwarded-For $remote_addr;" in (DOCKER / "tls.conf").read_text()


def test_the_proxy_is_confined() -> None:
    tls = compose_tls()["services"]["tls"]
    assert tls["read_only"] is True and tls["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in tls["security_opt"] and "mem_limit" in tls


def test_the_grace_period_suffices_to_stop() -> None:
    given = {name.removeprefix("PLACEREC_").lower(): value for name, value in service()["environment"].items()}
    needed = sum(
        float(given.get(name, Settings.model_fields[name].default)) for name in ("drain_seconds", "shutdown_timeout")
    )
    assert seconds(service()["stop_grace_period"]) >= needed + 5


def test_limits_of_the_proxy_are_those_of_the_service() -> None:
    text = re.sub(r"#.*", "", (DOCKER / "tls.conf").read_text())
    limits = dict(re.findall(r"^\s*(\w+) ([^;]+);", text, re.MULTILINE))
    default = {name: field.default for name, field in Settings.model_fields.items()}
    assert limits["client_max_body_size"] == "0"
    assert int(limits["large_client_header_buffers"].split()[1].removesuffix("k")) * 1024 > default["max_url_bytes"]
    for ours, theirs in (
        ("client_header_timeout", "head_timeout"),
        ("client_body_timeout", "read_timeout"),
        ("send_timeout", "write_timeout"),
    ):
        assert seconds(limits[ours]) == default[theirs]
    assert seconds(limits["proxy_read_timeout"]) > default["request_timeout"]
    upstream = text[text.index("upstream") : text.index("}")]
    assert seconds(re.findall(r"keepalive_timeout (\w+);", upstream)[0]) < default["keep_alive_timeout"]


def test_the_image_has_nothing_that_changes_its_user_or_installs() -> None:
    run = final_stage()["RUN"]
    assert "find / -xdev -type f -perm /6000 -exec chmod a-s {} +" in run
    assert all(path in run for path in ("ensurepip", "/usr/local/bin/pip*", "site-packages/pip*"))
    assert any("pip uninstall --yes pip" in argument for _, argument in instructions())
    assert "--shell /usr/sbin/nologin" in run


@pytest.fixture
def answering() -> Iterator[HTTPServer]:
    class Handler(BaseHTTPRequestHandler):
        status = 200

        def do_GET(self) -> None:
            self.send_response(type(self).status if self.path == "/readyz" else 404)
            self.end_headers()

        def log_message(self, format: str, *arguments: object) -> None:
            """Say nothing."""

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.mark.thorough
@pytest.mark.parametrize(("status", "healthy"), [(200, True), (503, False)])
def test_health_check_tells_ready_from_not(answering: HTTPServer, status: int, healthy: bool) -> None:
    answering.RequestHandlerClass.status = status  # type: ignore[attr-defined]
    command = json.loads(final_stage()["HEALTHCHECK"].split("CMD ", 1)[1])
    assert command[0] == "python"
    variables = {"PLACEREC_PORT": str(answering.server_port)}
    assert (subprocess.run([sys.executable, *command[1:]], env=variables).returncode == 0) is healthy
