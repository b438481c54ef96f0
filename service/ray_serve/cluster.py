"""A Ray cluster, started on this machine or joined, and the deployment of encoders in it."""

from __future__ import annotations

import atexit
import io
import ipaddress
import logging
import math
import os
import socket
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from core.frames.images import Limits
from core.silence import SWITCHES
from core.threads import cores
from service.ray_serve.replica import EncoderReplica, ReplicaSettings
from service.settings import Settings

if TYPE_CHECKING:
    from ray.serve.handle import DeploymentHandle

APPLICATION = "placerec-encoders"
DEPLOYMENT = "Replica"

CALLS = 4
"""Calls that a replica accepts at a time: two of each of two fronts.  More wait at their fronts."""

BUSY = 1.5
"""Calls a replica on average from which on more replicas are started: one is encoded, a full one waits behind it."""

OBJECT_STORE_BYTES = 100_000_000
"""Shared memory of a Ray that is started here; it hardly needs any, since frames go from process to process."""

QUICK = {
    "RAY_SERVE_RUN_USER_CODE_IN_SEPARATE_THREAD": "0",  # a replica computes in threads of its own
    "RAY_SERVE_METRICS_EXPORT_INTERVAL_MS": "5000",
}
"""Variables by which Ray Serve spares a thread, and time; a value that the user has set stays."""

NODE = {
    "RAY_worker_niceness": "0",  # else 15: replicas would wait for whatever else the machine does
}
"""Variables of a Ray that is started here; where ``ray start`` starts it, others set them."""

JOINED = {
    "RAY_gcs_rpc_server_reconnect_timeout_s": "86400",  # else a process ends whose head has been away for a minute
}
"""Variables of a process that joins a cluster; it notes itself that the cluster is lost, and leaves it."""

ANSWER_SECONDS = 4.0
"""Seconds within which a cluster answers requests about the encoders."""

CONNECT_SECONDS = 2.0
"""Seconds within which the head of a cluster accepts a connection, if it runs."""

log = logging.getLogger("placerec.ray")


class RayUnavailable(Exception):
    """The cluster cannot be reached, or the encoders cannot be deployed in it; the text says why."""


@dataclass(frozen=True)
class State:
    """The state of the encoders in the cluster.

    running: replicas that answer.
    problem: why there are none, or fewer than wanted; empty if all is well.
    deploying: whether a rollout is under way.
    """

    running: int
    problem: str
    deploying: bool = False


