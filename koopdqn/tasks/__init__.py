"""Tasks: what is to be done, in which scene, and how a person would do it."""
