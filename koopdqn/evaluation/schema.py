"""How a policy is evaluated, and the content of ``eval.json``: every key with its unit.

Where nothing could be measured a value is null.
"""

from typing import Annotated

from pydantic import Field

from koopdqn.safety.guard import GuardReport
from koopdqn.safety.separation import SeparationReport
from koopdqn.settings import (
    Count,
    Fraction,
    Name,
    NonNegative,
    NonNegativeInt,
    Positive,
    ReportModel,
    Settings,
    Vector3,
)

IntervalList = Annotated[list[Fraction], Field(min_length=2, max_length=2)]


class EvaluationSettings(Settings):
    """On which starts a policy is measured, and what is measured beside it."""

    episodes: int = Field(ge=1, le=100_000, description="held-out starts")
    seed: int = Field(ge=0, description="of the starts; their random stream is never one of training's or its checks'")
    start_scale: float = Field(
        gt=0,
        le=100,
        description="half ranges of the start region times this; above 1, starts farther than any demonstrated",
    )
    dynamics: bool = Field(description="also execute paths in MuJoCo dynamics through the arm's actuators")
    dynamics_episodes: Count = Field(description="successful paths executed so, the first ones, if there are as many")
    time_scale: float = Field(
        ge=1, le=1000, description="how many times robot.step_seconds one step takes in that execution"
    )
    baselines: bool = Field(description="also measure methods that learn nothing, from the same starts")
    goal: Vector3 | None = Field(
        default=None, description="where the goal is, for a task whose goal moves; null: drawn anew at every start [m]"
    )
    video: bool = Field(description="also write a film of a learned path beside a demonstration, eval.mp4")


class Summary(ReportModel):
    """A quantity over episodes."""

    mean: NonNegative | None = Field(description="mean over episodes")
    max: NonNegative | None = Field(description="largest of all episodes")


class LateralDeviation(ReportModel):
    """Distance [mm] of a path's points from a reference path, over episodes.

    Both are looked at in 200 points, evenly spaced along them.
    """

    mean: NonNegative | None = Field(description="mean over episodes of each episode's mean distance [mm]")
    max: NonNegative | None = Field(description="largest distance of all episodes [mm]")
    p95_of_max: NonNegative | None = Field(
        description="95th percentile over episodes of each episode's largest distance [mm]"
    )


class PathDeviation(LateralDeviation):
    """The same with points matched by arc length, of the curves without the stairs of single actions."""

    frechet: NonNegative | None = Field(description="mean over episodes of the discrete Fréchet distance [mm]")


class Range(ReportModel):
    """A quantity over episodes, of which the least matters too."""

    mean: float | None = Field(description="mean over episodes")
    min: float | None = Field(description="least of all episodes")
    max: float | None = Field(description="largest of all episodes")


class TurnReport(ReportModel):
    """How the turn goes along with the motion, over the measured episodes; only where orientation is learned."""

    half_before_third: Fraction | None = Field(
        description="share of episodes whose orientation distance to the goal halves before the position distance has"
        " lost a third, of those that begin with more than the goal's rotation tolerance left to turn; null without any"
    )
    while_moving: Range = Field(
        description="share of an episode's turn made in steps that also move the flange, of episodes that turn by more"
        " than that tolerance"
    )


class SuccessfulReport(ReportModel):
    """The deviations of a method over the measured episodes that succeeded."""

    path_deviation_mm: PathDeviation = Field(description="from the reference [mm]")
    stairs_deviation_mm: LateralDeviation = Field(description="the same by the arc length of the stairs [mm]")
    lateral_deviation_mm: LateralDeviation = Field(description="from the nearest point of the reference [mm]")
    rotation_deviation_deg: Summary = Field(description="angle to the reference's orientation [deg]")