class Cluster:
    """A connection of this process to a Ray cluster; there is one in a process at most.

    Usage statistics and the dashboard are off in a Ray that is started here, and only this machine can reach it.

    Args:
        settings: ``ray_address`` names a cluster to join; without one, Ray is started on this machine.
    """

    def __init__(self, settings: Settings, limits: Limits) -> None:
        self._settings, self._limits = settings, limits
        self._own = not settings.ray_address
        prepare_environment(self._own, self._own or _is_loopback(settings.ray_address))

    def open(self) -> None:
        """Start or join the cluster, and deploy the encoders unless they are there; blocks.

        Raises:
            RayUnavailable: one of these fails.
        """
        from ray import serve

        self.join()
        try:
            if APPLICATION not in serve.status().applications:
                self.deploy()
        except Exception as error:
            _leave()
            raise RayUnavailable(f"the encoders cannot be deployed: {_first_line(error)}") from error

    def join(self) -> None:
        """Start or join the cluster; blocks.

        Raises:
            RayUnavailable: it cannot be reached.
        """
        import ray

        self._look_for_head()
        chosen: dict[str, Any] = {"address": self._settings.ray_address}
        if self._own:
            chosen = {
                "address": "local",
                "num_cpus": self._processors() + self._replica_cpus(),
                "include_dashboard": False,
                "object_store_memory": OBJECT_STORE_BYTES,
            }
            start_no_dashboards()
        said = io.StringIO()
        try:
            with redirect_stdout(said), redirect_stderr(said):
                ray.init(namespace="placerec", log_to_driver=False, configure_logging=False, **chosen)
        except Exception as error:
            _leave()
            where = "Ray cannot be started" if self._own else f"the Ray cluster {self._settings.ray_address} is away"
            raise RayUnavailable(f"{where}: {_first_line(error)}") from error
        finally:
            for line in said.getvalue().splitlines():
                log.debug("%s", line)
            for name in ("ray", "ray.serve"):  # what they have to say is said in the lines of this process
                logging.getLogger(name).handlers.clear()
                logging.getLogger(name).propagate = True
                logging.getLogger(name).setLevel(logging.WARNING)

    def _look_for_head(self) -> None:
        """Raise RayUnavailable at once if nothing listens there; Ray itself would try for more than a minute."""
        address = self._settings.ray_address
        if self._own:
            return
        host, _, port = address.rpartition(":")
        try:
            with socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS):
                pass
        except (OSError, ValueError) as error:
            raise RayUnavailable(f"the Ray cluster {address} is away: {_first_line(error)}") from error

    def deploy(self, replica: type = EncoderReplica) -> None:
        """Deploy the encoders as they are installed now.

        Replicas that run are replaced one after the other: the new one has loaded its encoder, and answers, before an
        old one stops, which finishes its calls first.  This needs room in the cluster for one more replica.

        Returns at once; :meth:`state` says how far it is.  If the new replicas do not start, the old ones stay.

        Args:
            replica: the class of a replica.

        Raises:
            RayUnavailable: the cluster refuses.
        """
        from ray import serve
        from ray.serve.config import AutoscalingConfig, ProxyLocation, RequestRouterConfig

        chosen = self._settings
        options: dict[str, Any] = {"num_cpus": chosen.ray_replica_cpus, "num_gpus": chosen.ray_replica_gpus}
        if not self._own:
            options["runtime_env"] = {"env_vars": QUICK | SWITCHES}
        least = chosen.ray_replicas
        most = max(least, chosen.ray_max_replicas or self._room())
        made: Any = serve.deployment(
            replica,
            name=DEPLOYMENT,
            ray_actor_options=options,
            max_ongoing_requests=CALLS,
            autoscaling_config=AutoscalingConfig(
                min_replicas=least,
                max_replicas=most,
                target_ongoing_requests=BUSY,
                metrics_interval_s=chosen.ray_scale_seconds / 5,
                look_back_period_s=chosen.ray_scale_seconds,
                upscale_delay_s=chosen.ray_scale_seconds,
                downscale_delay_s=20 * chosen.ray_scale_seconds,
            ),
            health_check_period_s=2.0,
            health_check_timeout_s=30.0,
            graceful_shutdown_wait_loop_s=0.5,
            graceful_shutdown_timeout_s=chosen.shutdown_timeout,
            max_surge_percent=math.ceil(100 / most),
            request_router_config=RequestRouterConfig(
                request_router_class="service.ray_serve.routing:ShortestQueueRouter"  # type: ignore[arg-type]
            ),
            logging_config={"log_level": "WARNING", "enable_access_log": False},
        )
        try:
            serve.start(proxy_location=ProxyLocation.Disabled, logging_config={"log_level": "WARNING"})
            target = serve.RunTarget(made.bind(self._replica_settings()), name=APPLICATION, route_prefix=None)
            # It could wait for ever for processors that the cluster does not have.
            serve.run_many([target], wait_for_applications_running=False)
        except Exception as error:
            raise RayUnavailable(f"the encoders cannot be deployed: {_first_line(error)}") from error

    def state(self) -> State:
        """The state of the encoders in the cluster; blocks, not for long, and raises Ray's error if it does not answer.

        ``serve.status()`` would wait for ever, and a thread that waits while Ray is left ends the process.
        """
        import ray
        from ray.serve.context import _get_global_client
        from ray.serve.schema import ServeInstanceDetails

        client = _get_global_client(raise_if_no_controller_running=False)
        if client is None:
            return State(0, "they are not deployed")
        details = ray.get(client._controller.get_serve_instance_details.remote(), timeout=ANSWER_SECONDS)
        application = ServeInstanceDetails(**details)._get_status().applications.get(APPLICATION)
        if application is None:
            return State(0, "they are not deployed")
        deployment = application.deployments.get(DEPLOYMENT)
        running = sum(
            count
            for state, count in (deployment.replica_states if deployment else {}).items()
            if state in ("RUNNING", "PENDING_MIGRATION")
        )
        problem = (deployment.message if deployment else "") or application.message
        return State(running, problem.strip(), application.status in ("NOT_STARTED", "DEPLOYING"))

    def address(self) -> str:
        """Where others join the cluster, host:port."""
        import ray

        return str(ray.get_runtime_context().gcs_address)

    def close(self) -> None:
        """Leave the cluster; one that was started here ends with its encoders.  Others keep theirs."""
        import ray
        from ray import serve

        if ray.is_initialized():
            if self._own:
                serve.shutdown()  # type: ignore[no-untyped-call]
            _leave()

    def abandon(self) -> None:
        """Leave a cluster that does not answer, so that it, or another at its address, can be joined again; blocks."""
        _leave()

    def forget(self) -> None:
        """Let the end of this process wait for no Ray, after :meth:`close` has waited in vain."""
        import ray

        atexit.unregister(ray.shutdown)

    def _replica_settings(self) -> ReplicaSettings:
        chosen = self._settings
        threads = chosen.threads or max(1, math.ceil(chosen.ray_replica_cpus))
        return ReplicaSettings(chosen.models_directory.absolute(), chosen.encoder, chosen.device, self._limits, threads)

    def _room(self) -> int:
        """How many replicas the cluster has processors, or GPUs, for."""
        import ray

        chosen, has = self._settings, ray.cluster_resources()  # type: ignore[no-untyped-call]
        cpus = has.get("CPU", 0.0) - (self._replica_cpus() if self._own else 0)
        rooms = [cpus / chosen.ray_replica_cpus] if chosen.ray_replica_cpus else []
        rooms += [has.get("GPU", 0.0) / chosen.ray_replica_gpus] if chosen.ray_replica_gpus else []
        return int(min(rooms, default=1))

    def _replica_cpus(self) -> int:
        return max(1, math.ceil(self._settings.ray_replica_cpus))

    def _processors(self) -> int:
        """Processors to promise to replicas on this machine; there is one replica's share more, for a rollout."""
        return max(cores(), self._settings.ray_replicas * self._replica_cpus())


