"""Settings of agent and training, and whether this machine can run them."""

import os
from itertools import pairwise
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from koopdqn.errors import BadInputError
from koopdqn.settings import Count, Counts, Fraction, Name, NonNegative, NonNegativeInt, Settings
from koopdqn.tasks.actions import COUNT, FIRST_TWIST


class NetworkSettings(Settings):
    """The Q-network."""

    hidden: Counts = Field(min_length=1, description="units of each hidden layer")
    fourier_features: NonNegativeInt = Field(description="random Fourier features of the position; 0 for plain inputs")
    length_scale_m: float = Field(ge=1e-4, le=1e3, description="of the Fourier features [m]")
    length_scale_rad: float = Field(
        ge=1e-3, le=1e3, description="of the Fourier features in what is left to turn, where that is learned [rad]"
    )


class Agent(Settings):
    """What all agents have. Steps are counted in actions tried, never in seconds."""

    continuous: ClassVar[bool]
    """Whether actions are twists (:mod:`koopdqn.tasks.actions`) instead of Table 1's."""

    name: Name
    network: NetworkSettings
    device: Literal["cpu", "cuda"] = Field(
        default="cpu", description="device of the networks; only the CPU is reproducible to the byte"
    )
    gamma: float = Field(ge=0, lt=1, description="discount γ")
    learning_rate: float = Field(gt=0, le=1)
    drawn: Literal["states", "transitions"] = Field(
        description="what an update draws from the replay buffer: states with all their transitions, or single"
        " transitions"
    )
    batch: Count = Field(description="number of states or transitions drawn")
    replay: Count = Field(description="transitions kept")
    warm_up: Count = Field(description="transitions stored before the first update")
    target_rate: float = Field(gt=0, le=1, description="rate τ of a target update: 1 copies the online network")
    target_every: Count = Field(description="updates between two target updates")
    policy_network: Literal["online", "target"] = Field(
        description="which network is the policy: the online one, or the target, its average over many updates"
    )
    episodes_at_once: Count = Field(description="parallel episodes")
    rounds_per_update: Count = Field(description="steps of all episodes between updates")
    updates_per_round: Count = Field(description="number of updates then")
    trials: Literal["all", "chosen"] = Field(
        description="attempts in a state: every action whose reward is known without asking, or only the chosen one"
    )
    step_back: bool = Field(description="undo a wrong action and try another (§3.3)")
    bootstrap_undone: bool = Field(description="let the target of an undone action bootstrap")
    epsilon_start: Fraction
    epsilon_end: Fraction
    epsilon_steps: Count = Field(description="actions over which ε falls")
    exploring_starts: Fraction = Field(description="share of episodes that are short, for exploring")
    exploring_in_region: Fraction = Field(
        description="share of those that begin in and around the start region; the others begin along a demonstration"
    )
    exploring_scale: float = Field(ge=1, le=10, description="scale of the start region for all but the latter")
    exploring_spread_m: float = Field(
        gt=0, le=0.5, description="standard deviation of the latter's offset from the demonstration [m]"
    )
    exploring_spread_rad: float = Field(
        gt=0, le=1, description="standard deviation of their turn ahead or behind [rad]"
    )
    exploring_steps: int = Field(ge=1, le=1_000_000, description="step limit of exploring episodes")

    @model_validator(mode="after")
    def _check_trials(self) -> Self:
        if self.trials == "all" and not self.step_back:
            raise ValueError("trials=all must go with step_back=true, as trying all actions is stepping back from each")
        return self

    def epsilon(self, steps: int) -> float:
        """Return ε after a number of actions: linear from start to end."""
        share = min(1.0, steps / self.epsilon_steps)
        return self.epsilon_start + share * (self.epsilon_end - self.epsilon_start)


class AgentSettings(Agent):
    """The double DQN, whose actions are Table 1's."""

    continuous: ClassVar[bool] = False

    double: bool = Field(description="double DQN (van Hasselt et al. 2016); false is Eq. 3 as written")


class ActorCriticSettings(Agent):
    """Twin delayed deep deterministic policy gradient (TD3, Fujimoto et al. 2018), whose actions are twists.

    In every state all actions whose reward is known are attempted, and updates draw states with all their transitions.
    """

    continuous: ClassVar[bool] = True
    drawn: Literal["states"] = "states"
    trials: Literal["all"] = "all"

    critic_states: Count = Field(
        description="states of a batch whose transitions the critics learn from; the actor: all"
    )
    critic_hidden: Counts = Field(min_length=2, max_length=2, description="units of each hidden layer of a critic")
    actor_rate: float = Field(gt=0, le=1, description="learning rate of the actor")
    near: Count = Field(description="twists attempted near the actor's own, which is attempted too")
    near_spread: float = Field(gt=0, le=10, description="standard deviation of their numbers, in tolerances")
    smoothing: float = Field(ge=0, le=10, description="standard deviation of the target policy's noise, in tolerances")
    smoothing_most: float = Field(ge=0, le=10, description="largest such noise of a number, in tolerances")
    actor_every: Count = Field(description="updates of the critics between two of the actor")
    imitation: NonNegative = Field(
        description="weight in the actor's loss of the squared distance from a state's best action, as in"
        " TD3+BC (Fujimoto & Gu 2021); 0 for the critic's gradient alone"
    )

    @property
    def twists(self) -> int:
        """How many twists without a name are attempted in a state."""
        return 1 + self.near


