"""``placerec jobs``: list, follow and cancel jobs."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import typer

from service.commands.connection.client import (
    AsJson,
    CommandTarget,
    DataDir,
    Service,
    Url,
    ask,
    list_items,
    open_service,
    path_of,
    run,
)
from service.commands.console import Commands, Failure, number, progress, remark, show, show_json, table, words

jobs = typer.Typer(
    cls=Commands, help="List, follow and cancel jobs, which do long work in the background.", no_args_is_help=True
)

JobId = Annotated[str, typer.Argument(metavar="JOB", help="The job's id.", show_default=False)]
Wait = Annotated[
    bool, typer.Option("--wait/--no-wait", help="Wait until the job ends; it continues in the service either way.")
]

WAIT_SECONDS = 1.0
"""How long one request waits for news of a job, and so how often the progress bar moves."""

OPEN = ("queued", "running")


@jobs.command("list")
def list_jobs(
    map_id: Annotated[str | None, typer.Option("--map", "-m", help="Only the jobs of this map.")] = None,
    state: Annotated[
        Literal["queued", "running", "succeeded", "failed", "cancelled"] | None,
        typer.Option(help="Only jobs in this state."),
    ] = None,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """List jobs, the newest first."""
    given = {"map": map_id, "state": state}
    found = list_items(CommandTarget(url, data_dir), path_of("jobs"), {n: v for n, v in given.items() if v is not None})
    if as_json:
        show_json(found)
        return
    shown = table("job", "kind", "map", "state", "#done", "created")
    for job in found:
        shown.add_row(job["id"], job["kind"], job["map"] or "–", job["state"], _done(job), job["created_at"])
    show(shown)


@jobs.command("show")
def show_job(job_id: JobId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """Show one job."""
    show_outcome(ask(CommandTarget(url, data_dir), "GET", path_of("jobs", job_id)).json(), as_json)


@jobs.command("wait")
def wait_for_job(job_id: JobId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """Wait until a job ends; the exit status is 1 unless it succeeds."""

    async def work() -> dict[str, Any]:
        async with open_service(CommandTarget(url, data_dir)) as service:
            return await followed(service, await service.get(path_of("jobs", job_id)))

    show_outcome(run(work()), as_json)


@jobs.command("cancel")
def cancel_job(job_id: JobId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """Ask a job to stop; it stops at its next safe point."""
    job = ask(CommandTarget(url, data_dir), "POST", path_of("jobs", job_id, "cancel")).json()
    if as_json:
        show_json(job)
    else:
        remark(f"The job {job_id} is {job['state']}{' and will stop' if job['state'] in OPEN else ''}.")


async def followed(service: Service, job: dict[str, Any]) -> dict[str, Any]:
    """Wait until a job ends, with a progress bar, and return it.

    Raises:
        Refused, Failure: the service refuses the request, or does not answer.
    """
    with progress() as bar:
        task = bar.add_task(job["kind"], total=None)
        while job["state"] in OPEN:
            job = await service.get(path_of("jobs", job["id"]), params={"wait": WAIT_SECONDS})
            how = job["progress"]
            what = f"{job['kind']}: {how['message']}" if how["message"] else job["kind"]
            bar.update(task, completed=how["done"], total=how["total"], description=what)
    return job


def submit(target: CommandTarget, path: str, body: dict[str, Any], wait: bool) -> dict[str, Any]:
    """Submit a job, wait until it ends if ``wait`` is set, and return it.

    Raises:
        Failure: ``wait`` is not set, but the service ends with this command.
        Refused: the service refuses the job.
    """
    check_outlives(target, wait)

    async def work() -> dict[str, Any]:
        async with open_service(target) as service:
            job: dict[str, Any] = (await service.request("POST", path, json=body)).json()
            return await followed(service, job) if wait else job

    return run(work())


def check_outlives(target: CommandTarget, wait: bool) -> None:
    """Refuse not to wait for a job if its service ends with this command.

    Raises:
        Failure: ``wait`` is not set, and there is no URL.
    """
    if not wait and target.url is None:
        raise Failure("Without --url the service ends with this command. Leave out --no-wait, or give --url.")


def show_outcome(job: dict[str, Any], as_json: bool) -> None:
    """Show a job.

    Raises:
        Failure: the job has failed or was cancelled.
    """
    if as_json:
        show_json(job)
    if job["state"] == "failed":
        raise Failure(job["problem"]["detail"])
    if job["state"] == "cancelled":
        raise Failure(f"The job {job['id']} was cancelled.")
    if as_json:
        return
    shown = table("field", "value", title=f"Job {job['id']}")
    for name in ("kind", "map", "state", "attempt", "created_at", "started_at", "ended_at"):
        shown.add_row(name, "–" if job[name] is None else str(job[name]))
    shown.add_row("progress", _done(job))
    result = dict(job["result"] or {})
    lists = {name: result.pop(name) for name, value in list(result.items()) if _is_table(value)}
    for name, value in result.items():
        is_offer = name == "calibration" and "outcome" in (value or {})
        shown.add_row(name, offered_calibration(value) if is_offer else words(value))
    show(shown)
    for name, rows in lists.items():
        shown = table(*rows[0], title=name)
        for row in rows:
            shown.add_row(*map(words, row.values()))
        show(shown)


def offered_calibration(told: dict[str, Any]) -> str:
    """A line on what a job says of the map's calibration: the outcome, and the figures before and after."""
    changes = [
        f"{name} {number(told[key][0])} → {number(told[key][1])}"
        for name, key in (("recall", "recall"), ("precision", "precision"), ("calibration error", "error"))
        if key in told
    ]
    of = f", by {told['frames']} frames" if "frames" in told else ""
    figures = f": {', '.join(changes)}" if changes else ""
    return f"{told['outcome']}{of}{figures or (': ' + told['detail'] if 'detail' in told else '')}"


def _is_table(value: Any) -> bool:
    """Whether a result is a list of objects with the same fields, which have a table of their own."""
    return (
        bool(value)
        and isinstance(value, list)
        and all(isinstance(one, dict) and [*one] == [*value[0]] for one in value)
    )


def _done(job: dict[str, Any]) -> str:
    how = job["progress"]
    return str(how["done"]) if how["total"] is None else f"{how['done']}/{how['total']}"
