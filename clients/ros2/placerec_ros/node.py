"""The lifecycle node: topics, services and parameters of ROS around a :class:`~placerec_ros.localizer.Localizer`.

Callbacks only hand things over; all that takes time is done by the localizer's thread. So the node answers its
lifecycle services at any time, also while the service cannot be reached.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future as ThreadFuture
from dataclasses import replace
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, NavSatFix
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from placerec_ros import messages
from placerec_ros.answers import Answered
from placerec_ros.frame_queue import Frame
from placerec_ros.frames import StaticFrames, UnfitMount, mount_of
from placerec_ros.fusion import Fix
from placerec_ros.health import ERROR, OK, WARN, Health
from placerec_ros.intrinsics import UnfitCamera, intrinsics_of
from placerec_ros.localizer import ALTERNATES, Done, Localizer
from placerec_ros.odometry import NANOSECONDS, stamp_of
from placerec_ros.parameters import PARAMETERS, InvalidParameters, Parameter, Settings, refusal, settings
from placerec_ros.repetition import Repetition

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # where ROS is not installed, but its wheels
    TFMessage = None

IMAGE_TYPES = {
    "compressed": ("sensor_msgs/msg/CompressedImage", CompressedImage),
    "raw": ("sensor_msgs/msg/Image", Image),
}
TICK_SECONDS = 1.0
SILENCE_SECONDS = 5.0
"""Seconds without an image after which the node says so."""
STOP_SECONDS = 1.0
"""Seconds for which a clean-up waits for a request under way."""
UNCONFIRMED_SHARE = 0.5
"""The share of confirmation_limit after which images on demand are wanted again, so that the transform goes on."""
QUEUED = 5
"""Messages of a sensor that wait in the middleware."""

RCLError = rclpy_implementation.RCLError
Success, Failure = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


def sensor_qos(depth: int) -> QoSProfile:
    """Best effort, the last few: a sensor's message that was lost is not sent again."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


