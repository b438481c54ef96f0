"""A map that learns: frames that nobody recognized are proposed as looks of the places where the whole run puts them.

The runs are those of ``eval/corridor``, a frame a metre, of which some stretches are darkened.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.frames.images import decode
from service.access.keys import Keys
from tests.service.commands.conftest import Placerec, placerec
from tests.service.events.listening import listening
from tests.service.map_jobs import finished
from tests.service.scenes import encoded
from tests.service.server import Server, typed
from tests.service.wire import eventually

CORRIDOR = Path(__file__).parents[4] / "shared" / "datasets" / "eval" / "corridor"
DARK = range(25, 40)
SAME = 3.0

__all__ = ["placerec"]

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(not CORRIDOR.is_dir(), reason="needs the data set eval/corridor"),
]


def frames_of(folder: str) -> list[bytes]:
    """The first sixty frames of a traverse, in their order."""
    found = sorted((CORRIDOR / folder).iterdir(), key=lambda path: int(re.sub(r"\D", "", path.stem)))
    return [path.read_bytes() for path in found[:60]]


def darkened(data: bytes, seed: int) -> bytes:
    """The frame at night, by a noisy camera."""
    picture = decode(data).astype(np.float32) / 255
    noise = np.random.default_rng(seed).normal(0, 0.03, picture.shape)
    shown = np.clip(255 * (0.35 * picture**2.5 + noise), 0, 255).astype(np.uint8)
    return encoded(shown, ".png")


def by_night(number: int, data: bytes) -> bytes:
    """A frame of a run, of which a stretch is dark."""
    return darkened(data, number) if number in DARK else data


def until_known(server: Server, name: str) -> None:
    """Wait until the service, which looks at the file of keys now and then, asks for keys and knows this one."""
    assert eventually(lambda: server.client.get("/v1/key").json().get("name") == name, every=1)


def taught(server: Server, map_id: str, mode: str) -> None:
    """Make a map of the first traverse, which learns in this way."""
    server.create_map(map_id, same_place_radius=SAME, learning={"mode": mode})
    for number, data in enumerate(frames_of("ref")):
        made = server.enrol(map_id, f"p{number}", data, x=number, y=0, heading=0, sequence="day")
        assert made.status_code == 201, made.text


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with the map ``hall``, which learns."""
    server = Server(tmp_path_factory.mktemp("learning"), {}).wait()
    taught(server, "hall", "propose")
    yield server
    assert server.stop() == 0


def drive(
    server: Server, map_id: str, drift: float = 1.0, key: str | None = None, frames: Sequence[bytes] | None = None
) -> list[dict[str, Any]]:
    """A run along the corridor, frame by frame; the answers.  The run is over when this returns.

    Args:
        drift: metres that odometry tells for a metre.
        frames: None: those of the second traverse.
    """
    headers = {} if key is None else {"Authorization": f"Bearer {key}"}
    path = f"/v1/maps/{map_id}/sessions"
    session = server.client.post(path, json={}, headers=headers).json()["id"]
    answers = []
    for number, plain in enumerate(frames or frames_of("query")):
        data = by_night(number, plain)
        odometry = {"odometry_x": str(drift * number), "odometry_y": "0", "odometry_heading": "0"}
        answer = server.client.post(
            f"{path}/{session}/frames", params=odometry, content=data, headers=typed(data) | headers
        )
        assert answer.status_code == 200, answer.text
        answers.append(answer.json())
    assert server.client.delete(f"{path}/{session}", headers=headers).status_code == 204
    return answers


def lessons(server: Server, map_id: str) -> list[dict[str, Any]]:
    """The results of the jobs that learnt for a map, the latest first, as soon as they are all over."""
    jobs = server.client.get("/v1/jobs").json()["items"]
    return [finished(server, job)["result"] for job in jobs if job["kind"] == "learn" and job["map"] == map_id]


