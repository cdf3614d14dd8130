"""Recordings as a person would bring them, for the tests of what is made from demonstrations."""

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.demonstrations.derivation import Derivation
from koopdqn.pose import Array
from koopdqn.settings import load_settings
from koopdqn.tasks.task import TaskChoice

HORIZONTAL = np.array([0.70710678, 0.0, 0.70710678, 0.0])
SECONDS = 4.0


def derivation(**fields: object) -> Derivation:
    """Return the option task=demonstrated with some fields changed."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from koopdqn.resources import conf_dir

    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = compose("config", overrides=["task=demonstrated"])
    values = OmegaConf.to_container(config.task, resolve=True)
    assert isinstance(values, dict)
    found = load_settings({**values, **fields}, TaskChoice, "task")
    assert isinstance(found, Derivation)
    return found


def arc(offset: float = 0.0, count: int = 200) -> Array:
    """Return poses (count, 7) along a quarter circle of 0.2 m, begun ``offset`` [m] higher; all end alike."""
    share = np.linspace(0.0, 1.0, count)
    angle = 0.5 * np.pi * share
    height = 0.35 + 0.2 * np.cos(angle) + offset * (1.0 - share)
    return pose.make(np.stack([np.full(count, 0.45), 0.2 * np.sin(angle) - 0.1, height], axis=1), HORIZONTAL)


def turned_by(poses: Array, angle: float) -> Array:
    """Return poses (N, 7) that turn evenly by an angle [rad] about x, to the orientation they have."""
    left = np.linspace(angle, 0.0, len(poses))[:, None] * [1.0, 0.0, 0.0]
    return pose.make(poses[:, :3], pose.multiply(poses[:, 3:], pose.from_rotation_vector(left)))


def tipping(offset: float = 0.0) -> Array:
    """Return an arc, begun ``offset`` [m] higher, along which the tool tips by 40 degrees and back again."""
    poses = arc(offset)
    tip = np.radians(40) * np.sin(np.linspace(0.0, np.pi, len(poses))) ** 2
    poses[:, 3:] = pose.multiply(HORIZONTAL, pose.from_rotation_vector(tip[:, None] * [0.0, 1.0, 0.0]))
    return poses


def recorded(poses: Array, *, idle: int = 0, noise: float = 0.0, seed: int = 0) -> Demonstration:
    """Return poses (N, 7) as a recording, with idle samples at both ends and noise [m] on every position."""
    rng = np.random.default_rng(seed)
    rows = np.concatenate([np.repeat(poses[:1], idle, axis=0), poses, np.repeat(poses[-1:], idle, axis=0)])
    rows[:, pose.POSITION] += rng.normal(scale=noise, size=(len(rows), 3)) if noise else 0.0
    return Demonstration(SECONDS / len(poses) * np.arange(float(len(rows))), rows)


def shown(*items: Demonstration) -> Demonstrations:
    return Demonstrations("demonstrated", "UR5", items)
