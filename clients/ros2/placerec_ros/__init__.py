"""A ROS 2 node that tells a robot where it is, by a placerec service."""
