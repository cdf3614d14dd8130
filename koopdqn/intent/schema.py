"""The content of ``fit.json``: every key with its unit. Errors are of left-out demonstrations."""

from typing import Literal

from pydantic import Field

from koopdqn.settings import Count, Fraction, Name, NonNegative, NonNegativeInt, Positive, ReportModel


class PositionComponents(ReportModel):
    """A quantity for each axis of the base frame."""

    x: NonNegative = Field(description="along x of the base frame")
    y: NonNegative = Field(description="along y of the base frame")
    z: NonNegative = Field(description="along z of the base frame")


class RotationComponents(ReportModel):
    """A quantity for each component of a rotation vector in the demonstrated flange frame."""

    about_x: NonNegative = Field(description="about x of the demonstrated flange frame")
    about_y: NonNegative = Field(description="about y of the demonstrated flange frame")
    about_z: NonNegative = Field(description="about z of the demonstrated flange frame")


class ErrorSummary(ReportModel):
    """One-step errors over all steps of all demonstrations, each predicted by the model fitted to the others."""

    rms: NonNegative = Field(description="root mean square")
    mean: NonNegative = Field(description="mean")
    max: NonNegative = Field(description="largest")


class PositionErrors(ErrorSummary):
    """One-step errors of position, Eq. 15."""

    rms_per_component: PositionComponents = Field(description="root mean square for each component")
    max_per_component: PositionComponents = Field(description="largest absolute error for each component")


class RotationErrors(ErrorSummary):
    """One-step errors of orientation, Eq. 16."""

    rms_per_component: RotationComponents = Field(description="root mean square for each component")
    max_per_component: RotationComponents = Field(description="largest absolute error for each component")


class ErrorPerStep(ReportModel):
    """One-step errors by the step's number."""

    mean: list[NonNegative] = Field(
        description="(T − 1,) mean at every step over the demonstrations that have it; the longest has T samples"
    )
    max: list[NonNegative] = Field(description="(T − 1,) largest at every step")


class RollOutError(ReportModel):
    """Roll-outs of fixed step from the start of each left-out demonstration."""

    final: list[NonNegative] = Field(description="(D,) distance to the goal after twice the demonstration's steps")
    hausdorff: list[NonNegative] = Field(description="(D,) Hausdorff distance from the demonstration")
    median_hausdorff: NonNegative = Field(description="median of hausdorff")
    reached_goal: NonNegativeInt = Field(description="how many end within 5 mm of the goal")


class RidgeError(ReportModel):
    """The error of a ridge on left-out demonstrations."""

    ridge: NonNegative = Field(description="λ of the regularised least squares")
    multi_step_error_m: NonNegative = Field(
        description="RMS distance of roll-outs of 25 steps from states of the left-out demonstration [m]"
    )


class TrustCoverage(ReportModel):
    """Coverage and width of the trust domain."""

    sigmas: Positive | None = Field(description="k: half a box's width in standard deviations; null for a tube")
    matching: Literal["step", "any", "everywhere", "nowhere"] = Field(
        description="how states are matched with the demonstrations' steps"
    )
    nominal_coverage: Fraction | None = Field(
        description="share of new demonstrations that the tube is to contain from end to end, at most D/(D + 1); null"
        " for a box, and for the fixed tube around a single demonstration"
    )
    fresh: NonNegativeInt = Field(description="new demonstrations that coverage was measured on (`fit.fresh`)")
    measured_coverage: Fraction | None = Field(
        description="share of those contained from end to end by the shape alone; null without any"
    )
    radius_m: Positive | None = Field(description="median radius of the tube along its middle; null for a box [m]")
    largest_radius_m: Positive | None = Field(description="its largest radius [m]")
    radius_rad: Positive | None = Field(description="median radius of orientations; null for a box [rad]")
    spread_m: NonNegative | None = Field(
        description="median along the path of the standard deviation of the demonstrations about their mean [m]"
    )
    known_share: Fraction = Field(description="share of the domain's places that are trusted")
    least_right: Fraction = Field(description="stated share of right signs (`trust.least_right`)")
    doubt: NonNegative | None = Field(
        description="median over places of the guard band around the tolerance, as a share of it; null if most places"
        " are not trusted"
    )
    right_share: Fraction | None = Field(
        description="share of rewards outside the guard band, at the states of a left-out demonstration, whose sign by"
        " the model of the others is that of following the mean of all: mean over trusted places; null for a single"
        " demonstration"
    )
    left_out_right_share: Fraction | None = Field(
        description="share of all rewards outside the narrowest guard band there whose sign is right by the left-out"
        " demonstration's next pose; lower where people differ"
    )
    fresh_right_share: Fraction | None = Field(
        description="share of the trusted rewards along the `fresh` demonstrations that the demonstrator agrees with;"
        " null without any"
    )
    held_out_state_coverage: Fraction | None = Field(
        description="share of the states of a left-out demonstration that the domain of the others contains, mean over"
        " the demonstrations; null for a single one"
    )
    held_out_path_coverage: Fraction | None = Field(
        description="share of the left-out demonstrations contained from end to end"
    )
    per_demonstration: list[Fraction] | None = Field(description="(D,) share of the states contained")


