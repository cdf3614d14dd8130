"""Whether this machine has what an agent's settings ask for, asked before anything is made."""

import os
from itertools import pairwise

from koopdqn.errors import BadInputError
from koopdqn.rl.settings import AgentSettings
from koopdqn.tasks.actions import COUNT

_GIB = 2**30
_FLOAT32 = 4
# Two networks, their gradient and Adam's two moments; a batch's activations forward and backward, of two states.
_COPIES_OF_WEIGHTS = 5
_COPIES_OF_ACTIVATIONS = 4
# A transition beside its two observations: action, reward, three booleans, two poses, and step, source and answer.
_TRANSITION = 8 + 4 + 3 + 14 * 8 + 3 * 8
# One side-by-side episode: ten reached poses and what is known of them, with temporaries.
_EPISODE = 16 * 1024


def needed_bytes(agent: AgentSettings, inputs: int) -> dict[str, int]:
    """Return about how much memory an agent takes [bytes], by the setting it depends on most.

    Args:
        agent: its settings.
        inputs: number of values observed.
    """
    widths = [inputs + agent.network.fourier_features, *agent.network.hidden, 10]
    tried = COUNT if agent.drawn == "states" else 1
    # Every weight is drawn in double precision before it is kept.
    largest = max(before * after for before, after in pairwise(widths))
    weights = sum(before * after for before, after in pairwise(widths))
    return {
        "agent.network": _COPIES_OF_WEIGHTS * _FLOAT32 * weights + 2 * _FLOAT32 * largest,
        "agent.batch": _COPIES_OF_ACTIVATIONS * _FLOAT32 * agent.batch * tried * sum(widths),
        "agent.replay": agent.replay * (2 * _FLOAT32 * inputs + _TRANSITION),
        "agent.episodes_at_once": agent.episodes_at_once * _EPISODE,
    }


def check_memory(agent: AgentSettings, inputs: int, available: int | None = None) -> None:
    """Check that an agent fits into memory, so that a run does not die for it half-way.

    Args:
        agent: its settings.
        inputs: number of values observed.
        available: memory [bytes]; None takes this machine's, and checks nothing where it is not known.

    Raises:
        BadInputError: it needs more than the whole machine has.
    """
    if available is None:
        available = physical_memory()
    needed = needed_bytes(agent, inputs)
    if available is None or sum(needed.values()) <= available:
        return
    key = max(needed, key=needed.__getitem__)
    raise BadInputError(
        f"{key}: must fit into this machine's memory of {available / _GIB:.1f} GiB,"
        f" found a need of {sum(needed.values()) / _GIB:.4g} GiB"
    )


def check_device(agent: AgentSettings) -> str:
    """Return the name of the device that an agent's networks compute on: ``cpu``, or the GPU's.

    Raises:
        BadInputError: it is to be a GPU, and torch finds none.
    """
    if agent.device == "cpu":
        return "cpu"
    import torch

    if not torch.cuda.is_available():
        build = "this build of torch knows no CUDA" if torch.version.cuda is None else "torch finds no GPU"
        raise BadInputError(f"agent.device: must be cpu where there is no CUDA device, found {agent.device}; {build}")
    return torch.cuda.get_device_name()


def physical_memory() -> int | None:
    """Return the machine's memory [bytes], or None where the system does not say (Windows)."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None
