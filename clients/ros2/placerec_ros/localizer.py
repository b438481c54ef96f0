"""The thread that speaks with the service, so that the node's callbacks never wait for it.

Frames come in by :meth:`Localizer.add`, answers go out by an :class:`Outlet`. Requests of the node's services are done
by the same thread, between two frames.
"""

from __future__ import annotations

import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

from placerec_client import Client, DeadlineExceeded, InvalidOdometry, PlacerecError, Problem
from placerec_ros.answers import Answered, Following, Outlet, filtered
from placerec_ros.frame_queue import Frame, FrameQueue, Moments
from placerec_ros.fusion import Fix
from placerec_ros.health import ERROR, OK, Health
from placerec_ros.odometry import CLOCK_JUMP, NANOSECONDS, Odometer
from placerec_ros.parameters import Settings
from placerec_ros.pictures import UnfitPicture, picture_of
from placerec_ros.planar import Planar
from placerec_ros.pose import PoseEstimate, estimate, estimate_of_rig, in_metres, metric
from placerec_ros.run import NOT_ALLOWED, SESSION_GONE, Run, ask_together, client_of, moment_of
from placerec_ros.track import Array

FIRST_PAUSE, LONGEST_PAUSE = 0.2, 5.0
"""Seconds before the next request after a trouble; they double."""
IDLE_CHECK = 5.0
"""Seconds without a frame after which the node asks whether the service is there."""
CAMERA_WAIT = 2.0
"""Seconds for which the first session waits for a CameraInfo."""
FRESH = 1.0
"""Seconds that an image may be old to be enrolled."""
OF_THE_FRAME = frozenset({400, 413, 415, 422})
ALTERNATES = (
    "Odometry leaps and returns again and again, as if two publishers alternate on its topic: nobody can know which is "
    "right."
)


@dataclass(frozen=True)
class Done:
    """The answer of a service of the node."""

    success: bool
    message: str


@dataclass
class Drive:
    """A drive on which the robot enrols images.

    origin: of its odometry.
    segment: from 1; with another origin the next one begins, whose coordinates are others.
    last: the pose by odometry of the last image of each camera that was enrolled.
    """

    origin: str
    segment: int = 1
    last: dict[str, Planar] = field(default_factory=dict)

    def goes_on(self, camera: str, odom: Planar, metres: float, degrees: float) -> bool:
        """Whether the robot has gone so many metres, or turned by so many degrees, since the last one of a camera."""
        if camera not in self.last:
            return True
        step = self.last[camera].inverse().then(odom)
        return math.hypot(step.x, step.y) >= metres or abs(math.degrees(step.yaw)) >= degrees