class SixtySamples(ReportModel):
    """One-step errors with every demonstration resampled to 60 poses, about the paper's number."""

    rms_m: NonNegative = Field(description="root mean square error of position [m]")
    persistence_rms_m: NonNegative = Field(description="the same for predicting no motion [m]")
    rms_over_persistence: NonNegative = Field(description="rms_m over persistence_rms_m")
    max_m: NonNegative = Field(description="largest error of position [m]")
    paper_max_m: NonNegative | None = Field(description="the paper's value; null if it gives none [m]")
    rms_rad: NonNegative | None = Field(
        description="root mean square error of orientation; null where orientation is held [rad]"
    )
    persistence_rms_rad: NonNegative | None = Field(description="the same for predicting no turn [rad]")
    rms_over_persistence_rotation: NonNegative | None = Field(description="rms_rad over persistence_rms_rad")
    max_rad: NonNegative | None = Field(description="largest error of orientation [rad]")


class FitReport(ReportModel):
    """The content of ``fit.json``, of D demonstrations. A fold's model is fitted without the one it is measured on."""

    task: Name = Field(description="name of the task")
    intent: Name = Field(description="name of the intent's config option")
    demonstrations: Count = Field(description="number D of demonstrations")
    samples: list[Count] = Field(description="(D,) poses of each, resampled to the agent's step")
    step_m: Positive = Field(description="the agent's step [m]")
    one_step_error_m: PositionErrors | None = Field(
        description="one-step error of position, Eq. 15; null for a single demonstration [m]"
    )
    one_step_error_per_step_m: ErrorPerStep | None = Field(description="the same by the step's number [m]")
    one_step_error_rad: RotationErrors | None = Field(
        description="one-step error of orientation, Eq. 16; null where orientation is held, or for a single"
        " demonstration [rad]"
    )
    one_step_error_per_step_rad: ErrorPerStep | None = Field(description="the same by the step's number [rad]")
    roll_out_error_m: RollOutError | None = Field(
        description="repeated prediction; distances are limited to 1000 m; null for a single demonstration [m]"
    )
    converges: bool = Field(description="whether roll-outs from all starts in the demonstrated region reach the goal")
    converging_share: Fraction = Field(
        description="share of those starts from which they do: the demonstrations' starts, 20 of the start region, 20"
        " trusted states beside the demonstrations"
    )
    converging_share_wide: Fraction = Field(
        description="the same for 20 starts three times as far from the middle of the start region"
    )
    length_ratio: NonNegative | None = Field(
        default=None,
        description="how long the model's own way to the goal is, in shares of the demonstration from the same start, a"
        " median, both until they are within the goal's tolerance: where demonstrations come back over the same place"
        " only the last passage is learned; null where an earlier koopdqn wrote it",
    )
    ridge: NonNegative = Field(description="λ of the fitted model")
    regularisation: list[RidgeError] = Field(
        description="every candidate λ with its error on left-out demonstrations; empty for a single one"
    )
    spectral_radius: NonNegative = Field(
        description="largest absolute eigenvalue of K (of K_p where there are two), fitted to all demonstrations"
    )
    spectral_radius_rotation: NonNegative | None = Field(description="the same of K_o; null where there is none")
    lifted_dimension: Count = Field(description="rows of K, or of K_p")
    trust: TrustCoverage = Field(description="coverage of the trust domain")
    unmatched_share: Fraction = Field(description="share of the demonstrated steps that no action matches")
    sixty_samples: SixtySamples | None = Field(
        description="errors at the paper's sampling; null for a single demonstration"
    )
