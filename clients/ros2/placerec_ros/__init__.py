"""A ROS 2 node that localizes a robot by a placerec service."""
