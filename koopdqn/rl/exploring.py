"""Where an agent's episodes begin, by its settings."""

from koopdqn.pose import Array
from koopdqn.rl.settings import AgentSettings
from koopdqn.rl.vector_env import StartSampler
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.workcell import Workcell


def start_sampler(
    workcell: Workcell, frame: StartFrame, trajectories: list[Array], agent: AgentSettings, step_limit: int
) -> StartSampler:
    """Return what draws an agent's starts, given demonstrated poses (N, 7) in a frame and whole episodes' limit."""
    return StartSampler(
        workcell.task,
        workcell.reachability,
        frame,
        trajectories,
        agent.exploring_starts,
        agent.exploring_in_region,
        agent.exploring_scale,
        agent.exploring_spread_m,
        agent.exploring_spread_rad,
        agent.exploring_steps,
        step_limit,
    )