def prepare_environment(own: bool, local: bool) -> None:
    """Set what Ray reads when it is imported, and what its processes inherit."""
    if local:
        # By this variable Ray chooses the loopback address for its ports; its name says where that is the default.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    os.environ["RAY_ENABLE_AUTO_CONNECT"] = "0"  # else what is still at work in a cluster that was left starts a Ray
    os.environ.setdefault("RAY_AUTH_MODE", "token")  # a local Ray makes one; in a cluster all machines have the same
    for name, value in (QUICK | (NODE if own else JOINED)).items():
        os.environ.setdefault(name, value)


def start_node(words: Sequence[str]) -> None:
    """Do as ``ray start`` with these words does, and start no dashboard."""
    for name, value in NODE.items():
        os.environ.setdefault(name, value)
    start_no_dashboards()
    from ray.scripts.scripts import start

    start.main(list(words), prog_name="placerec ray start")


def start_no_dashboards() -> None:
    """Let heads of Ray that this process starts from now on have no process of the dashboard.

    Ray starts it also where no dashboard is wanted.  It then serves the usage statistics alone, and even if these are
    off it asks addresses beyond this machine which cloud this is.
    """
    from ray._private.node import Node

    def start_none(node: Any, **_: object) -> None:
        node._webui_url = ""

    Node.start_api_server = start_none  # type: ignore[assignment,method-assign]


def caller() -> DeploymentHandle[EncoderReplica]:
    """The handle that calls replicas to encode, from the event loop that runs now and with no thread of Ray's between.

    It is no handle that Ray Serve keeps for others, which may have no such loop.
    """
    from ray.serve.handle import DeploymentHandle

    handle: DeploymentHandle[EncoderReplica] = DeploymentHandle(DEPLOYMENT, APPLICATION)
    handle._init(_run_router_in_separate_loop=False)  # type: ignore[no-untyped-call]
    # Without references a call goes straight to the replica; Ray's object store would double its cost.
    return handle.options(
        method_name="encode",
        _by_reference=False,
        request_serialization="pickle",
        response_serialization="pickle",
    )


def _leave() -> None:
    import ray
    from ray.serve.context import _set_global_client

    ray.shutdown()
    # Else Ray Serve could take the controller of this cluster for that of the next one.
    _set_global_client(None)  # type: ignore[no-untyped-call]


def _is_loopback(address: str) -> bool:
    host = address.rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0][:500] if lines else type(error).__name__
