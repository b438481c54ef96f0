"""Routes of a map's cameras: the areas ignored in their frames (a bonnet, a time stamp), and their intrinsics."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Path
from starlette.responses import Response

from core import errors
from core.places import Camera
from service.errors.faults import UnsupportedMediaType
from service.errors.problems import problem_documentation
from service.http.routing import WHOLE_DELETION, EngineDep, MapId, StrictRoute, json_body, single_values
from service.maps.schemas import CameraDefinition, CameraList, CameraView
from service.places.map_events import tell_map

router = APIRouter(
    prefix="/v1/maps/{map}/cameras",
    tags=["cameras"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
)
CameraName = Annotated[
    Camera, Path(alias="camera", description="The name that frames give with `?camera=`.", examples=["front"])
]


@router.put(
    "/{camera}",
    dependencies=[Depends(json_body)],
    responses={
        201: {"model": CameraView, "description": "A new camera."},
        **problem_documentation(UnsupportedMediaType, errors.InvalidField, errors.StorageFull),
    },
)
def put_camera(
    map_id: MapId, name: CameraName, definition: CameraDefinition, engine: EngineDep, response: Response
) -> CameraView:
    """Create or replace a camera: a mask of what is ignored in its frames, which name it with `?camera=`, its
    intrinsics, by which a pose is measured, and the range of its values, by which frames of 16 bits are scaled.

    Mask and range are applied to every frame from now on. Places that were enrolled with others stay as they are
    until their frames are sent again. Intrinsics hold for all frames of the camera, enrolled ones included. What is
    left out is removed.
    """
    map_ = engine.maps.get(map_id)
    made, is_new = map_.cameras.put(name, definition.mask, definition.intrinsics, definition.value_range)
    tell_map(engine, map_, "cameras")
    response.status_code = 201 if is_new else 200
    return CameraView(**made.__dict__)


@router.get("")
def list_cameras(map_id: MapId, engine: EngineDep) -> CameraList:
    """List the cameras of a map."""
    return CameraList(items=[CameraView(**camera.__dict__) for camera in engine.maps.get(map_id).cameras.all()])


@router.get("/{camera}", responses=problem_documentation(errors.UnknownCamera))
def read_camera(map_id: MapId, name: CameraName, engine: EngineDep) -> CameraView:
    """Read one camera."""
    return CameraView(**engine.maps.get(map_id).cameras.find(name).__dict__)


@router.delete(
    "/{camera}",
    status_code=204,
    dependencies=[WHOLE_DELETION],
    responses=problem_documentation(errors.UnknownCamera, errors.StorageFull),
)
def delete_camera(map_id: MapId, name: CameraName, engine: EngineDep) -> None:
    """Delete a camera. Frames that name it are refused from then on; places that were enrolled with it stay."""
    map_ = engine.maps.get(map_id)
    engine.reserve.making_room(partial(map_.cameras.forget, name))
    tell_map(engine, map_, "cameras")
