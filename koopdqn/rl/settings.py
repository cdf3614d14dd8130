"""Settings of agent and training: the network, its learning, exploring, and when training stops."""

from typing import Literal

from pydantic import Field, model_validator

from koopdqn.settings import Count, Counts, Fraction, Name, NonNegativeInt, Settings


class NetworkSettings(Settings):
    """The Q-network."""

    hidden: Counts = Field(min_length=1, description="units of each hidden layer")
    fourier_features: NonNegativeInt = Field(description="random Fourier features of the position; 0 for plain inputs")
    length_scale_m: float = Field(ge=1e-4, le=1e3, description="of the Fourier features [m]")
    length_scale_rad: float = Field(
        ge=1e-3,
        le=1e3,
        description="of the Fourier features in what is left to turn, where that is learned [rad]",
    )


class AgentSettings(Settings):
    """The agent. Steps are counted in actions tried, never in seconds."""

    name: Name
    network: NetworkSettings
    device: Literal["cpu", "cuda"] = Field(
        default="cpu", description="where the networks compute; the same bytes again only on the CPU"
    )
    gamma: float = Field(ge=0, lt=1, description="discount γ")
    double: bool = Field(description="double DQN (van Hasselt et al. 2016); false is Eq. 3 as written")
    learning_rate: float = Field(gt=0, le=1)
    drawn: Literal["states", "transitions"] = Field(
        description="what an update draws from the replay buffer: states with all that was tried from them,"
        " or single transitions"
    )
    batch: Count = Field(description="how many of them")
    replay: Count = Field(description="transitions kept")
    warm_up: Count = Field(description="transitions gathered before the first update")
    target_rate: float = Field(gt=0, le=1, description="share of the way the target network moves at a target update")
    target_every: Count = Field(description="updates between two target updates")
    policy_network: Literal["online", "target"] = Field(
        description="whose argmax is the policy: the online network, or the target as its average over many updates"
    )
    episodes_at_once: Count = Field(description="episodes that run side by side")
    rounds_per_update: Count = Field(description="steps of all episodes between two times of updating")
    updates_per_round: Count = Field(description="updates at each such time")
    trials: Literal["all", "chosen"] = Field(
        description="in a state, try every action whose reward is known without asking, or only the chosen one"
    )
    step_back: bool = Field(description="undo a wrong action and try another (§3.3)")
    bootstrap_undone: bool = Field(description="let an undone wrong action's target look past it")
    epsilon_start: Fraction
    epsilon_end: Fraction
    epsilon_steps: Count = Field(description="actions over which ε falls")
    exploring_starts: Fraction = Field(description="share of episodes that are short, for exploring")
    exploring_in_region: Fraction = Field(
        description="share of those that begin in and around the start region; the others begin along a demonstration"
    )
    exploring_scale: float = Field(
        ge=1, le=10, description="how many times wider than the start region all but the latter may begin"
    )
    exploring_spread_m: float = Field(
        gt=0, le=0.5, description="how far beside it the latter begin, a standard deviation [m]"
    )
    exploring_spread_rad: float = Field(
        gt=0, le=1, description="how far their turn is ahead or behind, a standard deviation [rad]"
    )
    exploring_steps: int = Field(ge=1, le=1_000_000, description="steps after which such an episode is cut")

    @model_validator(mode="after")
    def _check_trials(self) -> "AgentSettings":
        if self.trials == "all" and not self.step_back:
            raise ValueError("trials=all must go with step_back=true, as trying all actions is stepping back from each")
        return self

    def epsilon(self, steps: int) -> float:
        """Return ε after a number of actions: linear from start to end."""
        share = min(1.0, steps / self.epsilon_steps)
        return self.epsilon_start + share * (self.epsilon_end - self.epsilon_start)


class TrainSettings(Settings):
    """When training checks itself, when it stops. Limits count steps, never seconds."""

    stop: Literal["learned", "limit"] = Field(description="stop when learned, or only at a limit")
    extend: float = Field(ge=1, description="with stop=limit: go on to this many times the actions it took to learn")
    max_steps: Count = Field(description="most actions tried")
    max_episodes: Count = Field(description="most episodes finished")
    check_every: Count = Field(description="updates between two checks")
    check_starts: int = Field(ge=20, le=10_000, description="held-out starts of a check")
    check_seed: int = Field(ge=0, description="of the checks' starts")
    check_success: Fraction = Field(description="success rate that passes a check")
    checks_to_learn: Count = Field(
        description="passed checks in a row that count as learned, none nearer to the intent's own roll-out than the"
        " first of them by more than the share `gain`"
    )
    gain: Fraction = Field(description="share by which a nearer policy counts as still improving")
    step_limit_factor: float = Field(
        ge=3, le=1000, description="step limit of an episode in steps of the longest demonstration"
    )
    threads: int = Field(
        ge=1,
        le=256,
        description="threads of BLAS and torch, in every command; more is slower for small networks on a busy machine",
    )
