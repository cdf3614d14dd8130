"""The learner: Algorithm 1, rewards from feedback, vectorised episodes, the double DQN."""
