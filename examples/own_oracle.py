"""An oracle of your own: it says yes to whatever brings the tool nearer to the goal or higher up.

Run it with ``python examples/own_oracle.py train.max_steps=30000``.

On the command line it is `oracle=custom oracle.target=own_oracle.UpOrNearer`.
"""

import sys

import koopdqn
from koopdqn import pose
from koopdqn.oracles.base import Answer, CustomOracle, Question


class UpOrNearer(CustomOracle):
    """Answers by a rule of thumb."""

    def answer(self, question: Question) -> Answer:
        """Return whether the pose reached (7,) is higher up or nearer to the goal than the pose before it."""
        goal = self.workcell.task.goal
        before, after = (pose.position_distance(each, goal) for each in (question.pose, question.reached))
        return Answer(bool(after < before or question.reached[2] > question.pose[2]), source=self.name)


if __name__ == "__main__":
    config = koopdqn.load_config("task=shelf", "oracle=custom", "oracle.target=own_oracle.UpOrNearer", *sys.argv[1:])
    demonstrations = koopdqn.generate(config)
    intent = koopdqn.fit(config, demonstrations)
    trained = koopdqn.train(config, demonstrations, intent)
    print(f"{trained.questions} questions answered; learned: {trained.learned}")
