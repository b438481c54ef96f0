"""Keys, the audit trail, jobs and the service's state in the console; keys that are needed, wrong or gone."""

from __future__ import annotations

import csv
import json
import re
from contextlib import suppress
from pathlib import Path

import pytest
from playwright.sync_api import APIResponse, Route, expect
from playwright.sync_api import TimeoutError as PlaywrightTimeoutError

from service.access.keys import Keys
from tests.service.console.conftest import Operator, Visit
from tests.service.console.world import LAB, frame
from tests.service.map_jobs import wait_until
from tests.service.server import Server
from tests.service.wire import eventually


@pytest.mark.thorough
def test_a_key_is_created_shown_once_narrowed_and_revoked(admin: Operator, keyed: Server) -> None:
    page = admin.go("keys")
    page.get_by_role("button", name="Create a key").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Name").fill("fleet-7")
    learns = dialog.get_by_label("Maps that learn may learn from its runs")
    expect(learns).to_have_count(0)  # an option of one role only
    dialog.get_by_label("Role").select_option("enrol")
    learns.check()
    dialog.get_by_role("button", name="Create").click()
    shown = page.get_by_label("The key", exact=True)
    expect(shown).to_have_text(re.compile(r"^placerec_[0-9a-f]{12}_[A-Za-z0-9_-]{43}$"))
    secret = shown.inner_text()
    page.get_by_role("button", name="Done").click()
    expect(page.get_by_role("button", name="Create a key")).to_be_focused()
    row = page.get_by_role("row").filter(has_text="fleet-7")
    row.wait_for()
    assert secret not in page.content()

    def may_list(method: str, path: str) -> int:
        return keyed.client.request(method, path, headers={"Authorization": f"Bearer {secret}"}).status_code

    def teaches() -> bool:
        items = keyed.client.get("/v1/keys", params={"limit": 500}).json()["items"]
        return next(bool(one["learn"]) for one in items if one["name"] == "fleet-7" and one["state"] == "in force")

    assert may_list("GET", "/v1/maps") == 200 and may_list("DELETE", "/v1/maps/none/places/p") == 404
    assert teaches()
    expect(row).to_contain_text("teaches")
    row.get_by_role("button", name="Narrow fleet-7").click()
    learns.uncheck()
    dialog.get_by_role("button", name="Narrow").click()
    dialog.wait_for(state="detached")
    assert not teaches()
    row.get_by_role("button", name="Narrow fleet-7").click()
    dialog.get_by_label("Role").select_option("query")
    dialog.get_by_label("only these").check()
    dialog.get_by_label(LAB, exact=True).check()
    dialog.get_by_role("button", name="Narrow").click()
    dialog.wait_for(state="detached")
    assert may_list("GET", f"/v1/maps/{LAB}") == 200 and may_list("GET", "/v1/maps/none") == 403
    row.get_by_role("button", name="Delete fleet-7").click()
    dialog.get_by_role("textbox").fill("fleet-7")
    dialog.get_by_role("button", name="Delete the key").click()
    row.wait_for(state="detached")
    assert may_list("GET", "/v1/maps") == 401
    page.get_by_label("also ended ones").check()
    row.get_by_text("revoked").wait_for()


def test_nobody_locks_all_admins_out_by_accident(admin: Operator) -> None:
    page = admin.go("keys")
    page.get_by_role("button", name="Delete admin-key").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_text("It is the key that you use now.").wait_for()
    dialog.get_by_role("textbox").fill("admin-key")
    admin.foresee("409")
    dialog.get_by_role("button", name="Delete the key").click()
    dialog.get_by_role("alert").wait_for()
    dialog.get_by_label("Do it although", exact=False).wait_for()
    page.keyboard.press("Escape")
    page.get_by_role("row").filter(has_text="admin-key").get_by_text("in force").wait_for()