def proposals(server: Server, map_id: str) -> list[dict[str, Any]]:
    page = server.client.get(f"/v1/maps/{map_id}/review", params={"limit": 100}).json()
    return [frame for frame in page["items"] if "proposal" in frame["answer"]]


def test_a_robot_with_wrong_odometry_is_told_so_and_teaches_nothing_by_it(running: Server) -> None:
    client, path = running.client, "/v1/maps/hall/sessions"
    session, answers = client.post(path, json={}).json()["id"], []
    with listening(running, "hall") as ear:
        for data in frames_of("query")[:25]:
            odometry = {"odometry_x": "0", "odometry_y": "0", "odometry_heading": "0"}  # it stands still
            sent = client.post(f"{path}/{session}/frames", params=odometry, content=data, headers=typed(data))
            answers.append(sent.json())
        events = [one.data for one in ear.some(len(answers), "session")]
    last = answers[-1]
    assert answers[1]["motion"] == "odometry" and answers[1]["contradiction"] is None
    assert last["motion"] == "contradicted" and last["contradiction"] == "frozen"
    assert last["contradiction_note"].startswith("odometry stands still while frames show")
    assert last["verdict"] == "recognized" and last["place"]["id"] in ("p22", "p23", "p24", "p25")
    for told in (client.get(f"{path}/{session}").json(), *client.get(path).json()["items"], events[-1]):
        assert told["contradiction"] == "frozen" and told["contradiction_note"] == last["contradiction_note"]
    report = client.get(f"{path}/{session}").json()
    assert "teaches its map nothing: its frames have no odometry_x" in report["teaches_nothing"]
    (robot,) = [one for one in client.get("/v1/fleet").json()["robots"] if one["session"] == session]
    assert robot["contradiction_note"] == last["contradiction_note"]
    assert 'placerec_contradicted_frames_total{kind="frozen"}' in client.get("/metrics").text
    client.delete(f"{path}/{session}")
    result = lessons(running, "hall")[0]
    assert (result["proposals"], result["contradiction"]) == (0, "no odometry")


def test_a_run_without_odometry_says_that_it_teaches_nothing_for_that_reason(running: Server) -> None:
    client, path = running.client, "/v1/maps/hall/sessions"
    session = client.post(path, json={}).json()["id"]
    assert client.get(f"{path}/{session}").json()["teaches_nothing"] is None, "there is no frame yet"
    for data in frames_of("query")[:8]:
        client.post(f"{path}/{session}/frames", content=data, headers=typed(data))
    assert "no odometry_x" in client.get(f"{path}/{session}").json()["teaches_nothing"]
    client.delete(f"{path}/{session}")
    assert lessons(running, "hall")[0]["contradiction"] == "no odometry"


