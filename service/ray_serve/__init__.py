"""Encoders in processes of a Ray cluster, as a deployment of Ray Serve; the service is the front that calls them.

``replica`` runs in the cluster and knows no Ray; ``cluster`` starts or joins one and deploys replicas there;
``encoders`` is what the queue of a front hands its frames to.  docs/explanation/ray.md says why it is divided so.
"""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

from core.errors import MissingExtra
from service.engine.encoders import Encoders, MakeEncoders
from service.settings import PREFIX, Settings, SettingsError

if TYPE_CHECKING:
    from core.frames.images import Limits
    from service.telemetry.metrics import Metrics

__all__ = ["check_installed", "check_usable", "encoders_for"]


def check_installed() -> None:
    """Check, without importing Ray, that it is installed.

    Raises:
        MissingExtra: Ray Serve is not installed.
    """
    if importlib.util.find_spec("ray") is None:  # to look for ray.serve would import ray
        raise MissingExtra(
            "Encoders in a Ray cluster need Ray Serve, which others do not: pip install 'placerec[ray]', or in a"
            " checkout .venv/bin/pip install --editable '.[ray]'."
        )


def check_usable(settings: Settings) -> None:
    """As :func:`check_installed`, and that the settings fit each other.

    Raises:
        MissingExtra: Ray Serve is not installed.
        SettingsError: the encoders are to compute on GPUs of which they get none.
    """
    check_installed()
    if settings.device == "cuda" and not settings.ray_replica_gpus:
        raise SettingsError(f"{PREFIX}DEVICE is cuda, and {PREFIX}RAY_REPLICA_GPUS gives no process a GPU.")


def encoders_for(settings: Settings) -> MakeEncoders | None:
    """Makes the encoders of a Ray cluster, if the settings ask for them; None: threads of this process encode.

    Raises:
        MissingExtra, SettingsError: see :func:`check_usable`.
    """
    if not settings.ray:
        return None
    check_usable(settings)

    def make(limits: Limits, metrics: Metrics) -> Encoders:
        from service.ray_serve.encoders import RayEncoders

        return RayEncoders(settings, limits, metrics)

    return make