class PlacerecNode(LifecycleNode):
    """The node. Its topics are relative, so that a launch file can remap them; see ``docs/how-to/ros2.md``."""

    def __init__(self, name: str = "placerec", **options: Any) -> None:
        super().__init__(name, **options)
        for parameter in PARAMETERS:
            self.declare_parameter(parameter.name, parameter.default, descriptor(parameter))
        self._health = Health(self._log)
        self._settings: Settings | None = None
        self._localizer: Localizer | None = None
        self._outlet_lock = threading.Lock()
        self._publishing = False
        self._subscriptions_made: list[Any] = []
        self._image_subscriptions: dict[str, Any] = {}
        self._topics: list[Any] = []
        self._repetition = Repetition(1.0, 0.0)
        self._frames_of_robot: StaticFrames | None = None
        self._initial_pose_due = False
        self._initial_pose_sent: PoseWithCovarianceStamped | None = None
        self._frames = 0
        self._heard = {"image": 0.0, "info": 0.0}
        self._cameras: tuple[str, ...] = ("",)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._waiting = ReentrantCallbackGroup()  # while one of these waits, all other callbacks go on
        self._ask_for("create_map", lambda localizer, _: localizer.create_map())
        self._ask_for("enrol_here", lambda localizer, _: localizer.enrol_here())
        self._ask_for("relocalize", lambda localizer, _: localizer.relocalize())
        self._ask_for("enrol_keyframes", lambda localizer, asked: localizer.enrol_keyframes(asked.data), SetBool)
        self.add_on_set_parameters_callback(self._may_set)
        self.add_post_set_parameters_callback(self._were_set)
        self.create_timer(TICK_SECONDS, self._tick)

    # ---- parameters

    def _may_set(self, parameters: list[Any]) -> SetParametersResult:
        """Refuse what would have no effect until the node is configured anew."""
        for one in parameters:
            present = self.get_parameter(one.name).value if self.has_parameter(one.name) else None
            reason = refusal(one.name, one.value, present, self._settings is not None)
            if reason is not None:
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _were_set(self, changed: list[Any]) -> None:
        """Let the localizer have the parameters that may change at any time."""
        live = {one.name for one in PARAMETERS if one.live}
        values = {one.name: one.value for one in changed if one.name in live}
        if values and self._settings is not None and self._localizer is not None:
            self._settings = replace(self._settings, **values)
            self._repetition = Repetition(self._settings.transform_rate, self._settings.transform_tolerance)
            self._localizer.change(self._settings)

    # ---- transitions

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check the parameters, and make the publishers and the thread that speaks with the service."""
        self._health = Health(self._log)
        try:
            chosen = settings({one.name: self.get_parameter(one.name).value for one in PARAMETERS})
        except InvalidParameters as error:
            self._health.begins("parameters", str(error), ERROR)
            return Failure
        self._settings = chosen
        if chosen.key and chosen.url.startswith("http:") and not _is_local(chosen.url):
            self._health.begins("key", "The key goes to another machine without TLS; others can read it.")
        self._health.fact("service", chosen.url)
        self._pose = self.create_lifecycle_publisher(PoseWithCovarianceStamped, "~/pose", 10)
        self._transform = self.create_lifecycle_publisher(TransformStamped, "~/map_to_odom", 10)
        self._filtered = self.create_lifecycle_publisher(PoseWithCovarianceStamped, "~/filtered_pose", 10)
        self._answer = self.create_lifecycle_publisher(String, "~/answer", 10)
        self._picture = self.create_lifecycle_publisher(CompressedImage, "~/annotated/compressed", 1)
        self._initial_pose = self.create_lifecycle_publisher(PoseWithCovarianceStamped, "initialpose", 1)
        self._satellite = self.create_lifecycle_publisher(NavSatFix, "~/fix", 10)
        self._topics = [
            *(self._pose, self._transform, self._filtered, self._answer, self._picture),
            *(self._initial_pose, self._satellite),
        ]
        self._frames_of_robot = StaticFrames() if chosen.use_tf_static and TFMessage is not None else None
        self._tf: Any = None
        if chosen.publish_tf and TFMessage is not None:
            self._tf = self.create_lifecycle_publisher(TFMessage, "/tf", 100)
            self._topics.append(self._tf)
        self._repetition = Repetition(chosen.transform_rate, chosen.transform_tolerance)
        self._health.fact("tf", "not sent" if self._tf is None else "sent")
        self._localizer = Localizer(chosen, self, self._health)
        self._health.state = "inactive"
        return Success

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe, and begin a run."""
        result = super().on_activate(state)
        localizer, chosen = self._made()
        self._heard = {"image": time.monotonic(), "info": 0.0}
        self._cameras = chosen.camera_names or ("",)
        for camera in self._cameras if chosen.use_camera_info else ():
            taken = partial(self._on_camera_info, camera)
            self._subscribe(CameraInfo, _of_camera(camera, "camera_info"), taken, sensor_qos(1))
        self._subscribe(Odometry, "odom", self._on_odometry, sensor_qos(50))
        self._look_for_all_images()
        with self._outlet_lock:
            self._publishing = True
        if self._frames_of_robot is not None:
            latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._subscriptions_made.append(
                self.create_subscription(TFMessage, "/tf_static", self._on_static_frames, latched)
            )
        self._subscriptions_made.append(
            self.create_subscription(PoseWithCovarianceStamped, "initialpose", self._on_initial_pose, 1)
        )
        localizer.activate()
        self._initial_pose_due = True
        self._health.state = "active"
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the run and the subscriptions; nothing is published afterwards."""
        self._fall_silent()
        self._health.state = "inactive"
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give everything back that the configuration took."""
        self._release()
        self._health = Health(self._log)
        return Success

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give everything back, from any state."""
        self._release()
        self._health.state = "finalized"
        return Success

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give everything back, so that the node can be configured again."""
        self._release()
        self._health = Health(self._log)
        return Success

    def _made(self) -> tuple[Localizer, Settings]:
        assert self._localizer is not None and self._settings is not None
        return self._localizer, self._settings

    def _fall_silent(self) -> None:
        with self._outlet_lock:
            self._publishing = False
        if self._localizer is not None:
            self._localizer.deactivate()
        for camera in list(self._image_subscriptions):
            self._drop_images(camera)
        while self._subscriptions_made:
            self.destroy_subscription(self._subscriptions_made.pop())

    def _release(self) -> None:
        self._fall_silent()
        if self._localizer is not None:
            self._localizer.stop(STOP_SECONDS)
            self._localizer = None
        while self._topics:
            self.destroy_lifecycle_publisher(self._topics.pop())
        self._settings = None

    def close(self) -> None:
        """End the run where the process ends without a transition."""
        self._release()

    # ---- what comes in

    def _subscribe(self, kind: Any, topic: str, callback: Callable[[Any], None], qos: QoSProfile) -> Any:
        overridden = QoSOverridingOptions.with_default_policies()
        made = self.create_subscription(kind, topic, callback, qos, qos_overriding_options=overridden)
        self._subscriptions_made.append(made)
        return made

    def _drop_images(self, camera: str) -> None:
        made = self._image_subscriptions.pop(camera, None)
        if made is not None:
            self._subscriptions_made.remove(made)
            self.destroy_subscription(made)

    def _look_for_all_images(self) -> None:
        for camera in self._cameras:
            self._look_for_images(camera)

    def _look_for_images(self, camera: str) -> None:
        """Subscribe to the images of a camera once their type is known; say so if it is none of an image."""
        _, chosen = self._made()
        topic, kind_of = self._image_topic(camera), f"image type {camera}".strip()
        published = {one.topic_type for one in self.get_publishers_info_by_topic(topic)}
        wanted = {name: pair for name, pair in IMAGE_TYPES.items() if chosen.image_type in ("auto", name)}
        fitting = [kind for name, kind in wanted.values() if name in published]
        if published and not fitting:
            self._health.begins(
                kind_of,
                f"The topic {topic} has the type {', '.join(sorted(published))}; the node takes "
                f"{' or '.join(name for name, _ in wanted.values())}.",
                ERROR,
            )
            if chosen.image_type == "auto":
                self._drop_images(camera)
            return
        if published:
            self._health.over(kind_of)
        elif chosen.image_type != "auto":
            fitting = [kind for _, kind in wanted.values()]
        made = self._image_subscriptions.get(camera)
        if fitting and (made is None or made.msg_type not in fitting):
            self._drop_images(camera)
            taken = partial(self._on_image, camera)
            try:
                self._image_subscriptions[camera] = self._subscribe(fitting[0], topic, taken, sensor_qos(QUEUED))
            except (
                RCLError
            ) as error:  # the middleware has not forgotten the type from before; the next tick tries again
                self.get_logger().debug(f"No subscription yet: {error}")

    def _image_topic(self, camera: str) -> str:
        """The full name of a camera's topic of images, by image_transport's convention if that is set."""
        _, chosen = self._made()
        topic = str(self.resolve_topic_name(_of_camera(camera, "image")))
        compressed = chosen.image_transport == "compressed" and not topic.endswith("/compressed")
        return f"{topic}/compressed" if compressed else topic

    def _on_image(self, camera: str, message: Any) -> None:
        self._frames += 1
        self._heard["image"] = time.monotonic()
        if self._localizer is not None:
            self._find_camera(camera, message.header.frame_id)
            self._localizer.add(Frame(self._frames, stamp_of(message), message, camera=camera))

    def _find_camera(self, camera: str, frame: str) -> None:
        """Tell the localizer where the camera of an image is on the robot, once that is known."""
        localizer, chosen = self._made()
        if self._frames_of_robot is None or camera in localizer.mounts:
            return
        frame, base = chosen.camera_frame or frame, chosen.base_frame or localizer.odometer.child
        found = self._frames_of_robot.between(base, frame) if base and frame else None
        if found is None:
            return
        try:
            localizer.mounts[camera] = mount = mount_of(found, frame)
        except UnfitMount as error:
            self._health.begins(f"mount {camera}".strip(), f"The place of the camera is not used: {error}.")
        else:
            self._health.over(f"mount {camera}".strip())
            yaw = math.degrees(mount.yaw)
            fact = f"camera {camera} on the robot".replace("  ", " ")
            self._health.fact(fact, f"x {mount.x:.2f} m, y {mount.y:.2f} m, {yaw:.0f}°, by /tf_static")

    def _on_static_frames(self, message: Any) -> None:
        if self._localizer is not None and self._frames_of_robot is not None:
            self._frames_of_robot.add(message.transforms)
            self._localizer.mounts = {}  # they are found again with the next images

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        if self._localizer is None or message == self._initial_pose_sent:
            return
        localizer, chosen = self._made()
        if not chosen.take_initial_pose:
            return
        frame = message.header.frame_id
        if frame not in ("", chosen.map_frame):
            self._health.frame(f"An initial pose is in the frame {frame[:60]!r}, not in {chosen.map_frame!r}.")
            return
        try:
            robot, covariance = messages.given_pose(message)
        except ValueError as error:
            self._health.frame(f"An initial pose cannot be used: {error}.")
            return
        self._initial_pose_due = False  # whoever sent it knows it
        localizer.place(robot, covariance, stamp_of(message)).add_done_callback(self._tell_placed)

    def _tell_placed(self, placed: ThreadFuture[Done]) -> None:
        done = placed.result()
        if done.success:
            self._log(OK, done.message)
        else:
            self._health.frame(f"An initial pose is not used. {done.message}")

    def _on_camera_info(self, camera: str, message: CameraInfo) -> None:
        if self._localizer is None or self._settings is None:
            return
        localizer, chosen = self._localizer, self._settings
        self._heard["info"] = time.monotonic()
        try:
            intrinsics = intrinsics_of(message, chosen.rectified)
        except UnfitCamera as error:
            localizer.camera(None, camera)
            self._health.begins(f"camera info {camera}".strip(), f"The intrinsics are not used: {error}.")
        else:
            localizer.camera(intrinsics, camera)
            self._health.over(f"camera info {camera}".strip())

    def _on_odometry(self, message: Odometry) -> None:
        if self._localizer is None:
            return
        try:
            self._localizer.odometer.add(message)
        except ValueError as error:
            self._health.begins("odometry", f"A message of odometry cannot be used: {error}.")
        else:
            self._health.counts["messages of odometry left out"] = self._localizer.odometer.left_out
            if self._localizer.odometer.alternates:
                self._health.begins("odometry", ALTERNATES)
            else:
                self._health.over("odometry")
            self._send_transform(stamp_of(message))

    def _ask_for(
        self, name: str, ask: Callable[[Localizer, Any], ThreadFuture[Done]], kind: type[Any] = Trigger
    ) -> None:
        """Make a service that the localizer's thread answers."""

        async def answer(request: Any, response: Any) -> Any:
            if self._localizer is None:
                response.success, response.message = False, "The node is not configured."
                return response
            done = await self._awaited(ask(self._localizer, request))
            response.success, response.message = done.success, done.message
            return response

        self.create_service(kind, f"~/{name}", answer, callback_group=self._waiting)

    def _awaited(self, result: ThreadFuture[Done]) -> Future:
        """A future of the executor that is done when that of another thread is."""
        future: Future = Future(executor=self.executor)

        def finish(done: ThreadFuture[Done]) -> None:
            future.set_result(done.result())
            if (executor := self.executor) is not None:
                executor.wake()

        result.add_done_callback(finish)
        return future

    # ---- what goes out; the localizer's thread calls these

    def answered(self, answered: Answered) -> None:
        """Publish the answer, and the pose and the transform if the robot is localized."""
        with self._outlet_lock:
            if not self._publishing:
                return
            localizer, chosen = self._made()
            stamp = answered.frame.message.header.stamp
            if (found := answered.estimate) is not None:
                self._pose.publish(messages.pose_message(found.planar, found.covariance, stamp, chosen.map_frame))
                if (origin := chosen.origin) is not None:
                    base = chosen.base_frame or localizer.odometer.child or chosen.map_frame
                    self._satellite.publish(messages.fix_message(found, origin, stamp, base))
            self._answer.publish(messages.answer_message(answered))
            if answered.fix is not None:
                filtered = messages.filtered_message(answered.fix, stamp, chosen.map_frame)
                self._filtered.publish(filtered)
                self._send_initial_pose(answered.fix, filtered)
            elif localizer.fix is None:
                self._initial_pose_due = True

    def _send_initial_pose(self, fix: Fix, message: PoseWithCovarianceStamped) -> None:
        """Publish the robot's pose for others to begin with, once for each time that it was not known."""
        _, chosen = self._made()
        if not (chosen.send_initial_pose and self._initial_pose_due):
            return
        if fix.is_within(chosen.position_limit, chosen.heading_limit):
            self._initial_pose_due, self._initial_pose_sent = False, message
            self._initial_pose.publish(message)

    def _send_transform(self, stamp: int) -> None:
        """Send the transform from the map to the odometry, at a moment of odometry in nanoseconds, if it is due."""
        localizer, chosen = self._made()
        fix, odom, frame = localizer.fix, localizer.odometer.at(stamp), chosen.odom_frame or localizer.odometer.frame
        if fix is None or odom is None or fix.origin != localizer.odometer.origin or frame == chosen.map_frame:
            return
        if (ahead := self._repetition.due(stamp)) is None:
            return
        present = fix.at(odom, stamp / NANOSECONDS)
        if present.unconfirmed > UNCONFIRMED_SHARE * chosen.confirmation_limit:
            localizer.want()
        if present.unconfirmed > chosen.confirmation_limit:
            self._health.begins(
                "transform",
                f"The transform is not sent: no localization has confirmed it for {chosen.confirmation_limit:g} s.",
            )
            return
        if not present.is_within(chosen.position_limit, chosen.heading_limit):
            localizer.want()
            position, heading = present.deviations
            self._health.begins(
                "transform",
                f"The transform is not sent: the position has a standard deviation of {position:.1f} m, "
                f"the heading of {math.degrees(heading):.0f}°.",
            )
            return
        self._health.over("transform")
        transform = messages.transform_message(
            present.correction, messages.time_message(ahead), chosen.map_frame, frame
        )
        with self._outlet_lock:
            if self._publishing:
                self._transform.publish(transform)
                if self._tf is not None:
                    self._tf.publish(TFMessage(transforms=[transform]))

    def wants_picture(self) -> bool:
        """Whether somebody subscribes to annotated pictures."""
        with self._outlet_lock:
            return self._publishing and self._picture.get_subscription_count() > 0

    def picture(self, frame: Frame, png: bytes) -> None:
        """Publish an annotated picture."""
        with self._outlet_lock:
            if self._publishing:
                self._picture.publish(messages.picture_message(frame, png))

    # ---- every second

    def _tick(self) -> None:
        if self._health.state == "active":
            self._look_for_all_images()
            self._look_for_silence()
        level, text, values = self._health.report()
        if self._localizer is not None:
            values["frames dropped from the queue"] = str(self._localizer.queue.dropped)
        values["frames received"] = str(self._frames)
        url = "" if self._settings is None else self._settings.url
        now = self.get_clock().now().to_msg()
        name = self.get_fully_qualified_name().lstrip("/") + ": localization"
        self._diagnostics.publish(messages.diagnostics_message(level, text, values, name, url, now))

    def _look_for_silence(self) -> None:
        _, chosen = self._made()
        silent = time.monotonic() - self._heard["image"]
        if silent > SILENCE_SECONDS:
            expected = ", ".join(map(self._image_topic, self._cameras))
            self._health.begins("images", f"No image has come on {expected}.", WARN)
            return
        self._health.over("images")
        if not chosen.use_camera_info or self._heard["info"]:
            self._health.over("no camera info")
        elif self._frames:
            topics = [self.resolve_topic_name(_of_camera(one, "camera_info")) for one in self._cameras]
            self._health.begins(
                "no camera info", f"No CameraInfo has come on {', '.join(topics)}: the frames count without intrinsics."
            )

    def _log(self, level: int, sentence: str) -> None:
        log = self.get_logger()
        if level == ERROR:  # rclpy wants each line of code to log at one level
            log.error(sentence)
        elif level == WARN:
            log.warning(sentence)
        else:
            log.info(sentence)


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """The description of a parameter in ROS, and the range that it enforces."""
    made = ParameterDescriptor(description=parameter.description)
    if parameter.choices:
        made.additional_constraints = f"One of: {', '.join(parameter.choices)}"
    if parameter.least is not None and parameter.most is not None:
        if isinstance(parameter.default, float):
            made.floating_point_range = [FloatingPointRange(from_value=parameter.least, to_value=parameter.most)]
        else:
            made.integer_range = [IntegerRange(from_value=int(parameter.least), to_value=int(parameter.most), step=1)]
    return made


def _of_camera(camera: str, topic: str) -> str:
    """A topic of a camera; that of the only one has no name before it."""
    return f"{camera}/{topic}" if camera else topic


def _is_local(url: str) -> bool:
    return any(url.startswith(f"http://{host}") for host in ("127.", "localhost", "[::1]"))


def main(arguments: list[str] | None = None) -> int:
    """Run the node until it is stopped."""
    rclpy.init(args=arguments)
    node = PlacerecNode()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    if node.get_parameter("autostart").value and node.trigger_configure() == Success:
        node.trigger_activate()
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:  # rclpy's, of a message that came while it was stopped
        if rclpy.ok():
            raise
    finally:
        node.close()
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