def test_a_run_teaches_what_it_saw_in_the_dark(running: Server, placerec: Placerec) -> None:
    answers = drive(running, "hall")
    doubted = [n for n in DARK if answers[n]["single"]["verdict"] != "recognized"]
    assert len(doubted) >= 8, "the dark hides too little for a test"
    result = lessons(running, "hall")[0]
    assert result["frames"] == len(answers) and result["contradiction"] is None
    found = proposals(running, "hall")
    assert result["proposals"] == len(found) >= len(doubted) / 2
    assert result["proposals"] + sum(result["refused"].values()) == result["frames"], "each frame has its reason"
    latest, url = running.client.get("/v1/jobs").json()["items"][0]["id"], str(running.client.base_url)
    shown = " ".join(placerec("jobs", "show", latest, "--url", url).stdout.split())
    assert f"recognized: {result['refused']['recognized']}" in shown
    for frame in found:
        proposal, alone = frame["answer"]["proposal"], frame["answer"]
        assert alone["verdict"] != "recognized" and proposal["certainty"] >= 0.95 and proposal["why"]
    assert running.client.get("/v1/maps/hall/looks").json()["items"] == [], "nobody has accepted any"
    # A person accepts them all: the next run is recognized where the last one was not.
    for frame in found:
        place = frame["answer"]["proposal"]["place"]
        accepted = running.client.post(f"/v1/maps/hall/review/{frame['id']}", json={"place": place, "look": True})
        assert accepted.status_code == 200, accepted.text
    looks = running.client.get("/v1/maps/hall/looks").json()["items"]
    assert len(looks) == len(found)
    assert {look["run"] for look in looks} == {result["session"]} and all(look["least_score"] for look in looks)
    again = drive(running, "hall")
    right = [n for n in doubted if (place := again[n]["single"]["place"]) and abs(int(place["id"][1:]) - n) <= SAME + 1]
    wrong = [
        n for n, answer in enumerate(again)
        if (place := answer["single"]["place"]) and abs(int(place["id"][1:]) - n) > SAME + 2
    ]  # fmt: skip
    assert len(right) >= len(found) / 2 and not wrong
    said = {frame["id"]: frame["label"] for frame in proposals(running, "hall") if frame["label"]}
    assert len(said) == len(found) and all(label["look"] for label in said.values())
    undone = running.client.delete("/v1/maps/hall/looks", params={"run": result["session"]}).json()
    assert undone["looks"] == len(found)
    assert running.client.get("/v1/maps/hall/looks").json()["items"] == []
    labels = {frame["id"]: frame["label"] for frame in proposals(running, "hall") if frame["label"]}
    for label in said.values():
        del label["look"]
    assert labels == said, "they say the place alone"
    drive(running, "hall")
    assert lessons(running, "hall")[0]["refused"]["not kept"] == len(found), "a person has labelled these very files"


def test_a_run_with_wrong_odometry_teaches_nothing(running: Server) -> None:
    lessons(running, "hall")  # those of the runs before are over
    before = {frame["id"] for frame in proposals(running, "hall")}
    drive(running, "hall", drift=4.0)
    result = lessons(running, "hall")[0]
    assert result["proposals"] == 0
    assert {frame["id"] for frame in proposals(running, "hall")} == before


def test_a_run_through_another_building_teaches_nothing(running: Server) -> None:
    elsewhere = sorted((CORRIDOR.parent / "lip6_outdoor" / "query").iterdir())[:60]
    drive(running, "hall", frames=[path.read_bytes() for path in elsewhere])
    result = lessons(running, "hall")[0]
    assert (result["proposals"], result["contradiction"]) == (0, "too few recognized")


def test_a_map_that_is_off_takes_no_notes(running: Server) -> None:
    count = len(lessons(running, "hall"))
    edited = running.client.patch("/v1/maps/hall", json={"learning": {"mode": "off"}}).json()
    plain: dict[str, Any] = {
        "most_looks": 3,
        "most_places": None,
        "new_ground": False,
        "calibration": "propose",
        "rejected_ground": [],
    }
    assert edited["learning"] == {"mode": "off", "least_probability": 0.95} | plain
    drive(running, "hall")
    assert len(lessons(running, "hall")) == count
    restored = running.client.patch("/v1/maps/hall", json={"learning": {"mode": "propose", "least_probability": 0.99}})
    assert restored.json()["learning"] == {"mode": "propose", "least_probability": 0.99} | plain
    back = running.client.patch("/v1/maps/hall", json={"learning": {"least_probability": None}}).json()
    assert back["learning"] == {"mode": "propose", "least_probability": 0.95} | plain


def test_only_robots_whose_keys_say_so_teach(tmp_path: Path) -> None:
    server = Server(tmp_path, {}).wait()
    taught(server, "hall", "propose")
    keys = Keys.of(server.data_dir)
    _, query = keys.create("robot", "query")
    _, enrol = keys.create("mapper", "enrol")
    _, teacher = keys.create("teacher", "enrol", learn=True)
    _, admin = keys.create("admin", "admin")
    server.client.headers["Authorization"] = f"Bearer {admin}"
    until_known(server, "admin")  # before, everybody teaches; and who knows the last one knows all
    few = frames_of("query")[:10]
    for key in (query, enrol):
        drive(server, "hall", key=key, frames=few)
        assert lessons(server, "hall") == []
    drive(server, "hall", key=teacher, frames=few)
    assert len(lessons(server, "hall")) == 1
    assert server.stop() == 0


