"""The learner: Algorithm 1, rewards from intent and feedback, vectorised episodes, the double DQN."""
