"""Hydra behind the command line.

Import the modules, not this package: each loads only what it needs.
"""
