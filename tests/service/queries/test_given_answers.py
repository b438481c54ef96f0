"""The latest answers of a map: what is kept, how many, and who sees who asked."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from sqlalchemy import func, select, text

from core.errors import StorageFailure
from core.ledger import Statement
from service.access.keys import Keys
from service.queries import recent_answers
from service.queries.given_answers import GivenAnswer, MapKey, QueriedFrame
from service.queries.recent_answers import MOST_OF_MAP, TABLES, RecentAnswers
from service.queries.schemas import QueryAnswer
from tests.core.ledger.conftest import OpenLedger
from tests.service.scenes import blank, encoded, jpeg, stranger
from tests.service.server import Server, assert_problem


@pytest.mark.thorough
def test_the_latest_answers_and_the_mix_of_the_day(server: Server, map_id: str) -> None:
    for number in range(3):
        server.enrol(map_id, f"p{number}", jpeg(number), x=3 * number, y=0, heading=90)
    assert server.client.get(f"/v1/maps/{map_id}").json()["last_day"] == {"recognized": 0, "ambiguous": 0, "unknown": 0}
    answers = [server.query(map_id, data) for data in (jpeg(1), encoded(stranger(40)), encoded(blank()))]
    form = {"a": ("a", jpeg(0), "image/jpeg"), "b": ("b", jpeg(2), "image/jpeg")}
    answers += [
        item["answer"] for item in server.client.post(f"/v1/maps/{map_id}/query:batch", files=form).json()["items"]
    ]
    answers.append(
        server.client.post(
            "/v1/query", params={"maps": map_id}, content=jpeg(1), headers={"Content-Type": "image/jpeg"}
        ).json()["maps"][0]
    )
    found = server.client.get(f"/v1/maps/{map_id}/answers").json()
    assert found["kept"] == 6 and found["next_cursor"] is None
    listed = found["items"][::-1]
    for answer, item in zip(answers, listed, strict=True):
        for name in ("verdict", "probability", "score", "margin", "decision", "threshold", "reason"):
            assert item[name] == answer[name], name
    operations = ["query"] * 3 + ["query_batch"] * 2 + ["query_maps"]
    assert [item["operation"] for item in listed] == operations
    assert listed[0]["matches"] == [
        {"place": match["place"]["id"], "score": match["score"]} for match in answers[0]["matches"]
    ]
    assert listed[0]["place"] == "p1" and listed[0]["pose"] == answers[0]["pose"] and listed[2]["matches"] == []
    assert listed[0]["milliseconds"] == answers[0]["milliseconds"]["total"] and listed[0]["principal"] == "anonymous"
    mix = {verdict: sum(item["verdict"] == verdict for item in listed) for verdict in ("recognized", "ambiguous")}
    mix["unknown"] = 6 - sum(mix.values())
    assert server.client.get(f"/v1/maps/{map_id}").json()["last_day"] == mix
    assert {name: sum(hour[name] for hour in found["hours"]) for name in mix} == mix
    page = server.client.get("/v1/maps", params={"limit": "1000"}).json()["items"]
    assert next(item for item in page if item["id"] == map_id)["last_day"] == mix
    only = server.client.get(f"/v1/maps/{map_id}/answers", params={"verdict": "unknown", "limit": "1"}).json()
    assert [item["verdict"] for item in only["items"]] == ["unknown"] and only["kept"] == 6
    lately = server.client.get(f"/v1/maps/{map_id}/places/p1/matches").json()
    wanted = [item for item in found["items"] if "p1" in [match["place"] for match in item["matches"]]]
    assert [{name: value for name, value in item.items() if name != "rank"} for item in lately["items"]] == wanted
    assert lately["items"][-1]["rank"] == 1 and lately["best"] >= 2 and lately["recognized"] >= 1 and lately["last_at"]


@pytest.mark.thorough
def test_an_answer_knows_camera_and_session(server: Server, map_id: str) -> None:
    for number in range(3):
        server.enrol(map_id, f"p{number}", jpeg(number), x=3 * number, y=0, heading=90)
    maps = f"/v1/maps/{map_id}"
    for name in ("front", "left"):
        mask = {"mask": {"polygons": [[[0, 0.9], [1, 0.9], [1, 1], [0, 1]]]}}
        assert server.client.put(f"{maps}/cameras/{name}", json=mask).is_success
    session = server.client.post(f"{maps}/sessions", json={"camera": "left"}).json()["id"]
    picture = {"Content-Type": "image/jpeg"}
    form = {"a": ("a", jpeg(0), "image/jpeg")}
    for path, parameters in ((f"{maps}/query", {"camera": "front"}), (f"{maps}/query", {})):
        assert server.client.post(path, params=parameters, content=jpeg(1), headers=picture).is_success
    frames = f"{maps}/sessions/{session}/frames"
    assert server.client.post(frames, params={"frame": "7"}, content=jpeg(1), headers=picture).is_success
    assert server.client.post(f"{maps}/query:batch", params={"camera": "left"}, files=form).is_success
    both = {"maps": map_id, "camera": "front"}
    assert server.client.post("/v1/query", params=both, content=jpeg(1), headers=picture).is_success

    def listed(path: str = "answers", **parameters: str) -> list[tuple[str | None, str | None, int | None]]:
        items = server.client.get(f"{maps}/{path}", params=parameters).json()["items"]
        return [(one["camera"], one["session"], one["frame"]) for one in items]

    one, of_session, other = ("front", None, None), ("left", session, 7), ("left", None, None)
    assert listed() == [one, other, of_session, (None, None, None), one]
    assert listed(camera="left") == [other, of_session] and listed(session=session) == [of_session]
    assert listed("places/p1/matches", camera="front") == [one, one]
    assert listed("places/p1/matches", session=session) == [of_session]


def test_what_does_not_fit_is_refused(server: Server, map_id: str) -> None:
    assert_problem(server.client.get("/v1/maps/absent/answers"), 404, "unknown-map")
    assert_problem(server.client.get(f"/v1/maps/{map_id}/places/absent/matches"), 404, "unknown-place")
    for parameters in ({"limit": "0"}, {"limit": "501"}, {"verdict": "perhaps"}, {"cursor": "x"}):
        response = server.client.get(f"/v1/maps/{map_id}/answers", params=parameters)
        assert_problem(response, 422, "invalid-request")


def test_a_new_map_of_the_same_name_has_no_answers(server: Server, map_id: str) -> None:
    server.query(map_id, jpeg(0))
    assert server.client.get(f"/v1/maps/{map_id}/answers").json()["kept"] == 1
    server.client.delete(f"/v1/maps/{map_id}")
    server.create_map(map_id)
    found = server.client.get(f"/v1/maps/{map_id}/answers").json()
    assert found == {"items": [], "next_cursor": None, "kept": 0, "hours": []}


@pytest.mark.thorough
def test_only_admins_see_who_asked(tmp_path: Path) -> None:
    store = Keys.of(tmp_path / "data")
    _, admin = store.create("ops", "admin")
    _, robot = store.create("robot", "query", ["lab"])
    server = Server(tmp_path, key=admin).wait()
    try:
        server.create_map("lab")
        headers = {"Authorization": f"Bearer {robot}"}
        with httpx.Client(base_url=server.client.base_url, headers=headers, timeout=60) as client:
            image = {"Content-Type": "image/jpeg", "X-Request-Id": "of-the-robot"}
            assert client.post("/v1/maps/lab/query", content=jpeg(0), headers=image).status_code == 200
            (seen,) = client.get("/v1/maps/lab/answers").json()["items"]
        (told,) = server.client.get("/v1/maps/lab/answers").json()["items"]
        assert (told["principal"], told["client"], told["request_id"]) == ("robot", "127.0.0.1", "of-the-robot")
        assert seen == told | {"principal": None, "key": None, "client": None}
    finally:
        assert server.stop() == 0


ANSWER = QueryAnswer(
    verdict="unknown",
    place=None,
    probability=None,
    pose=None,
    score=None,
    margin=None,
    decision=None,
    threshold=0.1,
    reason="empty-map",
    matches=[],
    revision=1,
    encoder="e",
    milliseconds={},
)


def test_the_answers_of_all_maps_together_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recent_answers, "MOST_OF_MAP", 10)
    monkeypatch.setattr(recent_answers, "MOST", 25)
    kept = RecentAnswers()
    maps: list[MapKey] = [(f"map-{number}", "then") for number in range(4)]
    for one in (maps[0], maps[1], maps[0]):
        for _ in range(20):
            kept.add(one, GivenAnswer.of(ANSWER, QueriedFrame()))
    assert [len(kept.of_map(one)) for one in maps] == [10, 10, 0, 0]
    for _ in range(6):
        kept.add(maps[2], GivenAnswer.of(ANSWER, QueriedFrame()))
    assert [len(kept.of_map(one)) for one in maps] == [10, 0, 6, 0], "those of the map asked least recently went"
    for _ in range(100):
        kept.add(maps[3], GivenAnswer.of(ANSWER, QueriedFrame()))
    assert [len(kept.of_map(one)) for one in maps] == [0, 0, 6, 10]
    assert kept._count == sum(len(kept.of_map(one)) for one in maps)


def test_services_share_the_latest_answers_which_are_bounded(
    open_ledger: OpenLedger, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = open_ledger(TABLES)
    one, other = RecentAnswers(ledger), RecentAnswers(ledger)
    for number in range(MOST_OF_MAP + 20):
        (one, other)[number % 2].add(("lab", "2026"), GivenAnswer.of(ANSWER, QueriedFrame(number=number)))
    other.add(("hall", "2026"), GivenAnswer.of(ANSWER, QueriedFrame("front", "s-1", 7)))
    other.flush()
    stored = one.of_map(("lab", "2026"))
    assert len(stored) == MOST_OF_MAP and {answer.reason for answer in stored} == {ANSWER.reason}
    assert [answer.frame for answer in one.of_map(("hall", "2026"))] == [QueriedFrame("front", "s-1", 7)]
    assert ledger.execute("count", COUNT) == [(MOST_OF_MAP + 1,)]
    monkeypatch.setattr(recent_answers, "MOST", 40)
    other.add(("hall", "2026"), GivenAnswer.of(ANSWER, QueriedFrame()))
    assert len(other.of_map(("hall", "2026"))) == 1, "the earlier one was among the oldest of all"
    assert ledger.execute("count", COUNT) == [(40,)]


def test_answers_wait_in_memory_while_the_ledger_refuses(open_ledger: OpenLedger) -> None:
    ledger = open_ledger(TABLES)
    waiting = RecentAnswers(ledger)
    ledger.change("remove", REMOVE)
    for number in range(3):
        waiting.add(("lab", "2026"), GivenAnswer.of(ANSWER, QueriedFrame(number=number)))
        with pytest.raises(StorageFailure):
            waiting.flush()
    ledger.change("restore", RESTORE)
    assert [answer.frame.number for answer in waiting.of_map(("lab", "2026"))] == [2, 1, 0]


COUNT = Statement(select(func.count()).select_from(TABLES.metadata.tables["answers"]))
REMOVE = Statement(text("ALTER TABLE answers RENAME TO away"))
RESTORE = Statement(text("ALTER TABLE away RENAME TO answers"))


def test_answers_are_dropped_by_what_they_are_about_and_by_age(open_ledger: OpenLedger) -> None:
    for stored in (RecentAnswers(), RecentAnswers(open_ledger(TABLES))):
        key = ("lab", "2026")
        for number in range(6):
            stored.add(key, GivenAnswer.of(ANSWER, QueriedFrame(session=f"s-{number % 2}", number=number)))
        stored.add(("hall", "2026"), GivenAnswer.of(ANSWER, QueriedFrame(session="s-1")))
        assert stored.forget(key, lambda one: one.frame.session == "s-1") == 3
        left = stored.of_map(key)
        assert [one.frame.number for one in left] == [4, 2, 0] and len(stored.of_map(("hall", "2026"))) == 1
        stored.forget_before(left[0].at)
        assert [one.frame.number for one in stored.of_map(key)] == [4]
        stored.add(key, left[1])
        assert len(stored.of_map(key)) == 2
