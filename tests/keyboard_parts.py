"""A person at the keyboard, acted by a rule: of all keys the one that comes nearest to the demonstrator's path."""

import numpy as np

from koopdqn import pose
from koopdqn.app.recording.recorder import Recorder, target
from koopdqn.pose import Array


def shown_by_keys(recorder: Recorder, limit: int = 400) -> str:
    """Press the keys that show the task once, as its demonstrator would go from here; return them, without the end."""
    task, pressed = recorder.task, ""
    path = task.demonstrator.roll_out(recorder.here, 20 * int(task.nominal_path.length / task.step_m))
    while not task.reached(recorder.here[None])[0] and len(pressed) < limit:
        key = _next_key(recorder, path, turned=pressed.endswith("o"))
        reply = recorder.press(key)
        assert reply.changed, reply.text
        pressed += key
    return pressed


def _next_key(recorder: Recorder, path: Array, *, turned: bool) -> str:
    goal, here = recorder.task.goal, recorder.here
    apart = pose.position_distance(path, here)
    nearest = int(apart.argmin())
    behind = np.flatnonzero(apart[nearest:] >= recorder.step)
    aim = path[nearest + int(behind[0])] if len(behind) else path[-1]
    # A person who turns on the way moves in between, and finishes what is left of a turn.
    left, left_there = (float(pose.rotation_distance(each, goal)) for each in (here, aim))
    if not turned and (left - left_there > 0.5 * recorder.turn or left > 1e-9 > left_there):
        return "o"
    if pose.position_distance(here, goal) < 1e-9:
        return "o"
    reached = {key: target(key, here, goal, recorder.step, recorder.turn) for key in "wsadrfg"}
    return min(reached, key=lambda key: float(pose.position_distance(reached[key], aim)))