@pytest.mark.thorough
def test_the_first_key_is_used_at_once(visit: Visit, tmp_path_factory: pytest.TempPathFactory) -> None:
    server = Server(tmp_path_factory.mktemp("open")).wait("/livez")
    try:
        operator = visit(None, server=server)
        page = operator.go("keys")
        page.get_by_role("button", name="Create a key").click()
        page.get_by_role("dialog").get_by_label("Name").fill("ann")
        page.get_by_role("dialog").get_by_role("button", name="Create").click()
        page.locator(".identity").get_by_text("ann").wait_for()  # at once: without it the page would be refused
        assert page.get_by_label("The key", exact=True).inner_text().startswith("placerec_")
        page.get_by_role("button", name="Done").click()
        expect(page.get_by_role("button", name="Create a key")).to_be_focused()
        page.get_by_role("row").filter(has_text="yours").wait_for()
        assert server.client.get("/v1/maps").status_code == 401
        page.evaluate("sessionStorage.clear()")
        operator.foresee("401")
        page.reload()
        page.get_by_text("The service asks for a key.").wait_for()
    finally:
        assert server.stop() == 0


def test_the_first_key_is_not_lost_with_the_page_that_made_it(
    visit: Visit, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A request without a key is refused between the creation of the first one and the arrival of the answer."""
    server = Server(tmp_path_factory.mktemp("open")).wait("/livez")
    held: list[tuple[Route, APIResponse]] = []
    try:
        operator = visit(None, server=server)
        operator.foresee("401")
        page = operator.go("keys")
        page.route("**/v1/keys", lambda route: held.append((route, route.fetch())))
        page.get_by_role("button", name="Create a key").click()
        page.get_by_role("dialog").get_by_label("Name").fill("ann")
        page.get_by_role("dialog").get_by_role("button", name="Create").click()
        while not held:
            page.wait_for_timeout(20)
        page.goto(f"{operator.root}/console#/jobs")
        page.get_by_text("The service asks for a key.").wait_for()
        for route, answer in held:
            route.fulfill(response=answer)
        secret = page.get_by_role("dialog").get_by_label("The key", exact=True).inner_text()
        page.get_by_role("dialog").get_by_role("button", name="Done").click()
        page.locator(".identity").get_by_text("ann").wait_for()
        assert server.client.get("/v1/maps", headers={"Authorization": f"Bearer {secret}"}).status_code == 200
    finally:
        assert server.stop() == 0


def test_a_key_is_requested_and_a_wrong_one_refused(visit: Visit, keyed: Server, keys: dict[str, str]) -> None:
    operator = visit(None)
    operator.foresee("401")
    page = operator.page
    page.goto(f"{operator.root}/console#/maps")
    for wrong in ("placerec_000000000000_" + "x" * 43, "placerec_cut", "robot-7", "ключ"):  # unknown, or no key at all
        page.get_by_label("Key").fill(wrong)
        page.get_by_role("button", name="Use the key").click()
        page.get_by_role("alert").get_by_text("This key is not known").first.wait_for()
        page.get_by_label("Key").fill("")
    page.get_by_label("Key").fill(keys["query"])
    page.get_by_role("button", name="Use the key").click()
    page.get_by_role("link", name=LAB, exact=True).wait_for()
    assert keys["query"] not in page.url
    page.get_by_role("button", name="Change key").click()
    page.get_by_role("button", name="Forget the key").click()
    page.get_by_text("The service asks for a key.").wait_for()


def test_a_mistyped_key_leaves_the_present_one(admin: Operator) -> None:
    admin.foresee("401")
    page = admin.go("maps")
    page.get_by_role("button", name="Change key").click()
    dialog = page.get_by_role("dialog")
    wrong = "placerec_000000000000_" + "x" * 43
    dialog.get_by_label("Key").fill(wrong)
    dialog.get_by_role("button", name="Use the key").click()
    dialog.get_by_role("alert").get_by_text("This key is not known").wait_for()
    expect(dialog.get_by_label("Key")).to_have_value(wrong)
    page.keyboard.press("Escape")
    expect(page.locator(".identity")).to_contain_text("admin-key")
    page.get_by_role("link", name="Jobs").click()
    page.get_by_role("heading", name="Jobs").wait_for()


@pytest.mark.thorough
def test_a_second_tab_has_the_key_until_it_is_forgotten(visit: Visit, keyed: Server, keys: dict[str, str]) -> None:
    operator = visit(None)
    operator.foresee("401")
    page = operator.page
    page.goto(f"{operator.root}/console#/maps")
    page.get_by_label("Key").fill(keys["query"])
    page.get_by_role("button", name="Use the key").click()
    page.get_by_role("link", name=LAB, exact=True).wait_for()
    stored = "JSON.stringify([Object.entries(localStorage), document.cookie])"
    assert keys["query"] not in page.evaluate(stored)
    second = page.context.new_page()
    try:
        second.goto(f"{operator.root}/console#/maps")
        second.get_by_role("link", name=LAB, exact=True).wait_for()
        second.get_by_role("button", name="Change key").click()
        second.get_by_role("button", name="Forget the key").click()
        for tab in (second, page):
            tab.get_by_text("The service asks for a key.").wait_for()
        second.reload()
        second.get_by_text("The service asks for a key.").wait_for()
    finally:
        second.close()


def test_to_open_the_console_without_a_key_is_no_refusal(visit: Visit, keyed: Server, folder: Path) -> None:
    def refusals() -> int:
        return (folder / "audit.jsonl").read_text().count('"refused"')

    before = refusals()
    operator = visit(None)
    operator.foresee("401")
    operator.page.goto(f"{operator.root}/console#/maps/{LAB}/plan")
    operator.page.get_by_text("The service asks for a key.").wait_for()
    refused = keyed.client.get("/v1/maps", headers={"Authorization": ""})  # which is one, and comes later
    assert refused.status_code == 401
    assert eventually(lambda: refusals() > before)
    assert refusals() == before + 1


@pytest.mark.thorough
def test_a_new_key_is_whole_stays_and_is_copied_over_plain_http(visit: Visit, keyed: Server) -> None:
    operator = visit("admin", size="phone")
    operator.root = f"http://console.test:{keyed.port}"  # where a browser gives pages no clipboard
    operator.foresee("Cross-Origin-Opener-Policy header has been ignored")
    page = operator.go("keys")
    assert page.evaluate("navigator.clipboard") is None
    page.get_by_role("button", name="Create a key").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Name").fill("whole")
    dialog.get_by_role("button", name="Create").click()
    shown = page.get_by_label("The key", exact=True)
    secret = shown.inner_text()
    assert shown.evaluate("one => one.scrollWidth <= one.clientWidth")
    for _ in range(3):
        page.keyboard.press("Escape")
    expect(shown).to_have_text(secret)
    dialog.get_by_role("button", name="Copy the key").click()
    dialog.get_by_role("button", name="Copied").wait_for()
    dialog.get_by_role("button", name="Done").click()
    page.get_by_role("button", name="Create a key").click()
    dialog.get_by_label("Name").press("Control+V")
    expect(dialog.get_by_label("Name")).to_have_value(secret[:64])
    page.keyboard.press("Escape")
    keyed.client.delete(f"/v1/keys/{secret.split('_')[1]}").raise_for_status()


def test_what_can_be_no_key_is_not_sent(visit: Visit, keyed: Server, keys: dict[str, str]) -> None:
    operator = visit(None)
    operator.foresee("401")
    page = operator.page
    page.goto(f"{operator.root}/console#/maps")
    page.get_by_label("Key").fill("placerec_c69fcf6b7439_\u2026")  # a browser throws at such a header
    page.get_by_role("button", name="Use the key").click()
    page.get_by_role("alert").get_by_text("This key is not known").wait_for()
    page.get_by_label("Key").fill(keys["query"])
    page.get_by_role("button", name="Use the key").click()
    page.get_by_role("link", name=LAB, exact=True).wait_for()


def test_a_key_can_be_typed_again_after_the_service_refused_to_look_at_it(
    visit: Visit, keyed: Server, keys: dict[str, str]
) -> None:
    operator = visit(None)
    operator.foresee("401", "429")
    page = operator.page
    page.goto(f"{operator.root}/console#/maps")
    page.get_by_label("Key").fill(keys["query"])
    page.route("**/v1/key", lambda route: route.fulfill(status=429, json={"title": "Too many wrong keys"}))
    page.get_by_role("button", name="Use the key").click()
    page.get_by_role("alert").get_by_text("Too many wrong keys").first.wait_for()
    page.unroute("**/v1/key")
    page.get_by_label("Key").fill(keys["query"])
    page.get_by_role("button", name="Use the key").click()
    page.get_by_role("link", name=LAB, exact=True).wait_for()


def test_another_key_is_requested_after_a_revocation(visit: Visit, keyed: Server) -> None:
    key, text = Keys.of(keyed.data_dir).create("soon-gone", "query")
    there = {"Authorization": f"Bearer {text}"}

    def is_known() -> bool:
        return keyed.client.get("/v1/maps", headers=there).status_code == 200

    assert eventually(is_known, every=1), "the service looks now and then; who asks often with a wrong key has to wait"
    operator = visit(None)
    operator.foresee("401")
    page = operator.page
    page.goto(f"{operator.root}/console#/maps")
    page.get_by_label("Key").fill(text)
    page.get_by_role("button", name="Use the key").click()
    page.get_by_role("link", name=LAB, exact=True).wait_for()
    Keys.of(keyed.data_dir).revoke(key.id)
    wait_until(lambda: not is_known())
    page.get_by_role("link", name="Jobs").click()
    page.get_by_role("alert").get_by_text("The key is not valid").wait_for()


def test_a_key_for_other_maps_sees_none(visit: Visit) -> None:
    operator = visit("stranger")
    page = operator.go("maps")
    page.get_by_text("There are no maps").wait_for()
    operator.foresee("403")
    page.goto(f"{operator.root}/console#/maps/{LAB}/places")
    page.get_by_role("alert").first.get_by_text("limited to certain maps", exact=False).wait_for()


def test_who_changed_what_is_listed_and_filtered(admin: Operator, keyed: Server) -> None:
    keyed.create_map("audited")
    keyed.client.patch("/v1/maps/audited", json={"description": "by day"})
    page = admin.go("audit")
    page.get_by_label("Map").last.fill("audited")
    page.get_by_label("Map").last.press("Enter")
    rows = page.get_by_role("region", name="Audit trail").get_by_role("row")
    expect(rows).to_have_count(3)
    for row, operation in ((1, "edit map"), (2, "create map")):
        expect(rows.nth(row)).to_contain_text(re.compile(f"{operation}.*admin-key|admin-key.*{operation}", re.DOTALL))
    rows.nth(1).get_by_role("button").click()
    page.get_by_role("dialog").get_by_text("request id").wait_for()


@pytest.mark.thorough
def test_jobs_are_listed_with_their_results_and_cancelled(admin: Operator, keyed: Server) -> None:
    keyed.create_map("working")
    keyed.enrol("working", "p0", frame(0))
    done = keyed.client.post("/v1/maps/working/verify?background=true").json()["id"]
    assert keyed.client.get(f"/v1/jobs/{done}?wait=30").json()["state"] == "succeeded"
    page = admin.go("jobs")
    row = page.get_by_role("row").filter(has_text=done)
    row.get_by_text("succeeded").wait_for()
    row.get_by_role("button", name="verify").click()
    page.get_by_role("dialog").get_by_text("checked bytes").wait_for()
    page.keyboard.press("Escape")
    waiting = [keyed.client.post(f"/v1/maps/{LAB}/verify?background=true").json()["id"] for _ in range(6)]
    row = page.get_by_role("row").filter(has_text=waiting[-1])
    row.wait_for()
    admin.foresee("409")
    with suppress(PlaywrightTimeoutError):  # it may have run already
        row.get_by_role("button", name="Cancel").click(timeout=2000)
    for one in waiting:
        state = keyed.client.get(f"/v1/jobs/{one}?wait=30").json()["state"]
        assert state in ("succeeded", "cancelled")


@pytest.mark.thorough
def test_the_state_of_the_service_is_shown(admin: Operator, visit: Visit) -> None:
    page = admin.go("service")
    page.get_by_text("ready", exact=True).wait_for()
    page.get_by_text("Encoder's queue").wait_for()
    page.get_by_text("Memory of the process").wait_for()
    page.get_by_role("button", name="Limits").click()
    page.get_by_text("max image bytes").wait_for()
    page.get_by_role("button", name="Settings").click()
    page.get_by_text("data dir").wait_for()
    other = visit("query").go("service")
    other.get_by_text("Encoder's queue").wait_for()
    expect(other.get_by_text("Memory of the process")).to_have_count(0)
    expect(other.get_by_role("button", name="Settings")).to_have_count(0)


def test_no_key_and_no_secret_is_in_the_logs(
    admin: Operator, keyed: Server, keys: dict[str, str], folder: Path
) -> None:
    admin.go(f"maps/{LAB}/places")
    written = keyed.log_file.read_text() + (folder / "audit.jsonl").read_text()
    assert not [role for role, key in keys.items() if key in written]
    whole = keyed.log_file.read_text().rpartition("\n")[0].splitlines()  # a line may be on its way
    paths = {json.loads(line).get("path", "") for line in whole if line.startswith("{")}
    assert not [path for path in paths if "placerec_" in path]


def test_a_key_is_rotated(admin: Operator, keyed: Server) -> None:
    order = {"name": "fleet-9", "role": "query", "maps": [LAB]}
    old = keyed.client.post("/v1/keys", json=order).json()

    def status(secret: str) -> int:
        headers = {"Authorization": f"Bearer {secret}"}
        return keyed.client.get(f"/v1/maps/{LAB}", headers=headers).status_code

    page = admin.go("keys")
    page.get_by_role("button", name="Rotate fleet-9", exact=True).click()
    page.get_by_role("dialog").get_by_label("The old one ends").select_option("in an hour")
    page.get_by_role("button", name="Make the new key").click()
    secret = page.get_by_label("The key", exact=True).inner_text()
    assert secret != old["key"] and status(secret) == status(old["key"]) == 200
    page.get_by_role("button", name="Done").click()
    keys = {one["id"]: one for one in keyed.client.get("/v1/keys", params={"limit": 1000}).json()["items"]}
    (new,) = (one for one in keys.values() if one["name"] == "fleet-9" and one["id"] != old["id"])
    assert (new["role"], new["maps"], new["expires_at"]) == ("query", [LAB], None)
    assert keys[old["id"]]["expires_at"] is not None
    row = page.get_by_role("row").filter(has_text=new["id"])
    row.get_by_role("button", name="Rotate fleet-9").click()
    page.get_by_role("dialog").get_by_label("The old one ends").select_option("at once")
    page.get_by_role("button", name="Make the new key").click()
    latest = page.get_by_label("The key", exact=True).inner_text()
    page.get_by_role("button", name="Done").click()
    assert (status(latest), status(secret)) == (200, 401)
    for key in keyed.client.get("/v1/keys", params={"limit": 1000}).json()["items"]:
        if key["name"] == "fleet-9" and key["state"] == "in force":
            keyed.client.delete(f"/v1/keys/{key['id']}")


def test_the_load_is_plotted_over_time_and_saved(admin: Operator, keyed: Server) -> None:
    for _ in range(2):
        keyed.query(LAB, frame(1))
    page = admin.go("service")
    history = page.get_by_role("region", name="Over time")
    told = keyed.client.get("/v1/service/history", params={"hours": 6}).json()
    history.get_by_role(
        "img", name=re.compile(rf"Answers a minute by verdict: {sum(told['recognized'])} rec")
    ).wait_for()
    for name in ("Latency of answers", "Memory; now .* MiB", "Free on the disk; now"):
        plot = history.get_by_role("img", name=re.compile(name))
        assert plot.locator("canvas").evaluate(
            "(one) => one.getContext('2d').getImageData(0, 0, one.width, one.height).data.some(Boolean)"
        )
    history.get_by_role("button", name="7 days").click()
    expect(history.get_by_role("button", name="7 days")).to_have_attribute("aria-pressed", "true")
    admin.settle()
    with page.expect_download() as saved:
        history.get_by_role("button", name="Save as CSV").click()
    rows = list(csv.DictReader(saved.value.path().read_text().splitlines()))
    assert sum(int(row["recognized"]) for row in rows) >= sum(told["recognized"]) > 0


def test_the_audit_trail_and_places_are_saved_as_csv_without_formulas(admin: Operator, keyed: Server) -> None:
    keyed.create_map("sheet")
    assert keyed.enrol("sheet", "p0", frame(0), x=-1, y=2, sequence="=1+1", metadata={"a": 1}).status_code == 201
    page = admin.go("maps/sheet/places")
    with page.expect_download() as saved:
        page.get_by_role("button", name="Save as CSV").click()
    (row,) = csv.DictReader(saved.value.path().read_text().splitlines())
    assert (row["id"], row["sequence"], row["x"], row["metadata"]) == ("p0", "'=1+1", "-1", '{"a":1}')
    page = admin.go("audit?map=sheet")
    with page.expect_download() as saved:
        page.get_by_role("button", name="Save as CSV").click()
    lines = list(csv.DictReader(saved.value.path().read_text().splitlines()))
    assert {line["operation"] for line in lines} >= {"create_map", "enrol_place"}
    assert {line["principal"] for line in lines} == {"admin-key"}
    admin.leave()
    keyed.client.delete("/v1/maps/sheet")
