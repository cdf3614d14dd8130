"""The pictures of each command: one module a picture, all in one style."""
