"""The service before a PostgreSQL that asks for passwords and certificates: it says what is wrong, nothing secret."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from httpx import Response

from core.errors import StoreUnavailable
from core.ledger.postgres import check_address
from core.store import open_cluster
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem, typed
from tests.service.stores.guarded import Guarded, guarded_postgres
from tests.service.wire import eventually

pytestmark = [
    pytest.mark.postgres,
    pytest.mark.thorough,
    pytest.mark.timeout(600),
    pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed"),
]

READY = '"status":"ready"'
PASSWORD = "its-own-password"


@pytest.fixture(scope="module")
def guarded() -> Iterator[Guarded]:
    with guarded_postgres() as postgres:
        yield postgres


def test_each_refusal_is_said_and_ends_when_it_is_put_right(guarded: Guarded, tmp_path: Path) -> None:
    install_coarse_encoder(tmp_path / "models")
    trusted = tmp_path / "postgres.pem"
    shutil.copy(guarded.stranger, trusted)
    address = f"postgresql://robot:{PASSWORD}@{guarded.postgres_server}?sslmode=verify-full&sslrootcert={trusted}"
    service, shown = Server(tmp_path, {"database": address, "encoder": COARSE}).wait("/livez"), []

    def says(text: str, logged: str = "") -> None:
        """Wait until robots are given one text, and the log has another, which may name addresses and roles."""
        assert eventually(lambda: text in service.client.get("/readyz").text, 300), service.client.get("/readyz").text
        assert eventually(lambda: logged in service.log_file.read_text(), 300), (logged, service.log_file.read_text())
        answer = service.client.get("/readyz")
        assert answer.status_code == (200 if text == READY else 503)
        shown.append(answer.text)

    says("PostgreSQL cannot be trusted.", "PostgreSQL cannot be trusted: connection failed")
    shutil.copy(guarded.authority, trusted)
    says("PostgreSQL refuses the service.", "PostgreSQL refuses the service: ")  # there is no such role
    guarded.execute(f"CREATE ROLE robot LOGIN PASSWORD '{PASSWORD}' VALID UNTIL '2020-01-01'")
    says("PostgreSQL refuses the service.", "password authentication failed")  # it has expired
    guarded.execute("ALTER ROLE robot PASSWORD 'another' VALID UNTIL 'infinity'")
    says("PostgreSQL refuses the service.", "password authentication failed")
    guarded.execute(f"ALTER ROLE robot PASSWORD '{PASSWORD}'")
    says("has no right to", "permission denied for schema public")
    guarded.execute("GRANT CREATE ON SCHEMA public TO robot", "GRANT CREATE ON DATABASE postgres TO robot")
    says(READY)

    service.create_map("lab")
    assert service.enrol("lab", "p1", jpeg(1)).status_code == 201
    assert service.query("lab", jpeg(1))["matches"][0]["place"]["id"] == "p1"
    guarded.execute("REVOKE SELECT ON places FROM robot")
    assert_problem(service.client.get("/v1/maps/lab/places"), 503, "store-unavailable")
    guarded.execute("GRANT SELECT ON places TO robot")

    def asked() -> Response:
        return service.client.post("/v1/maps/lab/query", content=jpeg(1), headers=typed(jpeg(1)))

    assert eventually(lambda: asked().status_code == 200, 300)  # it is asked again in half a second
    assert asked().json()["matches"][0]["place"]["id"] == "p1"

    secure = "SELECT DISTINCT ssl FROM pg_stat_ssl JOIN pg_stat_activity USING (pid) WHERE usename = 'robot'"
    assert guarded.execute(secure) == [(True,)]
    log = service.log_file.read_text()
    for text in (log, service.client.get("/v1/service").text, *shown):
        assert PASSWORD not in text
    assert service.client.delete("/v1/maps/lab").status_code == 204 and service.stop() == 0


def test_without_tls(guarded: Guarded) -> None:
    store = open_cluster(f"postgresql://robot:{PASSWORD}@{guarded.postgres_server}?sslmode=disable")
    with pytest.raises(StoreUnavailable, match=r"PostgreSQL refuses the service.*no encryption"):
        store.check_writable()
    store.close()


@pytest.mark.parametrize("password", ["a secret", "a@secret", "a/secret", "a%zsecret"])
def test_an_address_that_is_cut_at_its_password_does_not_show_it(password: str) -> None:
    with pytest.raises(StoreUnavailable, match="write special characters of a password as") as raised:
        check_address(f"postgresql://placerec:{password}@localhost:5432/placerec")
    assert "secret" not in str(raised.value)
