"""What demonstrations are good for: on this arm, beside one another, and for learning."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.cleaning import Cleaned, jump_of, without_outliers
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.demonstrations.preprocess import noise_of, trim_idle
from koopdqn.demonstrations.schema import Finding, InspectedDemonstration, Pair
from koopdqn.paths import arc_lengths, between, mean_poses, to_count, way_lengths
from koopdqn.pose import POSITION, Array
from koopdqn.robot.arm import Arm

# Of so many poses of a demonstration it is tried whether the arm can follow them.
_TRIED: Final = 200
# A joint that would turn more from one to the next changes the posture [rad].
_JUMP: Final = 0.7
_SMALL_ANGLE: Final = 1e-6
# Below this least singular value an arm's joints race for a slow motion of the tool.
_SINGULAR: Final = 0.03
# A motion all of which lies nearer to the base, or farther, is told in another unit or frame [m].
_CLOSE_M, _FAR_M = 0.1, 2.0
_PLACES: Final = 51
_SAME_MM: Final = 0.1
_ODD: Final = 3.0
_MOST_ODD: Final = 10
# Two groups go different ways if so many times as far apart as each is wide; less will do once starts are left out.
_CLEARLY, _STILL_TOLD = 2.0, 0.5
_GAP: Final = 10.0
# One more demonstration tells little if it brings the one left out nearer by less than this share.
_LITTLE: Final = 0.1
_FINE_MM: Final = 5.0


@dataclass(frozen=True)
class Followed:
    """How an arm follows a demonstration.

    Attributes:
        share: of its way.
        why: why no further.
        singular: least singular value of the Jacobian; None if nothing was followed. ``speed``: the largest joint
            speed, in shares of its limit.
    """

    share: float
    why: str
    singular: float | None
    speed: float | None


def follow(item: Demonstration, arm: Arm) -> Followed:
    """Return how the arm follows a demonstration, in whichever posture it comes farthest and then slowest."""
    # Between few samples too, as it is learned at the agent's step.
    at = np.linspace(0, len(item) - 1, _TRIED)
    low = np.minimum(at.astype(int), len(item) - 2)
    times = np.interp(at, np.arange(len(item)), item.times)
    poses = between(item.poses[low], item.poses[low + 1], at - low)
    starts = arm.solutions(poses[0])
    if not len(starts):
        return Followed(0.0, arm.inverse(poses[0], np.array(arm.home)).reason, None, None)
    tries = [_from(start, times, poses, arm) for start in starts]
    return max(tries, key=lambda each: (each.share, -(each.speed or 0.0)))


def _from(start: Array, times: Array, poses: Array, arm: Arm) -> Followed:
    joints, why = [start], ""
    for row in range(1, len(poses)):
        result = arm.inverse(poses[row], joints[-1])
        step = np.abs(result.joints - joints[-1])
        if not result.success or step.max() > _JUMP:
            why = result.reason or f"{arm.joint_names[int(step.argmax())]} would jump by {step.max():.2f} rad"
            break
        joints.append(result.joints)
    way = np.array(joints)
    speeds = np.abs(np.diff(way, axis=0)) / np.diff(times[: len(way)])[:, None] / np.array(arm.velocity_limits)
    return Followed((len(way) - 1) / (len(poses) - 1), why, _least_singular(way, arm), float(speeds.max(initial=0.0)))


def _least_singular(joints: Array, arm: Arm) -> float:
    """Return the least singular value of the Jacobians (6 × joints; m and rad) at joint angles (N, joints)."""
    here = arm.forward(joints)
    columns = []
    for index in range(joints.shape[1]):
        there = arm.forward(joints + _SMALL_ANGLE * np.eye(joints.shape[1])[index])
        turn = pose.to_rotation_vector(pose.multiply(there[:, 3:], pose.conjugate(here[:, 3:])))
        columns.append(np.hstack([there[:, POSITION] - here[:, POSITION], turn]) / _SMALL_ANGLE)
    return float(np.linalg.svd(np.stack(columns, axis=2), compute_uv=False)[:, -1].min())


def describe(raw: Demonstration, cleaned: Cleaned, arm: Arm, deviation_mm: float | None) -> InspectedDemonstration:
    """Return what is found of one demonstration, given as recorded and cleaned."""
    item, followed = cleaned.item, follow(cleaned.item, arm)
    steps = np.diff(raw.times)
    noise_m, noise_rad = noise_of(raw)
    return InspectedDemonstration(
        samples=len(raw),
        kept=len(item),
        seconds=float(raw.times[-1] - raw.times[0]),
        nearest_m=float(np.linalg.norm(item.poses[:, POSITION], axis=1).min()),
        farthest_m=float(np.linalg.norm(item.poses[:, POSITION], axis=1).max()),
        length_m=float(arc_lengths(item.poses[:, POSITION])[-1]),
        turn_deg=float(np.degrees(pose.rotation_distance(item.poses[0], item.poses[-1]))),
        idle_before_seconds=cleaned.before,
        idle_after_seconds=cleaned.after,
        repeated=cleaned.repeated,
        outliers=cleaned.outliers,
        jump_mm=1e3 * jump_of(trim_idle(without_outliers(raw)).item),
        noise_mm=1e3 * noise_m,
        noise_deg=float(np.degrees(noise_rad)),
        largest_gap=float(steps.max() / np.median(steps)),
        reached=followed.share,
        stopped=followed.why,
        singular=followed.singular,
        joint_speed=followed.speed,
        deviation_mm=deviation_mm,
    )


@dataclass(frozen=True)
class Together:
    """What demonstrations are beside one another; lists are empty for a single one.

    Attributes:
        deviation_mm: of each from the mean of the others.
        duplicates: pairs that are the same. ``odd``: those far off all others.
        spread_mm: RMS distance from the mean at 0, 25, 50, 75 and 100 % of the path. ``spread_deg``: in turn.
        left_out_mm: mean distance of one left out from the mean of 1, 2, … others.
        ways: the two groups that go clearly different ways; empty where all go one.
    """

    deviation_mm: list[float]
    duplicates: list[Pair]
    odd: list[int]
    spread_mm: list[float]
    left_out_mm: list[float]
    spread_deg: list[float] = field(default_factory=list)
    ways: list[list[int]] = field(default_factory=list)

    @property
    def parted(self) -> str:
        """That they go two ways, in words; empty where all go one."""
        if not self.ways:
            return ""
        groups = " and ".join(", ".join(map(str, way)) for way in self.ways)
        return f"demonstrations go two ways ({groups}): what lies between is learned; learn each way from its own"

    @property
    def enough(self) -> bool:
        """Whether one more would hardly tell more."""
        if len(self.left_out_mm) < 2:
            return bool(self.left_out_mm) and self.left_out_mm[-1] < _FINE_MM
        last, before = self.left_out_mm[-1], self.left_out_mm[-2]
        return last < _FINE_MM or before - last < _LITTLE * last


def compare(items: Sequence[Demonstration]) -> Together:
    """Return what demonstrations are beside one another, matched by their share of path."""
    if len(items) < 2:
        return Together([], [], [], [], [])
    poses = np.array([to_count(item.poses, _PLACES, way_lengths(item.poses)) for item in items])
    paths = 1e3 * poses[..., POSITION]
    count = len(paths)
    same = [
        Pair(first=i, second=i + 1 + int(j))
        for i in range(count)
        for j in np.flatnonzero(_apart(paths[i + 1 :], paths[i]) < _SAME_MM)
    ]
    curve, deviation = [], np.zeros(count)
    sums = np.cumsum(np.concatenate([np.zeros_like(paths[:1]), paths, paths]), axis=0)
    for others in range(1, count):
        # Of so many others those that follow in the order: each demonstration is left out once, each used as often.
        deviation = _apart(paths, (sums[1 + others : 1 + others + count] - sums[1 : 1 + count]) / others)
        curve.append(float(deviation.mean()))
    far = sorted(np.argsort(deviation)[-_MOST_ODD:].tolist()) if count > 2 else []
    odd = [i for i in far if deviation[i] > max(_ODD * _usual(np.delete(paths, i, axis=0)), _FINE_MM)]
    mean = mean_poses([item.poses for item in items], _PLACES)
    places = np.linspace(0, _PLACES - 1, 5).astype(int)
    apart = np.linalg.norm(paths - 1e3 * mean[:, POSITION], axis=2)
    turned = np.degrees([pose.rotation_distance(one, mean) for one in poses])
    spread, turn = (np.sqrt((each[:, places] ** 2).mean(axis=0)).tolist() for each in (apart, turned))
    return Together(deviation.tolist(), same, odd, spread, curve, turn, _two_ways(paths))


def _two_ways(paths: Array) -> list[list[int]]:
    """Return the two groups into which paths (N, P, 3) [mm] fall by their distances; none unless clearly so.

    Groups of two at least, farther from each other than twice what is within them. Where starts alone are that far
    apart, offsets that fade on the way would do it: without them the groups must still be told apart.
    """
    if len(paths) < 4:
        return []
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial.distance import squareform

    apart = np.array([_apart(paths, path) for path in paths])
    second = fcluster(linkage(squareform(apart, checks=False), "single"), 2, "maxclust") != 1
    if not 2 <= second.sum() <= len(paths) - 2:
        return []
    share = np.linspace(0.0, 1.0, _PLACES)[:, None]
    start, end = (paths[:, each] - paths[:, each].mean(axis=0) for each in ([0], [-1]))
    moved = paths - (1.0 - share) * start - share * end
    for distances, times in ((apart, _CLEARLY), (np.array([_apart(moved, path) for path in moved]), _STILL_TOLD)):
        between = float(distances[np.ix_(second, ~second)].min())
        within = max(float(distances[np.ix_(group, group)].max()) for group in (second, ~second))
        if between < max(times * within, _FINE_MM):
            return []
    groups = [np.flatnonzero(group).tolist() for group in (second, ~second)]
    return sorted(groups)


def _usual(paths: Array) -> float:
    """Return the median over paths (N, P, 3) of the mean distance of one from the mean of the others."""
    total, others = paths.sum(axis=0), len(paths) - 1
    return float(np.median(_apart(paths, (total - paths) / others)))


def _apart(paths: Array, others: Array) -> Array:
    """Return the mean distances (N,) of paths (N, P, 3) from others of the same shape, or from one (P, 3)."""
    return np.asarray(np.linalg.norm(paths - others, axis=2).mean(axis=1))


def findings(
    each: Sequence[InspectedDemonstration], beside: Together, arm: str, refused: str, legs: int = 1
) -> list[Finding]:
    """Return the lines of the table; ``refused`` is why they make no task, or an empty text.

    The path of the task that they make has so many legs, one unless it passes itself.
    """
    found = [_frame(each), _time(each), _samples(each), _reach(each, arm)]
    task = "starts and ends make one" + (f"; its path passes itself and has {legs} legs" if legs > 1 else "")
    found.append(_finding("one task", "bad" if refused else "good", refused or task))
    followed = [one for one in each if one.singular is not None and one.joint_speed is not None]
    if followed:
        least = min(one.singular or 0.0 for one in followed)
        near = least < _SINGULAR
        text = f"least singular value {least:.3f} (m, rad)" + (f", below {_SINGULAR}: joints will race" if near else "")
        found.append(_finding("singularities", "look" if near else "good", text))
        speed = max(one.joint_speed or 0.0 for one in followed)
        over = " of the limit; the arm will take longer" if speed > 1.0 else " of the limit"
        found.append(_finding("joint speed", "look" if speed > 1.0 else "good", f"at most {100 * speed:.0f} %{over}"))
    if beside.duplicates:
        pairs = ", ".join(f"{pair.first} and {pair.second}" for pair in beside.duplicates)
        found.append(_finding("duplicates", "bad", f"{pairs} are the same: count them once"))
    elif len(each) > 1:
        found.append(_finding("duplicates", "good", "none"))
    if len(each) > 2:
        text = f"{', '.join(map(str, beside.odd))}: more than three times as far off as the others"
        found.append(_finding("odd one out", "look" if beside.odd else "good", text if beside.odd else "none"))
    if beside.spread_mm:
        far, turned = (" ".join(f"{each:.0f}" for each in spread) for spread in (beside.spread_mm, beside.spread_deg))
        text = f"{far} mm and {turned}° at 0, 25, 50, 75 and 100 % of the path"
        if beside.ways:
            text += f"; {beside.parted}"
        found.append(_finding("spread", "look" if beside.ways else "good", text))
    found.append(_enough(beside))
    return found


def _finding(name: str, state: str, text: str) -> Finding:
    return Finding.model_validate({"name": name, "state": state, "text": text})


def _frame(each: Sequence[InspectedDemonstration]) -> Finding:
    nearest, farthest = min(one.nearest_m for one in each), max(one.farthest_m for one in each)
    odd = farthest < _CLOSE_M or nearest > _FAR_M
    text = f"{nearest:.2f} to {farthest:.2f} m from the arm's base"
    hint = ", as if in another unit (import.units) or frame (import.base)"
    return _finding("units and frame", "look" if odd else "good", text + (hint if odd else ""))


def _time(each: Sequence[InspectedDemonstration]) -> Finding:
    gap = max(one.largest_gap for one in each)
    idle = sum(one.idle_before_seconds + one.idle_after_seconds for one in each)
    text = f"longest step {gap:,.1f} times the usual one; {idle:.1f} s idle at the ends"
    return _finding("time", "look" if gap > _GAP else "good", text)


def _samples(each: Sequence[InspectedDemonstration]) -> Finding:
    repeated, out = sum(one.repeated for one in each), sum(one.outliers for one in each)
    noise = max(one.noise_mm for one in each)
    text = f"{repeated} of {sum(one.samples for one in each)} repeated, {out} outliers, noise {noise:.2f} mm"
    jumps = [index for index, one in enumerate(each) if one.jump_mm]
    if jumps:
        listed, farthest = ", ".join(map(str, jumps)), max(one.jump_mm for one in each)
        text += f"; up to {farthest:.0f} mm from one sample to the next, far faster than the rest, in {listed}"
    return _finding("samples", "look" if out or jumps else "good", text)


def _reach(each: Sequence[InspectedDemonstration], arm: str) -> Finding:
    lost = [index for index, one in enumerate(each) if one.reached < 1.0]
    if not lost:
        return _finding("reach", "good", f"{arm} can follow all of them")
    first = each[lost[0]]
    text = (
        f"{arm} cannot follow {len(lost)} of {len(each)}; {lost[0]} ends after {100 * first.reached:.0f} %:"
        f" {first.stopped}; demos.place=auto moves all of them to where it can"
    )
    return _finding("reach", "bad", text)


def _enough(beside: Together) -> Finding:
    if not beside.left_out_mm:
        return _finding("enough", "look", "one alone: its path is learned, how people vary is not; show three more")
    last = beside.left_out_mm[-1]
    text = f"one left out is {last:.1f} mm from the others' mean"
    if beside.enough:
        return _finding("enough", "good", f"{text}, and another would hardly change that")
    return _finding("enough", "look", f"{text}; each one more still brings that down: show more")
