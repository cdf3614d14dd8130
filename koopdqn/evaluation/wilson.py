"""Wilson's interval for a share of successes."""

from statistics import NormalDist


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the lower and upper bound of the success probability, each within 0…1.

    Wilson's score interval (1927) keeps its meaning at 0 and at all successes, where the normal
    approximation has no width. Without trials nothing is known: (0, 1).

    Args:
        successes: how many of the trials succeeded.
        trials: how many there were.
        confidence: probability with which the interval covers the truth.

    Raises:
        ValueError: successes are not within 0…trials, or the confidence is not within 0…1, both excluded.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes must be within 0…{trials} (the trials), found {successes}")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be over 0 and under 1, found {confidence}")
    if not trials:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.5 + 0.5 * confidence)
    share = successes / trials
    weight = 1.0 / (1.0 + z * z / trials)
    center = weight * (share + z * z / (2 * trials))
    half: float = weight * z * (share * (1 - share) / trials + (z / (2 * trials)) ** 2) ** 0.5
    # Rounding leaves 1e-17 where the bound is exactly 0 or 1.
    low = 0.0 if successes == 0 else max(0.0, center - half)
    high = 1.0 if successes == trials else min(1.0, center + half)
    return low, high