class MethodReport(ReportModel):
    """What a method (the policy or a baseline) does from the held-out starts.

    The measured episodes are all that made at least one step, whether or not they succeeded. The
    reference of an episode is the demonstrator's own path without variation from the same start.
    """

    success_rate: Fraction = Field(description="share of episodes that succeeded")
    success_interval_95: IntervalList = Field(description="[lower, upper] Wilson 95 % interval of success_rate")
    measured_episodes: NonNegativeInt = Field(description="episodes that made at least one step")
    path_deviation_mm: PathDeviation = Field(
        description="from the reference, over the measured episodes; for this and every other deviation both paths are"
        " looked at in 200 points, evenly spaced along them [mm]"
    )
    stairs_deviation_mm: LateralDeviation = Field(
        description="the same matched by the arc length of the stairs themselves, which the ten directions lengthen"
        " unevenly [mm]"
    )
    lateral_deviation_mm: LateralDeviation = Field(
        description="from the nearest point of the reference: steps along the axes make a path longer in some parts"
        " than in others, which shifts the points matched by arc length along the path, but not these [mm]"
    )
    rotation_deviation_deg: Summary = Field(
        description="angle to the reference's orientation at the same share of arc length, over the measured episodes:"
        " mean of the episodes' means, largest of all [deg]"
    )
    successful: SuccessfulReport | None = Field(
        default=None,
        description="the four deviations over those of the measured episodes that succeeded; null where none did, where"
        " there is no reference, and in files of earlier releases",
    )
    tube_fraction: Fraction | None = Field(
        description="share of all steps of all episodes that end inside the trust domain"
    )
    final_position_error_mm: Summary = Field(description="distance to the goal at the end, over all episodes [mm]")
    final_rotation_error_deg: Summary = Field(description="angle to the goal at the end, over all episodes [deg]")
    path_length_ratio: NonNegative | None = Field(
        description="mean over the measured episodes of the path's length over the reference's"
    )
    steps: Summary = Field(description="steps made, over all episodes")
    time_stretch: Summary = Field(
        description="how many times robot.step_seconds a step takes for the sake of the joints' speed limits, over the"
        " measured episodes: mean of the episodes' means, largest of all steps"
    )
    failures: dict[str, NonNegativeInt] = Field(description="failed episodes by cause; every cause is present")
    turn: TurnReport | None = Field(description="how turn and motion go together; null where orientation is held")
    task_measures: dict[str, Range] = Field(
        description="what the task measures of its own (`Task.measures`), over the measured episodes: by name, in the"
        " unit that the name ends in, objects of mean, min and max; knife: `blade_angle_final_deg`, of the edge to"
        " straight down at the end; `fraction_until_safe`, share of the path until the edge stays within the safe"
        " angle, 1 if it never does; `min_blade_distance_m`, from the blade's nearest point to the receiver;"
        " `blade_speed_m_s`, largest of the blade's tip"
    )


class Contacts(ReportModel):
    """Contacts in dynamics, of anything with anything."""

    episodes: NonNegativeInt = Field(description="executed paths with a contact")
    steps: NonNegativeInt = Field(description="physics steps with a contact, of all executed paths")
    first: str | None = Field(description='the first pair that touched, as "a with b"; null without contact')


class DynamicsReport(ReportModel):
    """Successful paths executed in MuJoCo dynamics through the arm's actuators."""

    episodes: NonNegativeInt = Field(description="executed paths: the first successful ones")
    time_scale: Annotated[float, Field(ge=1)] = Field(description="how many times robot.step_seconds one step took")
    step_seconds: Annotated[float, Field(gt=0)] = Field(description="how long one step took at least [s]")
    tracking_error_mm: Summary = Field(
        description="distance of the flange from the commanded position at the same moment, at every physics step:"
        " mean of the paths' means, largest of all [mm]"
    )
    peak_joint_speed_ratio: NonNegative | None = Field(description="largest joint speed over that joint's limit")
    peak_joint_torque_ratio: NonNegative | None = Field(
        description="largest joint torque over that joint's limit, the torque that carries the weight included"
    )
    contacts: Contacts = Field(description="contacts on the way")
    sag_mm: Summary = Field(description="distance of the flange from the path's end after half a second at rest [mm]")
    guard: GuardReport | None = Field(default=None, description="what the guard refused; null without one")
    separation: SeparationReport | None = Field(
        default=None, description="the path nearest to the person, where it lacks most; null without `guard.person`"
    )


