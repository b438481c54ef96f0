"""The package as it is installed, for ``colcon test``; what the node does is tested in a checkout of placerec."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest
import rclpy
from ament_index_python.packages import get_package_prefix, get_package_share_directory
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter

from placerec_ros.node import PlacerecNode
from placerec_ros.parameters import PARAMETERS

SHARE = Path(get_package_share_directory("placerec_ros"))
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[PlacerecNode]:
    """A node with the file of parameters that is installed, in a namespace."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    file = str(SHARE / "config" / "placerec.yaml")
    rclpy.init(args=["--ros-args", "--params-file", file, "-r", "__ns:=/robot1"])
    made = PlacerecNode()
    yield made
    made.close()
    made.destroy_node()
    rclpy.try_shutdown()


def test_the_file_of_parameters_holds_and_the_node_can_be_configured(node: PlacerecNode) -> None:
    assert node.get_fully_qualified_name() == "/robot1/placerec"
    assert node.get_parameter("map").value == "lab"
    assert node.trigger_configure() == SUCCESS
    assert node.trigger_activate() == SUCCESS
    assert node.trigger_deactivate() == SUCCESS
    assert node.trigger_cleanup() == SUCCESS


@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda one: one.name)
def test_a_parameter_of_an_active_node_takes_effect_or_is_refused(node: PlacerecNode, parameter) -> None:
    assert node.trigger_configure() == SUCCESS and node.trigger_activate() == SUCCESS
    others = [one for one in parameter.choices if one != parameter.default]
    if isinstance(parameter.default, bool):
        changed = not parameter.default
    elif isinstance(parameter.default, str):
        changed = others[0] if others else "another"
    else:
        changed = type(parameter.default)(parameter.most)
    (done,) = node.set_parameters([Parameter(parameter.name, value=changed)])
    assert done.successful == parameter.live, done.reason
    if parameter.live:
        assert getattr(node._localizer._settings, parameter.name) == changed
    else:
        assert done.reason.startswith(f"The parameter {parameter.name} is read when")


def test_the_program_runs_with_the_python_of_the_environment() -> None:
    program = Path(get_package_prefix("placerec_ros")) / "lib" / "placerec_ros" / "placerec_node"
    assert os.access(program, os.X_OK)
    assert program.read_text().startswith("#!/usr/bin/env python3\n")


def test_the_launch_file_declares_what_it_takes() -> None:
    pytest.importorskip("launch_ros", reason="launch_ros is not installed")
    spec = importlib.util.spec_from_file_location("placerec_launch", SHARE / "launch" / "placerec.launch.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    declared = {one.name for one in module.generate_launch_description().get_launch_arguments()}
    assert {"map", "url", "namespace", "parameters", "autostart"} <= declared


def test_the_package_says_where_it_comes_from() -> None:
    package = ElementTree.parse(SHARE / "package.xml").getroot()
    assert package.findtext("url")
    assert {one.text for one in package.findall("test_depend")} >= {"python3-pytest"}
