"""The robot: what an arm is, its kinematics, and the scene it stands in."""