class Baselines(ReportModel):
    """Methods that learn nothing, from the same starts."""

    straight_line: MethodReport = Field(
        description="straight to the goal, turning evenly, in equal steps of at most the task's step"
    )
    constant_action: MethodReport = Field(
        description="always one and the same action: of all ten the one that succeeds most often, of equals the first"
    )
    greedy: MethodReport = Field(description="always the legal action nearest to the intent model's prediction")
    argmax_reward: MethodReport = Field(
        description="always the action of the greatest reward by the intent model, trusted or not, with no network"
    )
    nearest_velocity: MethodReport = Field(
        description="greedy with K replaced by the velocity of the nearest demonstrated pose, nearest by position in"
        " steps and orientation in turns of the agent, told in the intent's start frame; nothing leads back"
    )
    mean_tangent: MethodReport = Field(
        description="greedy with K replaced by the direction of the mean demonstration at its nearest place and the"
        " orientation a step further on it, told in the intent's start frame; nothing leads back"
    )
    mean_pursuit: MethodReport = Field(
        description="greedy with K replaced by pursuit of the mean demonstration, five steps ahead of its nearest place"
    )
    nearest_demonstration: MethodReport = Field(
        description="straight to the first pose of the demonstration that starts nearest, then its recorded poses"
    )
    mean_demonstration: MethodReport = Field(
        description="the mean of the demonstrations, moved to the start if the intent follows starts, else begun by"
        " going straight to its first pose"
    )
    floor: MethodReport = Field(
        description="always the legal action nearest to where the scripted person would be: what ten actions can do"
    )


class HoldoutReport(ReportModel):
    """What a policy does from the starts of H demonstrations that nothing was learned from.

    The reference of an episode is the held-out demonstration itself, less its idle ends and sensor noise.
    """

    demonstrations: Count = Field(description="number H of held-out demonstrations, one episode from the start of each")
    outcomes: list[Name] = Field(description='(H,) what became of each episode: "success" or the cause of its failure')
    hausdorff_mm: dict[str, list[NonNegative | None]] = Field(
        description="by method, the policy first: (H,) the farthest that any of the 200 points, evenly spaced, of an"
        " episode's path or of its demonstration is from the other; null where the episode made no step"
    )
    end_gap_mm: list[NonNegative] = Field(
        description="(H,) distance of each demonstration's own end from the task's goal, the mean of those learned from"
    )
    policy: MethodReport = Field(description="the policy from these starts")
    baselines: Baselines | None = Field(description="methods that learn nothing, from these starts")


class EvaluationReport(MethodReport):
    """What an evaluation finds. The keys of a method, at the top level, are the policy's.

    A task made from demonstrations has no demonstrator's own path: deviations from the reference are then null, and
    those from held-out demonstrations stand under ``holdout``.
    """

    task: Name = Field(description="name of the task")
    episodes: Count = Field(description="held-out starts")
    seed: NonNegativeInt = Field(description="of the starts")
    start_scale: Positive = Field(description="half ranges of the start region, in those of the task")
    redrawn_starts: NonNegativeInt = Field(
        description="draws of the start region that the arm could not take and that were drawn again"
    )
    step_limit: Count = Field(description="steps after which an episode of the policy or of greedy fails")
    dynamics: DynamicsReport | None = Field(description="execution in dynamics; null if not asked for")
    baselines: Baselines | None = Field(description="methods that learn nothing; null if not asked for")
    holdout: HoldoutReport | None = Field(
        description="from the starts of held-out demonstrations; null unless the task is made from demonstrations and"
        " some are held out"
    )


class EvaluationFile(EvaluationReport):
    """The content of ``eval.json``: the report with the run that was measured."""

    run: Name = Field(description="folder of the run that was measured, as it was given or found")
    as_trained: bool = Field(
        default=True,
        description="false where obstacles stood that the policy was trained without, its goal was given, starts were"
        " drawn from farther out or another arm moved; such an evaluation is not taken for the run's own by `compare`"
        " and `report`",
    )
    policy: str | None = Field(
        default=None,
        description="SHA-256 of the policy's file that was measured: an evaluation is of a run as long as its policy is"
        " that; null in files of earlier releases",
    )
