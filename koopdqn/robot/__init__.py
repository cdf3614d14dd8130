"""The robot: what an arm is, its kinematics, and the scene it stands in."""

from koopdqn.robot.render import prepare_rendering

# MuJoCo chooses how it draws at its first import, which is in a module of this package.
prepare_rendering()
