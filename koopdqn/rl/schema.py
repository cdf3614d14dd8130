"""The content of ``train.json``: every key with its unit."""

from pydantic import Field

from koopdqn.settings import Count, Fraction, Name, NonNegative, NonNegativeInt, ReportModel, Sha256


class CheckReport(ReportModel):
    """One check of the argmax policy on held-out starts."""

    updates: Count = Field(description="updates of the network so far")
    env_steps: Count = Field(description="actions tried so far")
    episodes: NonNegativeInt = Field(description="episodes finished so far")
    success_rate: Fraction = Field(description="share of the starts from which the policy succeeds")
    intent_distance: NonNegative = Field(
        description="mean distance of the policy's paths from the nearest pose of the intent's roll-out from the same"
        " start, in steps of position or five rotation tolerances of turn, whichever is larger"
    )
    failures: dict[str, Count] = Field(description="failed starts by cause; a cause that did not occur is absent")


class RewardAgreement(ReportModel):
    """Share of the rewards whose sign is the demonstrator's too; null without such rewards."""

    trusted: Fraction | None = Field(description="of the intent model's rewards where demonstrations support it")
    certified: Fraction | None = Field(description="of its rewards where only a nearby answer certifies it")
    remembered: Fraction | None = Field(description="of the rewards from remembered answers")
    asked: Fraction | None = Field(description="of the rewards from asking")


class RewardsGiven(ReportModel):
    """Number of rewards by source, except those by rule."""

    trusted: NonNegativeInt = Field(description="from the intent model where demonstrations support it")
    certified: NonNegativeInt = Field(description="from the intent model where only a nearby answer certifies it")
    remembered: NonNegativeInt = Field(description="from remembered answers")
    asked: NonNegativeInt = Field(description="from asking")


class MadeFrom(ReportModel):
    """The inputs of the training."""

    demonstrations: Sha256 = Field(description="SHA-256 of the demonstrations' content")
    intent: Sha256 = Field(description="SHA-256 of the intent's arrays")


class TrainReport(ReportModel):
    """The content of ``train.json``. E finished episodes, short exploring ones included."""

    task: Name = Field(description="name of the task")
    seed: NonNegativeInt = Field(description="of the run")
    agent: Name = Field(description="name of the agent's config option")
    intent: Name = Field(description="name of the intent's config option")
    oracle: Name | None = Field(
        default=None, description="name of the config option that answered last; null where an earlier koopdqn wrote it"
    )
    learned: bool = Field(description="whether enough checks in a row were passed and quality stopped improving")
    learned_at_env_steps: NonNegativeInt | None = Field(description="actions tried by then; null if not learned")
    seconds: NonNegative = Field(
        description="duration of the run, all parts together; of a part that was stopped, what came after its last"
        " checkpoint is not counted [s]"
    )
    episodes: NonNegativeInt = Field(description="number E of finished episodes")
    env_steps: NonNegativeInt = Field(description="actions tried: transitions stored, undone ones included")
    updates: NonNegativeInt = Field(description="updates of the network")
    oracle_queries: NonNegativeInt = Field(description="questions that reached the oracle")
    budget_spent: bool = Field(description="whether `oracle.budget` questions were asked")
    answered_instead: NonNegativeInt = Field(
        description="questions that the scripted oracle answered after that (`oracle.when_spent=scripted`)"
    )
    contradictions: NonNegativeInt = Field(
        description="how often remembered answers left no action that could be right and were forgotten"
    )
    rewards_recomputed: NonNegativeInt = Field(
        description="rewards in the replay buffer recomputed because an answer changed the intent model"
    )
    trusted_fraction: Fraction | None = Field(
        description="share of rewards_given from the intent model, trusted or certified; null if there are none"
    )
    reward_agreement: RewardAgreement = Field(description="agreement with the demonstrator by source")
    rewards_given: RewardsGiven = Field(description="number of rewards by source")
    reward_per_episode: list[float] = Field(description="(E,) sum of the rewards of the chosen actions")
    steps_per_episode: list[NonNegativeInt] = Field(description="(E,) steps kept")
    exploring_episode: list[bool] = Field(description="(E,) whether it was a short exploring one")
    best_success_rate: Fraction = Field(
        description="success rate of the best check, of equal ones the nearest to the intent, or of its policy from"
        " other starts if these did not confirm it; 0 before the first"
    )
    best_update: NonNegativeInt = Field(description="updates before that check, whose network is the policy")
    step_limit: Count = Field(description="step limit of an episode")
    checks: list[CheckReport] = Field(description="(C,) every check, in order")
    threads: Count = Field(description="threads of BLAS and torch")
    device: str = Field(default="cpu", description="where the networks computed: `cpu`, or the name of the GPU")
    made_from: MadeFrom = Field(description="inputs of the training")