class TrainSettings(Settings):
    """When the policy is checked and when training stops. Limits count steps, never seconds.

    They are looked at after every round, a step of all episodes, which may go past them.
    """

    stop: Literal["learned", "limit"] = Field(description="stop when learned, or only at a limit")
    extend: float | None = Field(
        ge=1,
        description="with stop=limit: go on to this multiple of the actions it took to learn; null for no such limit",
    )
    max_steps: Count = Field(description="actions tried after which training ends, with the round of all episodes")
    max_episodes: Count = Field(description="episodes finished after which it ends, with that round")
    check_every: Count = Field(description="updates between two checks")
    check_starts: int = Field(ge=20, le=10_000, description="held-out starts of a check")
    check_seed: int = Field(ge=0, description="of the checks' starts")
    check_success: Fraction = Field(description="success rate that passes a check, and confirms what is learned")
    checks_to_learn: Count = Field(
        description="passed checks in a row after which the task is learned, if none is nearer to the intent's roll-out"
        " than the first by more than the share `gain`, and twice as many other starts confirm it; three times as many"
        " where the policy is more than twice as far from the intent as the actions nearest to it lead"
    )
    gain: Fraction = Field(description="least relative gain in distance that counts as improvement")
    step_limit_factor: float = Field(
        ge=3, le=1000, description="step limit of an episode in steps of the longest demonstration"
    )
    threads: int = Field(
        ge=1,
        le=256,
        description="threads of BLAS and torch, in every command; more is slower for small networks on a busy machine",
    )


_GIB = 2**30
_FLOAT32 = 4
# Two networks, their gradient and Adam's two moments; activations forward and backward of a state and its successor.
_COPIES_OF_WEIGHTS = 5
_COPIES_OF_ACTIVATIONS = 4
# Bytes of a transition without its observations: action, reward, three booleans, two poses, step, source and answer.
_TRANSITION = 8 + 4 + 3 + 14 * 8 + 3 * 8
# Bytes of a parallel episode: ten reached poses and their evaluation, with temporaries.
_EPISODE = 16 * 1024
# Numbers of a twist.
_TWIST = 6


def _needed_bytes(agent: Agent, inputs: int) -> dict[str, int]:
    """Return an estimate of the memory that an agent needs [bytes], by the setting it depends on most."""
    widths = [inputs + agent.network.fourier_features, *agent.network.hidden, 10]
    tried = COUNT if agent.drawn == "states" else 1
    # Every weight is drawn in double precision before it is kept.
    largest = max(before * after for before, after in pairwise(widths))
    weights = sum(before * after for before, after in pairwise(widths))
    needed = {
        "agent.network": _COPIES_OF_WEIGHTS * _FLOAT32 * weights + 2 * _FLOAT32 * largest,
        "agent.batch": _COPIES_OF_ACTIVATIONS * _FLOAT32 * agent.batch * tried * sum(widths),
        "agent.replay": agent.replay * (2 * _FLOAT32 * inputs + _TRANSITION),
        "agent.episodes_at_once": agent.episodes_at_once * _EPISODE,
    }
    if isinstance(agent, ActorCriticSettings):
        first, second = agent.critic_hidden
        weights = 2 * (first * (widths[0] + _TWIST + second) + second)
        attempts = FIRST_TWIST + agent.twists
        needed["agent.critic_hidden"] = _COPIES_OF_WEIGHTS * _FLOAT32 * weights
        needed["agent.batch"] += _COPIES_OF_ACTIVATIONS * _FLOAT32 * agent.batch * attempts * 2 * (first + second)
        needed["agent.replay"] += agent.replay * _FLOAT32 * _TWIST
        needed["agent.near"] = agent.episodes_at_once * attempts * _EPISODE // COUNT
    return needed


def check_memory(agent: Agent, inputs: int) -> None:
    """Check that an agent that observes ``inputs`` values fits into memory, lest a run fail half-way for lack of it.

    Raises:
        BadInputError: it needs more than the machine's memory, where that is known.
    """
    available, needed = physical_memory(), _needed_bytes(agent, inputs)
    if available is None or sum(needed.values()) <= available:
        return
    key = max(needed, key=needed.__getitem__)
    raise BadInputError(
        f"{key}: must fit into this machine's memory of {available / _GIB:.1f} GiB,"
        f" found a need of {sum(needed.values()) / _GIB:.4g} GiB"
    )


def check_device(agent: Agent) -> str:
    """Return the name of the device of an agent's networks: ``cpu``, or the GPU's name.

    Raises:
        BadInputError: a GPU is asked for and torch finds none.
    """
    if agent.device == "cpu":
        return "cpu"
    import torch

    if not torch.cuda.is_available():
        build = "this build of torch knows no CUDA" if torch.version.cuda is None else "torch finds no GPU"
        raise BadInputError(f"agent.device: must be cpu where there is no CUDA device, found {agent.device}; {build}")
    return torch.cuda.get_device_name()


def physical_memory() -> int | None:
    """Return the machine's memory [bytes], or None where it is unknown (Windows)."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None
