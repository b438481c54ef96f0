"""``placerec ray``: the encoders in a Ray cluster."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

from service.commands.console import Commands, Failure, remark
from service.commands.options.settings import read_settings

if TYPE_CHECKING:
    from service.ray_serve.cluster import Cluster

ray = typer.Typer(
    cls=Commands,
    help="Start nodes of a Ray cluster, deploy the encoders in it, and look at them.",
    no_args_is_help=True,
)

Address = Annotated[
    str | None, typer.Option(help="Of the cluster, host:port; default: PLACEREC_RAY_ADDRESS.", show_default=False)
]

LOOK_SECONDS = 0.5
"""Seconds between two looks at a rollout."""


@ray.command("start", context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def start(context: typer.Context) -> None:
    """Start a node of Ray on this machine, with the options of Ray's own command, such as --head and --block.

    Unlike ray start it has no dashboard, reports to nobody, and does not let encoders wait for everything else that the
    machine does.
    """
    from service.ray_serve import check_installed
    from service.ray_serve.cluster import start_node

    check_installed()
    start_node(context.args)


@ray.command("deploy")
def deploy(
    address: Address = None,
    timeout: Annotated[float, typer.Option(min=1, help="Seconds to wait for the new processes.")] = 600.0,
) -> None:
    """Deploy the encoders as they are installed now, or replace those that run, without an interruption.

    A new process has loaded its encoder before an old one stops, so the cluster needs room for one more. If the new
    ones do not start, the old ones stay. Services that use them need not be restarted.
    """
    cluster = _joined(address)
    try:
        cluster.deploy()
        until = time.monotonic() + timeout
        while (found := cluster.state()).deploying:
            if time.monotonic() > until:
                raise Failure(f"After {timeout:g} s the rollout is still under way. {found.problem}")
            time.sleep(LOOK_SECONDS)
    finally:
        cluster.close()
    if found.problem:
        raise Failure(found.problem)
    remark(f"{found.running} processes encode.")


@ray.command("status")
def status(address: Address = None) -> None:
    """Say how many processes of the cluster encode; the exit status is 1 if none does."""
    cluster = _joined(address)
    try:
        found = cluster.state()
    finally:
        cluster.close()
    remark(f"{found.running} processes encode{', a rollout is under way' if found.deploying else ''}. {found.problem}")
    if not found.running:
        raise typer.Exit(1)


def _joined(address: str | None) -> Cluster:
    from core.frames.images import Limits
    from service.ray_serve import check_usable
    from service.ray_serve.cluster import Cluster, RayUnavailable
    from service.settings import SettingsError

    settings = read_settings(None)
    settings = settings.model_copy(update={"ray_address": address or settings.ray_address})
    if not settings.ray_address:
        raise Failure("Name the cluster: --address HOST:PORT. A service that started one logs its address.")
    try:
        check_usable(settings)
        cluster = Cluster(settings, Limits(max_bytes=settings.max_image_bytes, max_pixels=settings.max_image_pixels))
        cluster.join()
    except (RayUnavailable, SettingsError) as error:
        raise Failure(str(error)) from error
    return cluster
