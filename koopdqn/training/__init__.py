"""Training: the reward, the episodes and the learner brought together, checked, saved and continued."""
