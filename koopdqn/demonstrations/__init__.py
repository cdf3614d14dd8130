"""Demonstrations: trajectories that a person, or the scripted demonstrator, has shown."""
