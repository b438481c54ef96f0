"""Start the node and bring it to the state active.

ros2 launch placerec_ros placerec.launch.py map:=lab image:=/camera/image_raw/compressed

In a namespace it sends to the topic ``tf`` and hears ``tf_static`` there, as the launch files of Nav2 do.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

PARAMETERS = Path(get_package_share_directory("placerec_ros")) / "config" / "placerec.yaml"


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and the node with them."""
    given = LaunchConfiguration
    arguments = [
        DeclareLaunchArgument("map", description="Id of the map to localize in."),
        DeclareLaunchArgument("url", default_value="http://127.0.0.1:8000", description="Address of the service."),
        DeclareLaunchArgument("parameters", default_value=str(PARAMETERS), description="File with parameters."),
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node, such as robot1."),
        DeclareLaunchArgument("image", default_value="/camera/image_raw/compressed", description="Topic of images."),
        DeclareLaunchArgument("camera_info", default_value="/camera/camera_info", description="Topic of CameraInfo."),
        DeclareLaunchArgument("odom", default_value="/odom", description="Topic of odometry."),
        DeclareLaunchArgument("autostart", default_value="true", description="Configure and activate the node."),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="Take the time from /clock."),
    ]
    node = LifecycleNode(
        package="placerec_ros",
        executable="placerec_node",
        name="placerec",
        namespace=given("namespace"),
        output="screen",
        parameters=[
            given("parameters"),
            {
                "map": ParameterValue(given("map"), value_type=str),
                "url": ParameterValue(given("url"), value_type=str),
                "autostart": ParameterValue(given("autostart"), value_type=bool),
                "use_sim_time": ParameterValue(given("use_sim_time"), value_type=bool),
            },
        ],
        remappings=[
            ("image", given("image")),
            ("camera_info", given("camera_info")),
            ("odom", given("odom")),
            ("/tf", "tf"),  # of the namespace, as Nav2 has them
            ("/tf_static", "tf_static"),
        ],
    )
    return LaunchDescription([*arguments, node])
