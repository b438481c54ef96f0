"""``placerec jobs``: long work, listed, followed and cancelled."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import typer

from service.commands.connection.client import (
    AsJson,
    DataDir,
    Service,
    Target,
    Url,
    ask,
    list_items,
    open_service,
    path_of,
    run,
)
from service.commands.console import Commands, Failure, progress, remark, show, show_json, table

jobs = typer.Typer(cls=Commands, help="List, follow and cancel long work.", no_args_is_help=True)

JobId = Annotated[str, typer.Argument(metavar="JOB", help="The job's id.", show_default=False)]
Wait = Annotated[
    bool, typer.Option("--wait/--no-wait", help="Wait for the job's end; it goes on in the service either way.")
]

WAIT_SECONDS = 1.0
"""Of one question: how often the bar moves."""

OPEN = ("queued", "running")


@jobs.command("list")
def list_jobs(
    map_id: Annotated[str | None, typer.Option("--map", "-m", help="Only the jobs of this map.")] = None,
    state: Annotated[
        Literal["queued", "running", "succeeded", "failed", "cancelled"] | None, typer.Option(help="Only those.")
    ] = None,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """List jobs, the newest first."""
    asked = {"map": map_id, "state": state}
    found = list_items(Target(url, data_dir), path_of("jobs"), {n: v for n, v in asked.items() if v is not None})
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
    tell(ask(Target(url, data_dir), "GET", path_of("jobs", job_id)).json(), as_json)


@jobs.command("wait")
def wait_for_job(job_id: JobId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """Follow a job to its end; the exit status is 1 unless it succeeds."""

    async def work() -> dict[str, Any]:
        async with open_service(Target(url, data_dir)) as service:
            return await followed(service, await service.get(path_of("jobs", job_id)))

    tell(run(work()), as_json)


@jobs.command("cancel")
def cancel_job(job_id: JobId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """Ask a job to stop; it does so where it can."""
    job = ask(Target(url, data_dir), "POST", path_of("jobs", job_id, "cancel")).json()
    if as_json:
        show_json(job)
    else:
        remark(f"The job {job_id} is {job['state']}{', and is to stop' if job['state'] in OPEN else ''}.")


async def followed(service: Service, job: dict[str, Any]) -> dict[str, Any]:
    """A job at its end, its progress shown meanwhile.

    Raises:
        Refused, Failure: the service does not tell.
    """
    with progress() as bar:
        task = bar.add_task(job["kind"], total=None)
        while job["state"] in OPEN:
            job = await service.get(path_of("jobs", job["id"]), params={"wait": WAIT_SECONDS})
            how = job["progress"]
            what = f"{job['kind']}: {how['message']}" if how["message"] else job["kind"]
            bar.update(task, completed=how["done"], total=how["total"], description=what)
    return job


def submit(target: Target, path: str, body: dict[str, Any], wait: bool) -> dict[str, Any]:
    """The job that is asked for, at its end if it is to be waited for.

    Raises:
        Failure: it is not to be waited for, but the service would end with this command.
        Refused: the service does not take it.
    """
    if not wait and target.url is None:
        raise Failure("Without --url the service ends with this command, and the job would only go on with the next.")

    async def work() -> dict[str, Any]:
        async with open_service(target) as service:
            job: dict[str, Any] = (await service.request("POST", path, json=body)).json()
            return await followed(service, job) if wait else job

    return run(work())


def tell(job: dict[str, Any], as_json: bool) -> None:
    """Write a job.

    Raises:
        Failure: it has failed, or was cancelled.
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
    for name, value in (job["result"] or {}).items():
        shown.add_row(name, str(value))
    show(shown)


def _done(job: dict[str, Any]) -> str:
    how = job["progress"]
    return str(how["done"]) if how["total"] is None else f"{how['done']}/{how['total']}"
