"""Where an agent's episodes begin, by its settings."""

from koopdqn.dqn.settings import AgentSettings
from koopdqn.environment.episodes import StartSampler
from koopdqn.pose import Array
from koopdqn.workcell import Workcell


def start_sampler(workcell: Workcell, trajectories: list[Array], agent: AgentSettings, step_limit: int) -> StartSampler:
    """Return what draws an agent's starts, given demonstrated poses (N, 7) and the step limit of whole episodes."""
    return StartSampler(
        workcell.task,
        workcell.reachability,
        trajectories,
        agent.exploring_starts,
        agent.exploring_in_region,
        agent.exploring_scale,
        agent.exploring_spread_m,
        agent.exploring_steps,
        step_limit,
    )