def test_a_service_that_is_killed_while_it_learns_leaves_nothing_half_done(tmp_path: Path) -> None:
    server = Server(tmp_path, {}).wait()
    taught(server, "hall", "auto")
    drive(server, "hall")
    (job,) = [job for job in server.client.get("/v1/jobs").json()["items"] if job["kind"] == "learn"]
    while not proposals(server, "hall") and server.client.get(f"/v1/jobs/{job['id']}").json()["state"] == "running":
        pass
    server.kill()
    again = Server(tmp_path, {}).wait()
    assert again.client.post("/v1/maps/hall/verify").json()["ok"]
    assert again.client.get("/v1/maps/hall").json()["places"] == 60
    looks = {
        (look["place"], look["name"]) for look in again.client.get("/v1/maps/hall/looks?limit=100").json()["items"]
    }
    page = again.client.get("/v1/maps/hall/review", params={"limit": 100, "labelled": "true"}).json()["items"]
    assert {(frame["label"]["place"], frame["label"]["look"]) for frame in page} <= looks
    drive(again, "hall")  # a later run goes on with the proposals that were left
    result = lessons(again, "hall")[0]
    assert result["taken"] + len(looks) > 0
    assert again.stop() == 0


def test_a_map_takes_by_itself_what_keypoints_agree_on(running: Server) -> None:
    taught(running, "self-taught", "auto")
    first = drive(running, "self-taught")
    result = lessons(running, "self-taught")[0]
    looks = running.client.get("/v1/maps/self-taught/looks", params={"limit": 100}).json()["items"]
    assert 0 < len(looks) <= result["taken"] <= result["proposals"]
    assert all(look["run"] == result["session"] for look in looks)
    labelled = running.client.get("/v1/maps/self-taught/review/labels").json()["items"]
    assert {one["place"] for one in labelled} >= {look["place"] for look in looks}
    assert all(one["labelled_by"].startswith("learning") for one in labelled)
    second = drive(running, "self-taught")

    def right(answers: list[dict[str, Any]]) -> int:
        places = [answer["single"]["place"] for answer in answers]
        return sum(one is not None and abs(int(one["id"][1:]) - n) <= SAME + 1 for n, one in enumerate(places))

    def wrong(answers: list[dict[str, Any]]) -> int:
        places = [answer["single"]["place"] for answer in answers]
        return sum(one is not None and abs(int(one["id"][1:]) - n) > SAME + 2 for n, one in enumerate(places))

    assert right(second) > right(first) and wrong(second) <= wrong(first)
    lessons(running, "self-taught")
    after = running.client.get("/v1/maps/self-taught/looks", params={"limit": 100}).json()["items"]
    assert sum(look["right"] for look in after) > 0 and not any(look["wrong"] for look in after)
    # A person says that one of them is no place of the map: the look that it became is gone.
    review = "/v1/maps/self-taught/review"
    labelled_frames = running.client.get(review, params={"limit": 100, "labelled": "true"}).json()["items"]
    label = labelled_frames[0]["label"]
    path = f"/v1/maps/self-taught/places/{label['place']}/looks"

    def names() -> set[str]:
        return {look["name"] for look in running.client.get(path).json()["items"]}

    agreed = running.client.post(f"{review}/{labelled_frames[0]['id']}", json={"place": label["place"]})
    assert agreed.status_code == 200 and label["look"] in names(), "a person who says the same takes nothing away"
    label = labelled_frames[1]["label"]
    path = f"/v1/maps/self-taught/places/{label['place']}/looks"
    assert label["look"] in names()
    assert running.client.post(f"{review}/{labelled_frames[1]['id']}", json={"stranger": True}).status_code == 200
    assert label["look"] not in names()
    running.client.delete("/v1/maps/self-taught")