class Localizer:
    """The worker; it lives from the node's configuration until its clean-up.

    Args:
        outlet: gets the answers while the localizer is active.
    """

    def __init__(self, settings: Settings, outlet: Outlet, health: Health) -> None:
        self._settings, self._outlet, self._health = settings, outlet, health
        self.queue = FrameQueue(settings.queue_length)
        self.odometer = Odometer(settings.speed_limit)
        self._following = Following(self.odometer, health)
        self._moments: Moments | None = None
        if settings.rig_query:
            self._moments = Moments(settings.camera_names, round(settings.rig_tolerance * NANOSECONDS))
        self._latest: dict[str, Frame] = {}
        self._intrinsics: dict[str, dict[str, Any] | None] = {}
        self._camera_due = 0.0
        self.mounts: dict[str, Planar] = {}
        """Where cameras are on the robot, by /tf_static, as far as that is known. The node sets it."""
        self._wanted = True
        self._let_in: dict[str, int] = {}
        self._commands: deque[tuple[Callable[[], Done], Future[Done]]] = deque()
        self._wake = threading.Event()
        self._active = self._stopped = False
        self._generation = 0
        # The fields below belong to the worker.
        self._client: Client | None = None
        self._runs: dict[str, Run] = {}
        self._run_generation = 0
        self._sent: dict[str, Frame] = {}
        self._camera = ""  # that of the frame under way
        self._mapping = ""  # the origin of the odometry whose frame is that of the map that is made; empty if none is
        self._driving: Drive | None = None
        self._paused_until = 0.0
        self._heard = self._pictured = -math.inf  # a robot that has just started counts few seconds
        self._pause = FIRST_PAUSE
        began = datetime.now(UTC)
        self._sequence = settings.sequence or f"ros-{began:%Y%m%dT%H%M%SZ}"
        self._thread = threading.Thread(target=self._work, name="placerec", daemon=True)
        self._thread.start()

    # ---- for the node's callbacks; none of these waits

    @property
    def fix(self) -> Fix | None:
        """Where the robot is by all answers so far; None if that is not known."""
        return self._following.fix

    def add(self, frame: Frame) -> None:
        """Take in a frame; it is sent if frames are wanted, and not more often than they may be."""
        self._latest[frame.camera] = frame
        if self._settings.on_demand and not self._wanted and self._driving is None:
            self._health.counts["frames not wanted"] += 1
            return
        if self._too_soon(frame):
            self._health.counts["frames above the rate limit"] += 1
            return
        for one in [frame] if self._moments is None else self._moments.add(frame):
            self.queue.put(one)
            self._wake.set()

    def want(self) -> None:
        """Send frames until it is known again where the robot is."""
        self._wanted = True

    def _too_soon(self, frame: Frame) -> bool:
        """Whether a frame comes too early after the last one that was let in; one of an earlier time does not."""
        now = frame.stamp or round(frame.arrived * NANOSECONDS)
        last = self._let_in.get(frame.camera, 0)
        if self._settings.rate_limit and 0 <= now - last < NANOSECONDS / self._settings.rate_limit * 0.999:
            return True
        self._let_in[frame.camera] = now
        return False

    def camera(self, intrinsics: dict[str, Any] | None, camera: str = "") -> None:
        """Take in a camera's intrinsics; None if the message has none."""
        self._intrinsics[camera] = intrinsics

    def change(self, settings: Settings) -> None:
        """Take in settings whose live parameters have changed."""
        self._settings = settings

    def activate(self) -> None:
        """Begin a run with the next frame."""
        self._generation += 1
        self._camera_due = time.monotonic() + CAMERA_WAIT
        self._active = self._wanted = True
        self._wake.set()

    def deactivate(self) -> None:
        """End the run; answers that are under way are not published."""
        self._active = False
        self._generation += 1
        self.queue.clear()
        if self._moments is not None:
            self._moments.clear()
        self._latest.clear()
        self._wake.set()

    def stop(self, patience: float) -> None:
        """End the thread. If a request takes longer than ``patience`` seconds, it ends by itself after the request."""
        self.deactivate()
        self._stopped = True
        self._wake.set()
        self._thread.join(patience)

    def create_map(self) -> Future[Done]:
        """Create the map, bound to the encoder of the parameters."""
        return self._ask(self._create_map)

    def enrol_here(self) -> Future[Done]:
        """Enrol the present frame with the pose that odometry gives."""
        return self._ask(self._enrol_here)

    def enrol_keyframes(self, begin: bool) -> Future[Done]:
        """Begin to enrol images as the robot drives, or end it."""
        return self._ask(self._begin_drive if begin else self._end_drive)

    def relocalize(self) -> Future[Done]:
        """Forget the belief: begin a new session."""
        return self._ask(self._relocalize)

    def place(self, robot: Planar, covariance: Array, stamp: int) -> Future[Done]:
        """Believe a pose that somebody gives, with the covariance of x, y and yaw, [3, 3]; its stamp in nanoseconds."""
        return self._ask(lambda: self._place(robot, covariance, stamp))

    def _ask(self, command: Callable[[], Done]) -> Future[Done]:
        future: Future[Done] = Future()
        self._commands.append((command, future))
        self._wake.set()
        return future

    # ---- the worker

    def _work(self) -> None:
        try:
            while not self._stopped:
                self._wake.wait(self._rest())
                self._wake.clear()
                self._work_once()
        finally:
            self._end_runs()
            for _, future in self._commands:
                future.set_result(Done(False, "The node was cleaned up before it came to this."))
            if self._client is not None:
                self._client.close()

    def _rest(self) -> float:
        """Seconds to sleep if nothing happens."""
        if self._paused_until > (now := time.monotonic()):
            return self._paused_until - now
        return IDLE_CHECK

    def _work_once(self) -> None:
        while not self._stopped:
            self._renew()
            if self._commands:
                command, future = self._commands.popleft()
                future.set_result(self._done(command))
            elif time.monotonic() < self._paused_until:
                return
            elif self._active and (frame := self.queue.take(time.monotonic() - self._settings.deadline)) is not None:
                if self._driving is not None:
                    for one in frame.moment:
                        self._guarded(lambda frame=one: self._enrol_keyframe(frame))  # type: ignore[misc]
                else:
                    step = self._locate if self._moments is None else self._locate_rig
                    self._guarded(lambda frame=frame, step=step: step(frame))  # type: ignore[misc]
            else:
                if time.monotonic() - self._heard >= IDLE_CHECK:
                    self._guarded(self._check_service)
                return

    def _open(self) -> Client:
        if self._client is None:
            self._client = client_of(self._settings)
        return self._client

    def _guarded(self, step: Callable[[], None]) -> None:
        """Run a step; a failure is reported, and the next attempt waits."""
        try:
            step()
        except (UnfitPicture, InvalidOdometry) as error:
            self._health.frame(f"{_sentence(str(error))}")
        except PlacerecError as error:
            self._heard = time.monotonic()  # the next check of an idle node comes later
            reason = reason_of(error)
            if isinstance(reason, Problem):
                self._health.over("service")
                self._react(reason)
            else:
                self._health.fact("service", str(reason))
                self._health.begins("service", str(reason), ERROR)
                self._rest_longer()
        except Exception as error:  # the thread has to live on
            self._runs.pop(self._camera, None)
            self._health.begins("node", f"The node failed with {type(error).__name__}: {error}", ERROR)
            self._rest_longer()
        else:
            self._health.over("node")

    def _react(self, problem: Problem) -> None:
        """Decide what a problem means for the frames to come."""
        if problem.slug in SESSION_GONE:
            self._runs.pop(self._camera, None)  # a new one begins with the next frame
            self._health.begins("session", f"The session ended: {problem}", OK)
        elif problem.status in OF_THE_FRAME and self._camera in self._runs:
            self._health.frame(f"The service refused an image: {problem}")
        elif problem.status in (429, 503, 504):
            self._health.begins("load", f"The service has no room for a frame: {problem} ({problem.slug})")
            self._rest_longer(problem.retry_after or 0.0)
        else:
            self._runs.clear()  # a setting, a key or the map has to change; then runs can begin
            self._health.begins("map", f"The service refuses: {problem} ({problem.slug})", ERROR)
            self._rest_longer()

    def _rest_longer(self, least: float = 0.0) -> None:
        self._paused_until = time.monotonic() + max(least, self._pause)
        self._pause = min(2 * self._pause, LONGEST_PAUSE)

    def _check_service(self) -> None:
        self._open().liveness()
        self._heard_from_service()

    def _heard_from_service(self) -> None:
        self._heard = time.monotonic()
        self._pause, self._paused_until = FIRST_PAUSE, 0.0
        self._health.fact("service", f"{self._settings.url}: reachable")
        self._health.over("service")

    # ---- frames

    def _locate(self, frame: Frame) -> None:
        self._camera = frame.camera
        if not self._in_order(frame) or not self._is_placed(frame.camera):
            return
        generation = self._generation
        picture = picture_of(frame.message)
        if self._waits_for_info(frame.camera):
            return
        run = self._running(frame.camera)
        # Odometry's own pose: a frame without an answer may have reached the session, and its motion must count once.
        odometry = self.odometer.odometry(frame.stamp, self._mount(frame.camera).yaw) if frame.stamp else None
        began = time.monotonic()
        answer = run.send(picture, frame.number, frame.stamp, odometry)
        took = time.monotonic() - began
        self._was_answered((frame,))
        if generation != self._generation:
            return  # deactivated meanwhile
        flat = in_metres(answer, self._settings.origin)
        found = estimate(flat, run.radius)
        self._remark_pose(flat, found)
        of_robot = None if found is None else found.of_robot(self._mount(frame.camera))
        self._give_out(frame, answer, of_robot, answer["single"].get("revision"), took)
        self._annotate(frame, picture, run)

    def _locate_rig(self, moment: Frame) -> None:
        """Ask the frames of one moment in one query."""
        frames, pictures, runs = [], {}, {}
        for frame in moment.moment:
            self._camera = frame.camera
            if not self._in_order(frame) or not self._is_placed(frame.camera) or self._waits_for_info(frame.camera):
                continue
            try:
                pictures[frame.camera] = picture_of(frame.message)
            except UnfitPicture as error:
                self._health.frame(f"{frame.camera}: {error}.")
                continue
            runs[frame.camera] = self._running(frame.camera)
            frames.append(frame)
        if not frames:
            return
        generation, first = self._generation, frames[0]
        began = time.monotonic()
        answer = ask_together(self._open(), self._settings, pictures, runs)
        took = time.monotonic() - began
        self._was_answered(frames)
        if generation != self._generation:
            return  # deactivated meanwhile
        for one in answer["frames"]:
            if one["problem"] is not None:
                self._health.frame(f"The service refused an image of {one['frame']}: {one['problem']['detail']}")
        flat, run = in_metres(answer, self._settings.origin), runs[first.camera]
        mounts = {name: self._mount(name) for name in runs}
        cameras = {name: one.camera for name, one in runs.items()}
        yaw = None if self.fix is None else self.fix.track.robot.yaw
        found = estimate_of_rig(flat, mounts, cameras, run.radius, yaw)
        self._remark_pose(flat, found)
        revision = answer["maps"][0]["revision"]
        run.of_revision(revision)
        self._give_out(replace(first, camera=",".join(pictures)), answer, found, revision, took)
        self._annotate(first, pictures[first.camera], run)

    def _waits_for_info(self, camera: str) -> bool:
        """Whether the first CameraInfo of a camera is still waited for."""
        waits = self._settings.use_camera_info and camera not in self._intrinsics
        if waits and time.monotonic() < self._camera_due:
            self._health.counts["frames before the first CameraInfo"] += 1
            return True
        return False

    def _was_answered(self, frames: Sequence[Frame]) -> None:
        """Note that the service has answered frames."""
        self._heard_from_service()
        for kind in ("map", "load", "session"):
            self._health.over(kind)
        self._sent |= {frame.camera: frame for frame in frames}

    def _in_order(self, frame: Frame) -> bool:
        """Whether the frame was taken after the last one; a clock that was set back begins a new run."""
        sent = self._sent.get(frame.camera)
        if sent is None or not frame.stamp or not sent.stamp or frame.stamp >= sent.stamp:
            return True
        if frame.stamp < sent.stamp - CLOCK_JUMP * NANOSECONDS:
            self._mapping = ""
            self._forget()
            self._end_runs()
            return True
        self._health.counts["frames out of order"] += 1
        return False

    def _renew(self) -> None:
        """End the run of before, if the node was deactivated or activated meanwhile."""
        if self._run_generation != self._generation:
            self._run_generation = self._generation
            self._driving = None
            self._forget()
            self._end_runs()

    def _is_placed(self, camera: str) -> bool:
        """Whether a camera can be used: of several, one whose place on the robot is not known would turn it around."""
        if not self._settings.camera_names or camera in self.mounts:
            self._health.over(f"place of {camera}")
            return True
        self._health.counts["frames of cameras without a place on the robot"] += 1
        self._health.begins(f"place of {camera}", f"The camera {camera} waits for /tf_static to say where it is.")
        return False

    def _running(self, camera: str) -> Run:
        """The present run of a camera; it begins if there is none, and anew when intrinsics come or change."""
        self._renew()
        known = self._intrinsics.get(camera) if self._settings.use_camera_info else None
        run = self._runs.get(camera)
        if run is not None and known is not None and run.intrinsics != known:
            self._end_run(camera)
            run = None
        if run is None:
            run = self._runs[camera] = Run(self._open(), self._settings, self._health, known, camera)
        return run

    def _first(self) -> str:
        """The camera by whose run the map is read where none is meant."""
        return next(iter(self._settings.camera_names), "")

    def _remark_pose(self, flat: Mapping[str, Any], found: PoseEstimate | None) -> None:
        """Say so if a place is recognized, and has no pose in metres."""
        if found is not None:
            self._health.over("pose")
        elif flat["verdict"] == "recognized":
            pose = flat["place"]["pose"] if flat["place"] else None
            kind = "no pose" if not pose else "a pose in degrees: the parameter datum makes metres of it"
            if not metric(pose):
                self._health.begins("pose", f"The robot is recognized, but the place has {kind}.")

    def _give_out(
        self, frame: Frame, answer: Mapping[str, Any], of_robot: PoseEstimate | None, revision: int | None, took: float
    ) -> None:
        """Take in the robot's pose by an answer, None if it gives none, and hand everything to the outlet."""
        fix = self._following.take(frame, answer, of_robot)
        limits = self._settings.position_limit, self._settings.heading_limit
        if fix is not None and fix.is_within(*limits) and not fix.unconfirmed:
            self._wanted = False
        self._health.fact("verdict", answer["verdict"])
        self._health.answered(took, None if of_robot is None else str(moment_of(frame.stamp) or "no stamp"))
        report = {
            "stamp": frame.stamp / NANOSECONDS,
            "frame_id": frame.message.header.frame_id,
            "camera": frame.camera,
            "number": frame.number,
            "map": self._settings.map,
            "revision": revision,
            "verdict": answer["verdict"],
            "probability": answer["probability"],
            "place": None if answer["place"] is None else answer["place"]["id"],
            "pose_source": None if of_robot is None else of_robot.source,
            "filtered": None if fix is None else filtered(fix),
            "request_milliseconds": round(1e3 * took, 3),
            "answer": dict(answer),
        }
        self._outlet.answered(Answered(frame, report, of_robot, None if of_robot is None else of_robot.planar, fix))

    def _mount(self, camera: str) -> Planar:
        """Where a camera is on the robot, or only where it looks if the map has positions of the robot."""
        known = self.mounts.get(camera)
        if known is None:
            return Planar(0.0, 0.0, math.radians(self._settings.camera_yaw))
        return known if self._settings.poses_of == "camera" else Planar(0.0, 0.0, known.yaw)

    def _forget(self) -> None:
        """Forget where the robot is."""
        self._wanted = True
        self._following.forget()

    def _annotate(self, frame: Frame, picture: Any, run: Run) -> None:
        """Send the frame again for a picture, if somebody looks on; the answer of the session is out already."""
        now = time.monotonic()
        if now - self._pictured < self._settings.picture_period or not self._outlet.wants_picture():
            return
        self._pictured = now
        generation = self._generation
        try:
            png = run.picture(picture)
        except PlacerecError as error:
            self._health.begins("picture", f"There is no annotated picture: {reason_of(error)}")
            return
        self._health.over("picture")
        if png is not None and generation == self._generation:
            self._outlet.picture(frame, png)

    def _end_runs(self) -> None:
        """End the sessions of all cameras."""
        for camera in [*self._runs, *self._sent]:
            self._end_run(camera)

    def _end_run(self, camera: str) -> None:
        """End a camera's session, if the service lets us; it ends by itself otherwise."""
        run = self._runs.pop(camera, None)
        self._sent.pop(camera, None)
        if run is not None:
            with suppress(PlacerecError):
                run.end()

    # ---- what the node's services ask for

    def _done(self, command: Callable[[], Done]) -> Done:
        try:
            return command()
        except UnfitPicture as error:
            return Done(False, _sentence(str(error)))
        except PlacerecError as error:
            reason = reason_of(error)
            if not isinstance(reason, Problem):
                return Done(False, str(reason))
            hint = " Give the node a key that may." if reason.slug in NOT_ALLOWED else ""
            return Done(False, f"The service refuses: {reason}{hint} ({reason.slug})")
        except Exception as error:  # the thread has to live on
            return Done(False, f"The node failed with {type(error).__name__}: {error}")

    def _create_map(self) -> Done:
        fields: Any = {"encoder": self._settings.encoder} if self._settings.encoder else {}
        made = self._open().maps.create(self._settings.map, **fields).view
        assert made is not None
        self._paused_until = 0.0
        return Done(True, f"The map {made.id} was created, with the encoder {made.encoder}.")

    def _relocalize(self) -> Done:
        if not self._active:
            return Done(False, "The node is not active.")
        self._mapping = ""
        self._forget()
        self._end_runs()
        self._paused_until = 0.0
        run = self._running(self._first())
        return Done(True, f"The session {run.id} began." if run.id else "The robot is looked for anew.")

    def _place(self, robot: Planar, covariance: Array, stamp: int) -> Done:
        if not self._active:
            return Done(False, "The node is not active.")
        odom = self.odometer.at(stamp)
        if odom is None:
            stamp, odom = self.odometer.latest
        if odom is None:
            return Done(False, "There is no odometry, so the pose cannot be followed.")
        self._forget()
        self._end_runs()
        self._following.place(robot, covariance, odom, stamp)
        return Done(True, f"The robot is believed to be at x {robot.x:.2f}, y {robot.y:.2f}.")

    def _enrol_here(self) -> Done:
        if not self._active:
            return Done(False, "The node is not active.")
        present = self._present()
        if not present:
            return Done(False, f"No image has come in the last {FRESH:g} s.")
        done = [self._enrol_present(frame) for frame in present]
        return Done(all(one.success for one in done), " ".join(one.message for one in done))

    def _enrol_present(self, frame: Frame) -> Done:
        located = self.odometer.located(frame.stamp) if frame.stamp else None
        if located is None:
            return Done(False, "There is no odometry for the moment of the image, so its pose is not known.")
        if self.odometer.alternates:
            return Done(False, ALTERNATES)
        if not located.settled:
            return Done(False, "Odometry has leapt a moment ago, so no pose is known yet; ask again.")
        run = self._running(frame.camera)
        if self.odometer.frame == self._settings.map_frame:
            robot = located.pose
        elif self._mapping == located.origin or run.places() == 0:
            self._mapping, robot = located.origin, located.pose  # the frame of the odometry is that of the new map
        elif self.fix is not None and self.fix.origin == located.origin:
            robot = self.fix.correction.then(located.pose)
        elif self._mapping:
            return Done(
                False, "Odometry has begun anew since the map was begun: its poses are no longer those of the map."
            )
        else:
            return Done(False, "The map has places and the robot is not localized in it: no pose can be given.")
        return self._enrol(frame, robot)

    def _begin_drive(self) -> Done:
        if not self._active:
            return Done(False, "The node is not active.")
        is_anew = not self._mapping and self.odometer.frame != self._settings.map_frame
        if is_anew and self._running(self._first()).places():
            return Done(False, "The map has places. Drive into an empty one, or with odometry in the frame of the map.")
        if not self.odometer.frame:
            return Done(False, "There is no odometry, so no pose is known.")
        origin = self.odometer.origin
        self._mapping = "" if self.odometer.frame == self._settings.map_frame else origin
        self._driving = Drive(origin)
        return Done(True, "Images are enrolled as the robot drives; meanwhile it is not localized.")

    def _end_drive(self) -> Done:
        driven, self._driving = self._driving, None
        if driven is None:
            return Done(False, "No images are being enrolled.")
        return Done(True, "Images are no longer enrolled.")

    def _enrol_keyframe(self, frame: Frame) -> None:
        """Enrol a frame if the robot has gone on far enough since the last one."""
        located, drive = self.odometer.located(frame.stamp) if frame.stamp else None, self._driving
        if located is None or drive is None:
            self._health.counts["frames without odometry"] += 1
            return
        if self.odometer.alternates:
            self._health.counts["frames without odometry"] += 1
            self._health.begins("keyframes", f"No images are enrolled: {ALTERNATES}", ERROR)
            return
        if located.origin != drive.origin:
            if not located.settled:  # it may be a wrong message, after which odometry goes on where it was
                self._health.counts["frames without odometry"] += 1
                return
            drive = self._driving = self._driving_on(drive, located.origin)
        elif drive.segment == 1:
            self._health.over("keyframes")
        if not self._is_placed(frame.camera):
            return
        odom = located.pose
        if not drive.goes_on(frame.camera, odom, self._settings.keyframe_metres, self._settings.keyframe_degrees):
            return
        self._enrol(frame, odom if drive.segment == 1 else None, drive.segment)
        drive.last[frame.camera] = odom
        self._heard_from_service()
        self._health.counts["keyframes enrolled"] += 1

    def _driving_on(self, drive: Drive, origin: str) -> Drive:
        """The drive after odometry has begun anew: it goes on in the frame of the map, else as another traverse."""
        if self.odometer.frame == self._settings.map_frame:
            return Drive(origin, drive.segment, drive.last)
        segment = drive.segment + 1
        self._health.over("keyframes")
        self._health.begins(
            "keyframes",
            "Odometry has begun anew, so images are enrolled without poses, as the traverse "
            f"{self._sequence}~{segment}.",
        )
        return Drive(origin, segment)

    def _enrol(self, frame: Frame, robot: Planar | None, segment: int = 1) -> Done:
        """Enrol a frame at which the robot was at a pose of the map; None: its odometry is not that of the map."""
        self._camera = frame.camera
        run = self._running(frame.camera)
        moment = moment_of(frame.stamp)
        assert moment is not None
        place = f"here-{moment:%Y%m%dT%H%M%S}-{moment.microsecond // 1000:03d}-{secrets.token_hex(2)}"
        fields: dict[str, Any] = {"sequence": self._sequence if segment == 1 else f"{self._sequence}~{segment}"}
        if robot is None:
            run.enrol(place, picture_of(frame.message), frame.stamp, **fields)
            return Done(True, f"{place} was enrolled without a pose.")
        camera = robot.then(self._mount(frame.camera))
        heading = math.degrees(camera.yaw)
        if (origin := self._settings.origin) is not None:
            fields["latitude"], fields["longitude"], fields["heading"] = origin.geographic(camera)
            if origin.altitude is not None:
                fields["z"] = camera.z + origin.altitude
        else:
            fields |= {"x": camera.x, "y": camera.y, "heading": heading % 360} | ({"z": camera.z} if camera.z else {})
        run.enrol(place, picture_of(frame.message), frame.stamp, **fields)
        return Done(True, f"{place} was enrolled at x {camera.x:.2f}, y {camera.y:.2f}, heading {heading % 360:.0f}°.")

    def _present(self) -> list[Frame]:
        """The latest frame of each camera that can be used."""
        now, several = time.monotonic(), bool(self._settings.camera_names)
        fresh = [frame for _, frame in sorted(self._latest.items()) if now - frame.arrived <= FRESH]
        return [frame for frame in fresh if not several or frame.camera in self.mounts]


def reason_of(error: PlacerecError) -> PlacerecError:
    """Why the last attempt failed, which a request with a deadline has behind the deadline."""
    cause = error.__cause__
    return cause if isinstance(error, DeadlineExceeded) and isinstance(cause, PlacerecError) else error


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")
